"""Catalog of figures and tables: the logged run that each is drawn from, and the command that makes this run.

To add one, decorate a function from `Source` to a figure, or to texts by file suffix, with `@item`: its name, its number
in the paper, its content and notebook, the run and file that it needs, and the command that makes that run.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
from matplotlib.figure import Figure

from wheretolook.dataset.layout import Dataset
from wheretolook.evaluation.config import CALIBRATION_CSV, SCORES_CSV
from wheretolook.evaluation.results import read_scores
from wheretolook.evaluation.statistics import read_calibration
from wheretolook.figures.floor_plan import save_figure
from wheretolook.scorers.weights import load_scorer
from wheretolook.tracking import TrackingConfig, artifact, client, finished_runs, kept_if_not_logged
from wheretolook.training.provenance import HISTORY_CSV
from wheretolook.utils.errors import ConfigError, MissingRunError, WhereToLookError
from wheretolook.utils.files import write_text
from wheretolook.utils.texts import markdown_table
from wheretolook_paper.evaluation.looks import LOOKS_CSV
from wheretolook_paper.evaluation.score_report import comparisons_markdown, score_markdown
from wheretolook_paper.figures.looks import looks_figure
from wheretolook_paper.figures.network import inputs_figure, learning_figure, peaks_figure
from wheretolook_paper.figures.paths import (
    COMMAND,
    methods_figure,
    paths_figure,
    photograph_paths_figure,
    read_photograph_paths,
)
from wheretolook_paper.figures.pipeline import pipeline_figure
from wheretolook_paper.figures.runtimes import runtime_figure, scaling_figure
from wheretolook_paper.figures.sampling import fibonacci_figure, sampling_figure
from wheretolook_paper.figures.scores import (
    calibration_figure,
    occlusion_figure,
    regret_figure,
    score_figure,
    top_n_figure,
    training_figure,
)
from wheretolook_paper.paths.path_report import PATHS_CSV
from wheretolook_paper.release.copy import is_release, read_about
from wheretolook_paper.release.mlp_architecture import paper_architecture_table
from wheretolook_paper.release.runs import RUNTIMES_CSV, SCALING_CSV
from wheretolook_paper.release.showcase import (
    Learning,
    Showcase,
    learning_of,
    open_showcase,
    peaks_of,
    pipeline_of,
    planned_views,
    sampling_of,
)
from wheretolook_paper.release.training_histories import histories, method_of_run, train_runs
from wheretolook_paper.styles import PAPER_NETWORKS

if TYPE_CHECKING:
    from mlflow.entities import Run


Texts = Mapping[str, str]
"""A table: its text by file suffix, such as "md"."""


@dataclass(frozen=True)
class Source:
    """Input of an item: its dataset and the newest runs that it needs."""

    dataset: Dataset
    tracking: TrackingConfig
    runs: tuple[Run, ...]

    def file(self, name: str) -> Path:
        """Return the path of an artifact of the first run."""
        return artifact(self.tracking, self.runs[0].info.run_id, name)


Drawer = Callable[[Source], Figure | Texts]


@dataclass(frozen=True)
class Item:
    """A figure or a table.

    Attributes:
        name: name of its files.
        paper: its number in the paper, such as "Table 2"; "" if the paper has none.
        what: its content in a few words.
        notebook: the notebook that shows it.
        draw: draws it.
        stage: stage of the required run; "" for none.
        file: required artifact of the run.
        command: makes such a run; {config} stands for the dataset's configuration, {source} for that of the dataset
            that a release was copied from.
        params: required parameters of the run; "{dataset}" stands for the dataset's name.
        of_release: whether only a release has it, because it shows a regenerated scene or results on other datasets.
        of_source: whether a run of the dataset that a release was copied from is accepted.
    """

    name: str
    paper: str
    what: str
    notebook: str
    draw: Drawer
    stage: str = "evaluate"
    file: str = SCORES_CSV
    command: str = "wheretolook evaluate --config {config}"
    params: tuple[tuple[str, str], ...] = (("dataset", "{dataset}"),)
    of_release: bool = False
    of_source: bool = False

    def runs(self, dataset: Dataset, tracking: TrackingConfig) -> tuple[Run, ...]:
        """Return the newest run that it can be drawn from; of train runs the newest of each method."""
        found: dict[str, Run] = {}
        for name in (dataset.name, *([_source_of(dataset)] if self.of_source else [])):
            params = {key: value.format(dataset=name) for key, value in self.params}
            if self.stage == "train":
                trained = train_runs(tracking, params["dataset"], params.get("method", ""), self.file)
            else:
                runs = finished_runs(tracking, self.stage, params=params, file=self.file) if self.stage else ()
                trained = (("", run) for run in runs)
            for method, run in trained:
                found.setdefault(method, run)
        return tuple(found.values())

    def command_for(self, dataset: Dataset) -> str:
        """Return the command that makes the missing run."""
        return self.command.format(config=f"configs/{dataset.name}.yaml", source=f"configs/{_source_of(dataset)}.yaml")


def _source_of(dataset: Dataset) -> str:
    """Return the name of the dataset that a release was copied from; of another dataset, its own."""
    return str(read_about(dataset)["source"]) if is_release(dataset) else dataset.name


ITEMS: list[Item] = []
"""All items: the paper's in its order, then further ones."""


