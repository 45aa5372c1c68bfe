"""Notebooks are pairs without outputs, run as they are on a tiny release, and become small pages."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import jupytext
import nbformat
import pytest
from nbclient import NotebookClient
from pages import main

from synthetic_release import make_release
from wheretolook.tracking.config import TrackingConfig
from wheretolook.tracking.runs import newest_run

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
OF_THE_RELEASE = {
    "01_pipeline": 2,
    "02_sampling": 3,
    "03_inputs": 4,
    "04_training": 6,
    "07_planning": 4,
    "09_your_own_map": 2,
    "10_looks": 2,
}
"""Notebooks that need the release that ships, and how many pictures each draws."""

FROM_RUNS = {"05_tables": 4, "06_top_n": 2, "08_runtimes": 1}
"""Notebooks that need nothing but logged runs, and how many pictures they draw."""


@pytest.fixture(scope="module")
def release(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a tiny release beside an empty store."""
    return make_release(tmp_path_factory.mktemp("notebooks") / "data" / "release").root


@pytest.fixture
def environment(release: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What kernels need to find that release and the import path of the tests; the store."""
    store = release.parents[1] / "mlruns"
    monkeypatch.setenv("WHERETOLOOK_RELEASE", str(release))
    monkeypatch.setenv("WHERETOLOOK_MLRUNS", str(store))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(entry for entry in sys.path if entry))
    return store


def outputs(notebook: nbformat.NotebookNode, mime: str) -> list[str]:
    data = [output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", [])]
    return [entry[mime] for entry in data if mime in entry]


def test_each_script_has_its_notebook() -> None:
    assert {*FROM_RUNS, *OF_THE_RELEASE} == {path.stem for path in NOTEBOOKS}
    assert {path.stem for path in FOLDER.glob("[0-9]*.py")} == {path.stem for path in NOTEBOOKS}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_stripped_and_paired(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in notebook.cells)
    text = jupytext.read(path.with_suffix(".py"))
    assert [(cell.cell_type, cell.source) for cell in notebook.cells] == [
        (cell.cell_type, cell.source) for cell in text.cells
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", FROM_RUNS)
def test_notebooks_of_runs_draw_them(name: str, environment: Path) -> None:
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(FOLDER)}}).execute()
    assert len(outputs(notebook, "image/png")) == FROM_RUNS[name]
    assert newest_run(TrackingConfig(str(environment)), "evaluate", params={"dataset": "release"}) is not None
    if name == "05_tables":
        assert sum("68.7" in text for text in outputs(notebook, "text/html")) == 1
        assert any("Localization score" in text for text in outputs(notebook, "text/markdown"))


@pytest.mark.slow
@pytest.mark.parametrize("name", OF_THE_RELEASE)
def test_notebooks_of_the_release_run_from_top_to_bottom(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WHERETOLOOK_MLRUNS", str(tmp_path / "mlruns"))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(entry for entry in sys.path if entry))
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    NotebookClient(notebook, timeout=180, resources={"metadata": {"path": str(FOLDER)}}).execute()
    assert len(outputs(notebook, "image/png")) == OF_THE_RELEASE[name]
    if name == "04_training":
        assert any("fully connected 4500 × 300" in text for text in outputs(notebook, "text/html"))


def test_pages_are_small_and_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(entry for entry in sys.path if entry))
    folder = tmp_path / "notebooks"
    folder.mkdir()
    (folder / "01_one.py").write_text(
        "# %% [markdown]\n# # One & all\n# - ![a_picture](images/one.webp), _[elsewhere](https://example.org)_\n# ## Part\n\n"
        "# %%\n# %matplotlib inline\nimport sys\nfrom IPython.display import display\n"
        "from matplotlib.figure import Figure\nprint('1 < 2')\nprint('std' + 'error', file=sys.stderr)\n"
        "figure = Figure()\nfigure.subplots().plot([0, 1])\ndisplay(figure)\n"
    )
    (folder / "02_broken.py").write_text("# %%\nraise ValueError('no such thing')\n")
    assert main([str(folder), str(tmp_path / "html")]) == 1
    assert "02_broken: ValueError: no such thing" in capsys.readouterr().err
    first, page = sorted((tmp_path / "html").iterdir(), reverse=True)
    assert first.name == "index.html" and page.name == "01_one.html"
    text = page.read_text()
    assert "<h1>One &amp; all</h1>" in text and "1 &lt; 2" in text and "stderror" not in text
    assert 'src="../images/one.webp"' in text and 'href="https://example.org"' in text
    assert text.count("data:image/webp;base64,") == 1 and len(text) < 40_000
    assert '<a href="01_one.html" aria-current="page">' in text and 'href="index.html">Notebooks' in text
    assert '<h2 id="section-1">Part</h2>' in text and '<a href="#section-1">Part</a>' in text
    assert 'href="index.html" rel="prev"' in text and 'href="02_broken.html" rel="next"' in text
    assert '<meta name="viewport"' in text and 'alt="a_picture, elsewhere"' in text
    text = first.read_text()
    assert '<a href="01_one.html">One &amp; all</a>' in text and "02_broken" not in text
    assert text.count("data:image/webp;base64,") == 1
