"""Regenerate pictures of the documentation from the release: figures of the catalog and pages of MLflow.

    python -m wheretolook_paper.studies.pictures

The pages need Chromium; without it, they stay as they are.
"""

from __future__ import annotations

import io
import json
import socket
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

TABLES = {
    "docs/images/mlflow-methods.webp": ("release: evaluation", "methods"),
    "docs/images/mlflow-top-n.webp": ("release: evaluation", "top-n"),
    "docs/images/mlflow-inputs.webp": ("release: training", "trained"),
}
"""Experiment and saved view of each picture of a table."""

TABLE_SIZE = 1200, 620
PLOT_SIZE = 1075, 575
SCATTER_SIZE = 1075, 610
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
        ("learner", "learnt_from"),
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
    with socket.create_server((ADDRESS, 0)) as probe:
        port = probe.getsockname()[1]
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
        if chromium() is None:
            print("pages of MLflow: left as they are, there is no Chromium; install it: apt-get install chromium")
        else:
            draw_pages(tracking, Path(folder, "browser"))


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