def item(name: str, paper: str, what: str, notebook: str, **needs: Any) -> Callable[[Drawer], Drawer]:
    """Register a function as an item; `needs` are the fields of `Item` that describe its run."""

    def register(draw: Drawer) -> Drawer:
        ITEMS.append(Item(name, paper, what, notebook, draw, **needs))
        return draw

    return register


def _table_figure(
    draw: Callable[[pd.DataFrame], Figure], file: str = SCORES_CSV, read: Callable[[Path], pd.DataFrame] = read_scores
) -> Drawer:
    """Return a function that draws the table in an artifact."""
    return lambda source: draw(read(source.file(file)))


def _paper_table(name: str) -> Drawer:
    return lambda source: {ending: source.file(f"table_{name}.{ending}").read_text() for ending in ("md", "csv", "tex")}


_open = lru_cache(maxsize=1)(open_showcase)


def _shown(source: Source, weights: str = "") -> tuple[Showcase, Any, int]:
    """Return the first test scene of a release, a scorer, and an instructive location."""
    showcase = _open(source.dataset)
    scorer = load_scorer(showcase.localization_map, source.dataset.root / "weights" / weights)
    return showcase, scorer, showcase.instructive_location()


def _walkthrough(source: Source) -> Learning:
    return learning_of(*_shown(source, f"{method_of_run(source.runs[0])}.safetensors"))


def _trained(method: str, command: str, **more: Any) -> dict[str, Any]:
    """Return the needs of an item drawn from the train run of a method."""
    params = (("dataset", "{dataset}"), ("method", method))
    return {"stage": "train", "file": "", "command": command, "params": params, **more}


_TRAIN = "wheretolook train --config {config}"
_SET = _trained("set", "wheretolook demo --config configs/cameras.yaml", of_release=True)
_NETWORK = _trained("mlp-2d+z", _TRAIN, of_release=True)
_WIDEST = _trained("mlp-2d+3d", f"{_TRAIN} --train.methods '[mlp-2d+3d]'")
_NO_RUN = {"stage": "", "file": ""}
_LOG_RELEASE = "wheretolook log-release --config {config}"
_BENCH = "python tests/benchmarks/bench_visibility.py"


def _measured(file: str, options: str = "") -> dict[str, Any]:
    command = f"{_BENCH}{options} --out cpu.json && {_BENCH} --draw cpu.json --log"
    return {"stage": "benchmark", "file": file, "command": command, "params": ()}


@item("pipeline", "Fig. 1", "from a map to the camera that is turned", "01_pipeline", **_SET)
def _pipeline(source: Source) -> Figure:
    return pipeline_figure(pipeline_of(*_shown(source)))


