"""Notebooks carry the outputs of their scripts, small and without traces of a machine, and these are today's."""

import base64
import io
import os
import re
import sys
from html import unescape
from pathlib import Path

import jupytext
import nbformat
import pytest
from execute import WIDEST_PX, execute, main
from PIL import Image

from wheretolook_paper.release.notebook import open_store

FOLDER = Path(__file__).parents[1] / "notebooks"
SCRIPTS = sorted(FOLDER.glob("[0-9]*.py"))
MEASURED = ("09_your_own_map", "10_looks")
"""Notebooks that map and localize: their numbers may differ in the last digits between machines."""

by_name = pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)


def outputs(notebook):
    return [output for cell in notebook.cells for output in cell.get("outputs", [])]


def pictures(notebook):
    found = [output.data["image/png"] for output in outputs(notebook) if "image/png" in output.get("data", {})]
    return [Image.open(io.BytesIO(base64.b64decode(content))) for content in found]


def texts(notebook):
    """What the outputs say, without tags and styles of tables."""
    parts = [text for output in outputs(notebook) for text in (output.get("text"), *output.get("data", {}).values())
             if text is not None and "image/png" not in output.get("data", {})]  # fmt: skip
    plain = [re.sub(r"<style.*?</style>|<[^>]+>", " ", part, flags=re.S) for part in parts]
    return [" ".join(unescape(part).split()) for part in plain]


def numbers(text):
    return [float(number.replace(",", "")) for number in re.findall(r"-?\d[\d,]*\.?\d*", text)]


@by_name
def test_notebooks_have_outputs_and_the_text_of_their_scripts(script):
    notebook = nbformat.read(script.with_suffix(".ipynb"), as_version=4)
    nbformat.validate(notebook)
    text = jupytext.read(script)
    assert [(cell.cell_type, cell.source) for cell in notebook.cells] == [
        (cell.cell_type, cell.source) for cell in text.cells
    ]
    assert all(cell.execution_count for cell in notebook.cells if cell.cell_type == "code")
    assert pictures(notebook) and all(picture.width <= WIDEST_PX for picture in pictures(notebook))
    assert not any(output.output_type == "error" or output.get("name") == "stderr" for output in outputs(notebook))


@by_name
def test_notebooks_have_no_trace_of_a_machine(script):
    content = script.with_suffix(".ipynb").read_text()
    assert re.findall(r"(?<![\w./])/(?:home|root|tmp|work|usr|var|Users|private)/[^\s\"]*", content) == []
    assert re.findall(r"[A-Z]:\\\\|\bat 0x[0-9a-f]+|iopub|widget-view", content) == []


def test_notebooks_are_small_together():
    assert sum(path.stat().st_size for path in FOLDER.glob("*.ipynb")) < 6_000_000


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Return a store of the release's runs."""
    folder = tmp_path_factory.mktemp("notebooks") / "mlruns"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(FOLDER)
        patch.setenv("WHERETOLOOK_MLRUNS", str(folder))
        open_store()
    return folder


@pytest.mark.slow
@by_name
def test_outputs_are_those_of_todays_results(script, store, monkeypatch):
    monkeypatch.setenv("WHERETOLOOK_MLRUNS", str(store))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(entry for entry in sys.path if entry))
    stored = nbformat.read(script.with_suffix(".ipynb"), as_version=4)
    today = execute(script)
    assert len(pictures(today)) == len(pictures(stored))
    if script.stem not in MEASURED:
        assert texts(today) == texts(stored), f"stale: make notebooks NOTEBOOKS={script.stem}"
    for new, old in zip(map(numbers, texts(today)), map(numbers, texts(stored)), strict=True):
        assert new == pytest.approx(old, rel=0.05, abs=0.01), f"stale: make notebooks NOTEBOOKS={script.stem}"


def test_execution_keeps_figures_and_text_and_names_what_fails(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(entry for entry in sys.path if entry))
    monkeypatch.setenv("WHERETOLOOK_MLRUNS", str(tmp_path))
    monkeypatch.setattr("execute.FOLDER", tmp_path)
    (tmp_path / "01_one.py").write_text(
        "# %% [markdown]\n# # One\n\n# %%\n# %matplotlib inline\nimport sys\nimport pandas as pd\n"
        "from IPython.display import display\nfrom matplotlib.figure import Figure\n"
        "print('1 < 2')\nprint('std' + 'error', file=sys.stderr)\nfigure = Figure(figsize=(30, 10))\n"
        "figure.subplots().plot([0, 1])\ndisplay(figure)\npd.DataFrame({'a': [0.25]}).style.format(precision=1)\n"
    )
    (tmp_path / "02_broken.py").write_text("# %%\nraise ValueError('no such thing')\n")
    assert main([]) == 1
    assert "02_broken: " in capsys.readouterr().err and not (tmp_path / "02_broken.ipynb").exists()
    once = (tmp_path / "01_one.ipynb").read_bytes()
    notebook = nbformat.reads(once.decode(), as_version=4)
    (picture,) = pictures(notebook)
    assert picture.width == WIDEST_PX and picture.height == pytest.approx(WIDEST_PX / 3, rel=0.05)
    assert texts(notebook)[0] == "1 < 2" and numbers(texts(notebook)[1])[-1] == 0.2
    assert main(["01_one"]) == 0 and main(["1_one"]) == 2
    assert (tmp_path / "01_one.ipynb").read_bytes() == once  # nothing differs between executions
