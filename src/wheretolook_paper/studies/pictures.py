"""Regenerate pictures of the documentation from the release: figures, and pages of MLflow and the viewer.

    python -m wheretolook_paper.studies.pictures

The pages need Chromium, the viewer's also the scene of the film (`wheretolook_paper.studies.results`); without these, they
stay as they are.
"""

from __future__ import annotations

import base64
import io
import json
import re
import socket
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import urlencode

from jsonargparse import auto_cli
from matplotlib.figure import Figure
from matplotlib.style import context
from PIL import Image

from wheretolook.dataset.layout import Dataset
from wheretolook.figures.floor_plan import RC
from wheretolook.tracking import TrackingConfig, client
from wheretolook_paper.commands.log_release import log_release
from wheretolook_paper.commands.ui import ADDRESS, NAME, serving
from wheretolook_paper.experiment_notes import experiment_link
from wheretolook_paper.release.catalog import ITEMS, Source
from wheretolook_paper.studies.browser import Browser, Tab, chromium

FIGURES = {
    "notebooks/images/pipeline.webp": ("pipeline", 1829),
    "notebooks/images/paths.webp": ("paths", 1618),
    "notebooks/images/occlusion.webp": ("occlusion", 1298),
    "notebooks/images/runtimes.webp": ("runtimes", 978),
    "notebooks/images/visibility-scaling.webp": ("visibility_scaling", 1186),
    "docs/images/bins.webp": ("inputs", 960),
    "docs/images/directions.webp": ("spherical_sampling", 960),
    "docs/images/sampling.webp": ("viewpoint_generation", 960),
}
"""Item of the catalog and width in pixels of each picture."""

NOTEBOOK_FIGURES = {"docs/images/looks.webp": ("notebooks/10_looks.ipynb", "story_figure(shown")}
"""Notebook, and text of the cell, whose output is the picture."""

VIEWED = Path("data/film/apartment-210")
VIEWER_STATE = "n=5;place=0.35,-1.52,1.45"

TABLES = {
    "docs/images/mlflow-methods.webp": ("release: evaluation", "methods"),
    "docs/images/mlflow-top-n.webp": ("release: evaluation", "top-n"),
    "docs/images/mlflow-inputs.webp": ("release: training", "trained"),
}
"""Experiment and saved view of each picture of a table."""

TABLE_SIZE = 1200, 620
PLOT_SIZE = 1075, 575
SCATTER_SIZE = 1075, 610
VIEWER_SIZE = 1700, 960  # wide enough that the panel at the right leaves the scene in the middle free
LOAD_S = 180  # until a page is complete
LEFT, TOP = 206, 14
"""Where the pages of MLflow begin, right of its menu."""


@dataclass(frozen=True)
class Plot:
    """A comparison of runs: their experiment and filter, and the axes; of a scatter plot, metrics x and y."""

    experiment: str
    search: str
    metrics: tuple[str, ...]
    parameters: tuple[str, ...] = ()


_METHODS = (
    'tags.stage = "evaluate" and params.dataset = "release" and params.candidates = "all" and '
    'params.method != "oracle" and metrics.`1_auc` > 0.45'
)
PLOTS = {
    "mlruns/images/parallel.webp": Plot(
        "release: evaluation", _METHODS, ("1_regret", "1_share", "1_auc"), ("occlusion",)
    ),
    "mlruns/images/scatter.webp": Plot(
        "release: evaluation", f'{_METHODS} and params.occlusion = "mesh"', ("1_auc", "1_regret")
    ),
    "mlruns/images/learners.webp": Plot(
        "release: learners",
        'params.learner != ""',
        ("average_precision_validation", "regret_others"),
        ("learner", "trained_on"),
    ),
}


def draw_figures(dataset: Dataset, tracking: TrackingConfig) -> None:
    """Write `FIGURES`; those without a run stay as they are."""
    for path, (name, width) in FIGURES.items():
        (item,) = (item for item in ITEMS if item.name == name)
        runs = item.runs(dataset, tracking)
        if item.stage and not runs:
            print(f"{path}: left as it is; first: {item.command_for(dataset)}")
            continue
        drawn = io.BytesIO()
        with context(RC):
            figure = item.draw(Source(dataset, tracking, runs))
            assert isinstance(figure, Figure)
            figure.savefig(drawn, dpi=300)
        image = Image.open(drawn).convert("RGB")
        image.resize((width, round(image.height * width / image.width))).save(path, quality=65, method=6)
        print(path, flush=True)