@item("learning", "Fig. 2", "a view on its way through the network", "03_inputs", **_NETWORK)
def _learning(source: Source) -> Figure:
    return learning_figure(*_walkthrough(source))


@item(
    "viewpoint_generation",
    "Fig. 3",
    "voxels, directions, occlusion",
    "02_sampling",
    **_NO_RUN,
    command=_LOG_RELEASE,
    of_release=True,
)
def _sampling(source: Source) -> Figure:
    showcase = _open(source.dataset)
    return sampling_figure(sampling_of(showcase, showcase.instructive_location()))


@item("spherical_sampling", "Fig. 4", "lattices of directions", "02_sampling", **_NO_RUN)
def _lattices(source: Source) -> Figure:
    return fibonacci_figure()


@item("architecture", "Table 1", "layers of the network", "04_training", **_WIDEST)
def _architecture(source: Source) -> Texts:
    params = {method_of_run(run): run.data.params for run in source.runs}
    networks = [params[name] for name in PAPER_NETWORKS if name in params]
    if not networks:
        raise ConfigError("none of the paper's networks was trained")
    table = paper_architecture_table(networks[-1])  # that of most inputs, the paper's proposal
    return {
        "md": markdown_table(list(table.columns), table.to_numpy().tolist()) + "\n",
        "csv": table.to_csv(index=False),
        "tex": table.to_latex(index=False),
    }


item("table_vs_others", "Table 2", "all methods", "05_tables", file="table_vs_others.md")(_paper_table("vs_others"))


@item("planning", "Fig. 5", "the same way by three methods", "07_planning", **_SET)
def _planning(source: Source) -> Figure:
    showcase = _open(source.dataset)
    return methods_figure(planned_views(showcase, source.dataset), showcase.localization_map.landmarks.points)


@item(
    "planning_photographs",
    "Fig. 5",
    "planning on maps of photographs",
    "07_planning",
    **_NO_RUN,
    command=COMMAND,
    of_release=True,
)
def _planning_photographs(source: Source) -> Figure:
    return photograph_paths_figure(*read_photograph_paths(source.dataset))


item(
    "paths",
    "Fig. 5",
    "planned paths that localize",
    "07_planning",
    stage="paths",
    file=PATHS_CSV,
    command="wheretolook compare-paths --config {source}",
    of_source=True,
)(_table_figure(paths_figure, PATHS_CSV, pd.read_csv))
item("runtimes", "Fig. 6", "times of the visibility check", "08_runtimes", **_measured(RUNTIMES_CSV))(
    _table_figure(runtime_figure, RUNTIMES_CSV, pd.read_csv)
)
item("table_input_variants", "Table 3", "inputs of the network", "05_tables", file="table_input_variants.md")(
    _paper_table("input_variants")
)
item("top_n", "Fig. 7", "several viewpoints of a location", "06_top_n")(_table_figure(top_n_figure))


@item("inputs", "", "from an image to an input", "03_inputs", **_NETWORK)
def _inputs(source: Source) -> Figure:
    return inputs_figure(_walkthrough(source).image)


@item("peaks", "", "directions with high and low scores", "04_training", **_SET)
def _peaks(source: Source) -> Figure:
    return peaks_figure(*peaks_of(*_shown(source)))


@item("training", "", "learning curves", "04_training", stage="train", file=HISTORY_CSV, command=_TRAIN)
def _training(source: Source) -> Figure:
    return training_figure(histories(source.tracking, source.dataset.name))


item("calibration", "", "reliability of predicted probabilities", "04_training", file=CALIBRATION_CSV)(
    _table_figure(calibration_figure, CALIBRATION_CSV, read_calibration)
)
item("scores", "", "all methods at all thresholds", "05_tables")(_table_figure(score_figure))


