"""The notebooks run as they are, on a store that a tiny evaluation has filled, and say so if there is none."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import jupytext
import nbformat
import pytest
from nbclient import NotebookClient

from synthetic_dataset import make_dataset
from wheretolook.evaluation import EvaluateConfig, evaluate
from wheretolook.tracking import TrackingConfig

SCORES = "01_score_table_and_lattices"

OF_THE_RELEASE = {
    "01_pipeline": 2,
    "02_sampling": 3,
    "03_inputs": 4,
    "04b_what_the_network_sees": 4,
    "09_your_own_map": 2,
}
"""Notebooks that need nothing but the release that ships, and how many pictures each shows."""

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


NOTEBOOK = {path.stem: path for path in NOTEBOOKS}


def execute(path: Path, monkeypatch: pytest.MonkeyPatch, store: Path) -> nbformat.NotebookNode:
    """Run a notebook in its own folder with the interpreter and the import path of the tests."""
    monkeypatch.setenv("WHERETOLOOK_MLRUNS", str(store))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(entry for entry in sys.path if entry))
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(path.parent)}}).execute()
    return notebook


def outputs(notebook: nbformat.NotebookNode, mime: str) -> list[str]:
    data = [output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", [])]
    return [entry[mime] for entry in data if mime in entry]


def test_there_are_notebooks() -> None:
    assert [path.stem for path in NOTEBOOKS] == sorted([SCORES, *OF_THE_RELEASE])


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_stripped_and_paired(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in notebook.cells)
    text = jupytext.read(path.with_suffix(".py"))
    assert [cell.source for cell in notebook.cells] == [cell.source for cell in text.cells]


def test_score_notebook_draws_the_newest_evaluation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = make_dataset(tmp_path / "tiny", ("test",), n_locations=6, n_directions=10)
    store = tmp_path / "mlruns"
    config = EvaluateConfig(methods=("random", "bins"), resamples=50)
    evaluate(dataset, config, TrackingConfig(str(store)), progress=False)
    notebook = execute(NOTEBOOK[SCORES], monkeypatch, store)
    assert len(outputs(notebook, "image/png")) == 2
    (table,) = outputs(notebook, "text/markdown")
    assert (dataset.root / "results" / "scores.md").read_text().split("\n")[2:] == table.split("\n")[2:]


def test_score_notebook_says_what_to_run_without_a_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notebook = execute(NOTEBOOK[SCORES], monkeypatch, tmp_path / "nothing")
    assert len(outputs(notebook, "image/png")) == 1
    (message,) = outputs(notebook, "text/markdown")
    assert "make demo" in message
    assert not (tmp_path / "nothing").exists()


@pytest.mark.parametrize("name", OF_THE_RELEASE)
def test_notebooks_of_the_release_run_from_top_to_bottom(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    notebook = execute(NOTEBOOK[name], monkeypatch, tmp_path / "nothing")
    assert len(outputs(notebook, "image/png")) == OF_THE_RELEASE[name]
    printed = [output for cell in notebook.cells for output in cell.get("outputs", []) if "name" in output]
    assert [output["text"] for output in printed if output["name"] == "stderr"] == []


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_cells_are_short(path: Path) -> None:
    cells = [cell.source.splitlines() for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    assert path.stem == SCORES or max(len(lines) for lines in cells[1:]) <= 6  # behind the imports
