"""Notebooks are pairs without outputs, run as they are on a tiny release, and become small pages."""

from __future__ import annotations

import base64
import io
import os
import sys
from pathlib import Path

import jupytext
import nbformat
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from nbclient import NotebookClient
from pages import main, notebook_page, small_picture, small_table
from PIL import Image

from synthetic_release import make_release
from wheretolook.scorers.styles import MethodStyle, method_style
from wheretolook.tracking.config import TrackingConfig
from wheretolook.tracking.runs import newest_run

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
OF_THE_RELEASE = {
    "01_pipeline": 2,
    "02_sampling": 3,
    "03_inputs": 4,
    "04_training": 6,
    "07_planning": 3,
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
        "# %% [markdown]\n# # One & all\n# - ![a_picture](images/one.webp), _[elsewhere](https://example.org)_\n\n"
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
    assert 'href="02_broken.html"' in text and 'href="index.html">All notebooks' in text
    assert '<meta name="viewport"' in text and 'alt="a_picture, elsewhere"' in text
    text = first.read_text()
    assert '<a href="01_one.html">One &amp; all</a>' in text and "02_broken" not in text
    assert text.count("data:image/webp;base64,") == 1


def test_pictures_keep_their_colours_in_less_space() -> None:
    colors = [tuple(round(255 * value) for value in to_rgb(style.color)) for style in known_styles()]
    pixels = np.full((40, 20 * len(colors), 4), 255, np.uint8)
    for number, color in enumerate(colors):
        pixels[10:, 20 * number : 20 * (number + 1)] = (*color, 255)
    pixels[:5] = 0  # transparent
    small, n_bytes = shrunk(pixels)
    assert [small.getpixel((20 * number + 10, 20)) for number in range(len(colors))] == colors
    assert small.getpixel((10, 2)) == (255, 255, 255) and n_bytes[1] < n_bytes[0] / 20
    x = np.linspace(0, 255, 900)
    photograph = np.stack([x[:, None] * np.ones(900), np.ones((900, 1)) * x, np.full((900, 900), 128.0)], axis=-1)
    photograph += np.random.default_rng(0).normal(0, 8, photograph.shape)
    photograph = photograph.clip(0, 255).astype(np.uint8)
    small, n_bytes = shrunk(photograph)
    assert n_bytes[1] < n_bytes[0] / 10 and np.abs(np.asarray(small, dtype=float) - photograph).mean() < 8


def known_styles() -> list[MethodStyle]:
    names = ("oracle", "random", "forward", "visible", "bins", "max-visibility", "max-visibility-swapped", "set",
             "trees", "conv", "sphere", "mlp-2d", "mlp-2d+z", "mlp-2d+3d", "expected-bins", "fisher-trace-gp",
             "fisher-logdet-exact", "fisher-mineig-quadratic")  # fmt: skip
    return [method_style(name) for name in names]


def shrunk(pixels: np.ndarray) -> tuple[Image.Image, tuple[int, int]]:
    """The picture, and its bytes before and after."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG", compress_level=0)
    kind, _, content = small_picture(base64.b64encode(stream.getvalue()).decode()).partition(",")
    assert kind == "data:image/webp;base64"
    small = base64.b64decode(content)
    return Image.open(io.BytesIO(small)).convert("RGB"), (len(stream.getvalue()), len(small))


def test_cells_of_tables_keep_the_names_that_their_style_speaks_of() -> None:
    style = "<style>#T_1 th.col_heading { color: red } #T_1_row0_col1 { font-weight: bold }</style>"
    head = '<th id="T_1_a" class="col_heading level0" >a</th>'
    cell = '<td id="T_1_b" class="data" >1</td>'
    bold = '<td id="T_1_row0_col1" class="data col1" >2</td>'
    assert small_table(f'{style}<table id="T_1"><tr class="x">{head}{cell}{bold}</tr></table>') == (
        f'{style}<table id="T_1"><tr><th class="col_heading">a</th><td>1</td><td id="T_1_row0_col1">2</td></tr></table>'
    )


def test_a_page_shows_tables_once() -> None:
    table = nbformat.v4.new_output("display_data", {"text/html": "<b>told</b>", "text/plain": "told"})
    widget = {"application/vnd.jupyter.widget-view+json": {}, "text/plain": "plan: 0%"}
    bar = nbformat.v4.new_output("display_data", widget)
    cells = [nbformat.v4.new_code_cell("x", outputs=[bar, table])]
    page = notebook_page(nbformat.v4.new_notebook(cells=[nbformat.v4.new_markdown_cell("# a page"), *cells]))
    assert "plan: 0%" not in page
    assert page.count("<b>told</b>") == page.count("told") == 1 and "<title>a page</title>" in page