@item("score_table", "", "all numbers of an evaluation", "05_tables")
def _score_table(source: Source) -> Texts:
    scores = read_scores(source.file(SCORES_CSV))
    return {"md": f"{score_markdown(scores)}\n{comparisons_markdown(scores)}", "csv": scores.to_csv(index=False)}


item("regret", "", "what each method loses", "05_tables")(_table_figure(regret_figure))
item("occlusion", "", "what seeing through walls changes", "05_tables")(_table_figure(occlusion_figure))
item(
    "regret_interiors",
    "",
    "what each loses on scenes by others",
    "05_tables",
    command=_LOG_RELEASE,
    params=(("dataset", "interiors"),),
    of_release=True,
)(_table_figure(regret_figure))
item(
    "looks",
    "",
    "several looks localized together",
    "10_looks",
    stage="looks",
    file=LOOKS_CSV,
    command="wheretolook evaluate --config {config} # of labels made with --label.store_pixels true",
)(_table_figure(looks_figure, LOOKS_CSV, pd.read_csv))
item("visibility_scaling", "", "how time and memory grow", "08_runtimes", **_measured(SCALING_CSV, " --scaling"))(
    _table_figure(scaling_figure, SCALING_CSV, pd.read_csv)
)


def catalog_text() -> str:
    """Format the catalog: name, number in the paper, content, notebook, stage of the run."""
    rows = [[item.name, item.paper or "–", item.what, item.notebook, item.stage or "–"] for item in ITEMS]
    return markdown_table(["name", "paper", "shows", "notebook", "run"], rows)


def check_names(names: Collection[str]) -> None:
    """Raise ConfigError for unknown items."""
    unknown = set(names) - {item.name for item in ITEMS}
    if unknown:
        raise ConfigError("unknown figure", value=sorted(unknown), fix="`wheretolook figures --list` names them.")


def write_items(
    dataset: Dataset,
    tracking: TrackingConfig,
    out: Path,
    only: Collection[str] = (),
    kinds: Sequence[str] = ("png",),
    say: Callable[[str], None] = print,
) -> dict[str, str]:
    """Write all items of a dataset to a folder, or those named in `only`, and attach them to their runs.

    Figures are written as several kinds of files. Files name the runs that they were drawn from: figures in their
    metadata, Markdown and TeX in a comment. Returns, for each item that could not be made, the command to run first, or
    the error. Raises as `check_names`.
    """
    check_names(only)
    missing = {}
    for item in ITEMS:
        if only and item.name not in only:
            continue
        if item.of_release and not is_release(dataset):
            if item.name in only:
                missing[item.name] = "wheretolook figures --config configs/release.yaml"
            say(f"{item.name}: only releases have it")
            continue
        try:
            runs = item.runs(dataset, tracking)
            if item.stage and not runs:
                raise MissingRunError(item.command_for(dataset))
            content = item.draw(Source(dataset, tracking, runs))
        except WhereToLookError as error:
            missing[item.name] = str(error)
            say(f"{item.name}: {'no such run; first: ' if isinstance(error, MissingRunError) else ''}{error}")
            continue
        ids = [run.info.run_id for run in runs]
        files = _write(item.name, content, f"runs: {', '.join(ids)} ({item.stage})" if ids else "", out, kinds)
        with kept_if_not_logged(f"{item.name} in {out}"):
            for run_id in ids:
                for file in files:
                    client(tracking).log_artifact(run_id, str(file), "figures")
        say(f"{item.name}: -> {', '.join(map(str, files))}")
    return missing


def _write(name: str, content: Figure | Texts, note: str, out: Path, kinds: Sequence[str]) -> list[Path]:
    if isinstance(content, Figure):
        files = [out / f"{name}.{kind}" for kind in kinds]
        for file in files:
            save_figure(content, file, note)
        return files
    comments = {"md": f"\n<!-- {note} -->\n", "tex": f"% {note}\n"} if note else {}
    for ending, text in content.items():
        write_text(out / f"{name}.{ending}", text + comments.get(ending, ""))
    return [out / f"{name}.{ending}" for ending in content]