def draw_pages(tracking: TrackingConfig, profile: Path) -> None:
    """Write `TABLES` and `PLOTS`, as MLflow shows them in a browser."""
    ids = {found.name: found.experiment_id for found in client(tracking).search_experiments()}
    port = _free_port()
    server = f"http://{NAME}:{port}/"
    with serving(tracking, port), closing(Browser(profile, (LEFT + TABLE_SIZE[0] + TOP, 700))) as browser:
        for path, (experiment, view) in TABLES.items():
            tab = browser.open(server + experiment_link(ids[experiment], view))
            tab.wait(lambda tab: "matching runs" in tab.text and "\n0 matching" not in tab.text, LOAD_S)
            _save(tab, path, TABLE_SIZE)
        browser.size = (LEFT + PLOT_SIZE[0] + TOP, 700)
        for path, plot in PLOTS.items():
            experiment = ids[plot.experiment]
            runs = [run.info.run_id for run in client(tracking).search_runs([experiment], plot.search)]
            compared = urlencode({"runs": json.dumps(runs), "experiments": json.dumps([experiment])})
            tab = browser.open(f"{server}#/compare-runs?{compared}")
            tab.wait(lambda tab: "Clear All" in tab.text, LOAD_S)
            if plot.parameters:
                _choose_axes(tab, plot)
                _save(tab, path, PLOT_SIZE)
            else:
                _choose_scatter(tab, plot)
                _save(tab, path, SCATTER_SIZE)


def draw_notebook_figures() -> None:
    """Write `NOTEBOOK_FIGURES`."""
    for path, (notebook, text) in NOTEBOOK_FIGURES.items():
        cells = json.loads(Path(notebook).read_text(encoding="utf-8"))["cells"]
        (cell,) = (cell for cell in cells if text in "".join(cell["source"]))
        (output,) = cell["outputs"]
        image = Image.open(io.BytesIO(base64.b64decode(output["data"]["image/png"])))
        image.convert("RGB").save(path, quality=75, method=6)
        print(path, flush=True)


def draw_viewer(profile: Path) -> None:
    """Write the picture of the viewer, once it has scored the floor and a location."""
    if not VIEWED.is_dir():
        print("the viewer: left as it is; first: python -m wheretolook_paper.studies.results --only '[film]'")
        return
    port = _free_port()
    scene = ("--scene", VIEWED.name, "--name", VIEWED.parent.name)
    command = [sys.executable, "-m", "wheretolook", "view", *scene, "--port", str(port), "--state", VIEWER_STATE]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            next(line for line in server.stdout if line.startswith("http"))
            with closing(Browser(profile, VIEWER_SIZE)) as browser:
                tab = browser.open(f"http://localhost:{port}")
                done = r"(\d+) of \1 locations[\s\S]* landmarks in view"
                tab.wait(lambda tab: re.search(done, tab.text) is not None, 4 * LOAD_S)  # scores the floor
                time.sleep(2)
                tab.evaluate("document.querySelectorAll('.mantine-Notification-root').forEach(e => e.remove())")
                width, height = VIEWER_SIZE
                margin = 340  # left of the scene
                tab.save(Path("docs/images/viewer.webp"), margin, 0, width - margin, height)
        finally:
            server.terminate()


def _free_port() -> int:
    with socket.create_server((ADDRESS, 0)) as probe:
        return int(probe.getsockname()[1])


def _wait_for(tab: Tab, name: str, part: str) -> None:
    """Wait until a part of a list, such as its highlighted option, has this text."""
    script = f"[...document.querySelectorAll('.du-bois-light-select-{part}')].map(e => e.innerText.trim())"
    tab.wait(lambda tab: name in tab.evaluate(script))


def _choose_axes(tab: Tab, plot: Plot) -> None:
    tab.press("Clear All")
    for index, names in enumerate((plot.parameters, plot.metrics)):
        tab.click_on(".du-bois-light-select-selector", index)
        for name in names:
            tab.call("Input.insertText", text=name)  # filters the list
            _wait_for(tab, name, "item-option-active")
            tab.key("Enter", 13)
            _wait_for(tab, name, "selection-item-content")
        tab.key("Escape", 27)


def _choose_scatter(tab: Tab, plot: Plot) -> None:
    tab.press("Scatter Plot")
    for axis, name in zip("xy", plot.metrics, strict=True):
        tab.click_on(f"#{axis}-axis-selector")
        tab.press(name)


def _save(tab: Tab, path: str, size: tuple[int, int]) -> None:
    tab.click(LEFT + 400, TOP + 50)  # closes lists
    time.sleep(2)
    tab.save(Path(path), LEFT, TOP, *size)
    print(path, flush=True)


def main(release: Path = Path("data/release")) -> None:
    """Write all pictures.

    Args:
        release: folder of the release.
    """
    dataset = Dataset.load(release)
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        tracking = TrackingConfig(f"{folder}/mlruns")
        log_release(dataset, tracking, attach=False)
        draw_figures(dataset, tracking)
        draw_notebook_figures()
        if chromium() is None:
            print("pages: left as they are, there is no Chromium; install it: apt-get install chromium")
        else:
            draw_viewer(Path(folder, "viewer"))
            draw_pages(tracking, Path(folder, "browser"))


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
