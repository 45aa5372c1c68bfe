# make demo   sets everything up and runs the whole line on the embedded default
# make test   sets everything up and runs linter, type checker and the tests: three minutes on two cores
# make test-all   the same and the slow tests too, in a quarter of an hour
# make bench   measures what must not become slower, in a minute, and compares with tests/benchmarks/ledger.csv
# make results   regenerates tables, pages and pictures of weights that changed: MESHES=folder, PHOTOGRAPHS=folder
# make ui     opens MLflow at the comparison of methods; make lab opens Jupyter on the notebooks
# make notebooks   executes all notebooks and stores their outputs; make docs builds the documentation, site/
# Options: TORCH=cuda for the CUDA build of PyTorch, PYTHON=python3.12, PORT=5001 for make ui. See environment.md.

TORCH ?= cpu
TORCH_VERSION := 2.13.0
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
  $$p -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null && echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet --progress-bar off
CONSTRAINTS := configs/constraints.txt
READY := $(VENV)/ready-$(TORCH)

.PHONY: demo test test-all bench results setup ui lab notebooks docs clean help

help:
	@sed -n '1,8s/^# //p' Makefile

demo: $(READY)
	@$(BIN)/wheretolook demo

# Slow are Ray, worker processes that are killed, the notebooks, planned paths that are rendered, and the like. mypy runs
# beside the tests, which wait for nothing, and speaks after them if it found something; their status is the target's.
test: TESTS := -m 'not slow'
test test-all: $(READY)
	$(BIN)/ruff check --no-cache . && $(BIN)/ruff format --no-cache --check .
	@echo "mypy runs beside the tests"; log=$$(mktemp); $(BIN)/mypy >$$log 2>&1 & types=$$!; \
	OMP_WAIT_POLICY=PASSIVE OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile \
	  --no-loadscope-reorder $(TESTS); tests=$$?; \
	wait $$types || { cat $$log; test $$tests -ne 0 || tests=1; }; \
	rm -f $$log; \
	exit $$tests

bench: $(READY)
	@$(BIN)/python tests/benchmarks/bench_ledger.py $(BENCH)

PORT ?= 5000
ui: $(READY)
	@$(BIN)/wheretolook log-release
	@$(BIN)/wheretolook ui --port $(PORT)

lab: $(READY)
	@test -x $(BIN)/jupyter-lab || $(PIP) -c $(CONSTRAINTS) -e '.[notebooks]'
	$(BIN)/jupyter lab notebooks

notebooks: $(READY)
	OMP_WAIT_POLICY=PASSIVE $(BIN)/python notebooks/execute.py $(NOTEBOOKS)

results: $(READY)
	@$(BIN)/python -m wheretolook_paper.studies.results $(if $(MESHES),--meshes $(MESHES)) \
	  $(if $(PHOTOGRAPHS),--photographs $(PHOTOGRAPHS))

docs: $(READY)
	$(BIN)/mkdocs build --strict

setup: $(READY)

$(READY): pyproject.toml $(CONSTRAINTS) Makefile
	@test -n "$(PYTHON)" || { echo "wheretolook needs Python 3.11, 3.12 or 3.13: sudo apt-get install python3 python3-venv" >&2; exit 1; }
	@missing=""; \
	for pair in libusb-1.0.so.0=libusb-1.0-0 libGL.so.1=libgl1 libgomp.so.1=libgomp1; do \
	  ldconfig -p 2>/dev/null | grep -q "$${pair%%=*}" || missing="$$missing $${pair##*=}"; done; \
	if [ -n "$$missing" ]; then \
	  echo "installing system libraries:$$missing"; \
	  if [ "$$(id -u)" = 0 ]; then as=""; else as="sudo -n"; fi; \
	  { $$as apt-get update -qq && $$as env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq $$missing; } >/dev/null 2>&1 || \
	  { echo "system libraries are missing, install them with: sudo apt-get install$$missing" >&2; exit 1; }; fi
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || \
	  { rm -rf $(VENV); echo "cannot make a virtual environment: sudo apt-get install python3-venv" >&2; exit 1; }
	@echo "installing Python packages into $(VENV) (a few minutes the first time)"
	@$(MAKE) --no-print-directory torch-$(TORCH)
	@$(PIP) -c $(CONSTRAINTS) -e '.[test]'
	@rm -f $(VENV)/ready-*; touch $@

# The index in use may carry CPU builds itself; if not, uv knows where PyTorch keeps them; the CUDA build runs on a CPU too.
.PHONY: torch-cpu torch-cuda
torch-cpu:
	@$(BIN)/python -c 'import torch, sys; sys.exit(torch.__version__.split("+")[0] != "$(TORCH_VERSION)")' 2>/dev/null || \
	$(PIP) 'torch==$(TORCH_VERSION)+cpu' 2>/dev/null || \
	{ $(PIP) uv && $(BIN)/uv pip install --quiet --python $(BIN)/python --torch-backend cpu 'torch==$(TORCH_VERSION)'; } 2>/dev/null || \
	$(PIP) 'torch==$(TORCH_VERSION)'

torch-cuda:
	@$(BIN)/python -c 'import torch, sys; sys.exit(torch.version.cuda is None)' 2>/dev/null || \
	{ $(BIN)/python -m pip uninstall --quiet --yes torch; $(PIP) 'torch==$(TORCH_VERSION)'; }

clean:
	rm -rf $(VENV) build dist site .pytest_cache .ruff_cache .mypy_cache
