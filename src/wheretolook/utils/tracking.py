"""Where runs are logged: an MLflow store of one SQLite file and one folder of artifacts, both in one place.

`wheretolook.utils.tracking_layout` says which experiment a run goes to and how it is named, and
`wheretolook.utils.tracking_store` makes and opens the store.

MLflow keeps absolute paths of artifacts. A store that was moved stays readable here, since a run's artifacts lie in a
folder named by its id; MLflow's UI shows those of earlier runs only at the old place.
"""

from __future__ import annotations

import hashlib
import json
import math
import shlex
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheretolook.utils.errors import MissingRunError, TrackingError
from wheretolook.utils.tracking_config import TrackingConfig
from wheretolook.utils.tracking_layout import experiment_name, note_of, run_name, views_of
from wheretolook.utils.tracking_store import opened_client
from wheretolook.utils.version import VERSION

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mlflow import MlflowClient
    from mlflow.entities import Experiment, Run

Values = Mapping[str, Any] | None  # parameters or metrics by name
Tags = Mapping[str, str] | None  # tags by name, or the texts that MLflow keeps of parameters

STAGE_TAG = "stage"
"""Tag of every run this package logs: "label", "train", "evaluate", "plan", "paths", "learners" or "benchmark"."""

PARENT_TAG = "mlflow.parentRunId"  # tag by which MLflow knows what run another is nested in
FINGERPRINT_TAG = "fingerprint"  # of what a run was made from and what came out, see `fingerprint_of`
LAYOUT_TAG = "made_by"  # of experiments of a dataset and purpose, not of other programs
LAYOUT = "wheretolook"
OLD_EXPERIMENT = "wheretolook"  # all runs lay here before datasets and purposes had experiments of their own
KIND_TAG = "mlflow.experimentKind"  # MLflow then opens on the table of runs
KIND = "custom_model_development"
AT_ONCE = 800  # metrics logged at a time: MLflow takes 1000 of metrics and parameters together
PAGE = 50  # runs searched at a time


def client(tracking: TrackingConfig) -> MlflowClient:
    """A client of the store, which is made if there is none. What fails in it raises a TrackingError."""
    return opened_client(tracking)


def experiments(mlflow_client: MlflowClient, tracking: TrackingConfig) -> list[Experiment]:
    """All experiments with runs of the store, also with those logged at another place or by earlier versions."""
    name = tracking.experiment or OLD_EXPERIMENT
    return [
        experiment
        for experiment in mlflow_client.search_experiments()
        if experiment.name == name
        or experiment.name.startswith(f"{name} at ")
        or (not tracking.experiment and experiment.tags.get(LAYOUT_TAG) == LAYOUT)
    ]


def experiment_ids(mlflow_client: MlflowClient, tracking: TrackingConfig) -> list[str]:
    """Ids of `experiments`."""
    return [str(experiment.experiment_id) for experiment in experiments(mlflow_client, tracking)]


def experiment_id(mlflow_client: MlflowClient, tracking: TrackingConfig, stage: str, dataset: str = "") -> str:
    """Id of the experiment that new runs of a stage about a dataset go to, which is created if there is none.

    An experiment keeps the absolute path that its artifacts go to. In a store that was moved, new runs therefore go to
    another experiment, named after the new place; likewise where the experiment was deleted, as MLflow keeps its name.
    """
    layout = experiment_name(stage, dataset)
    tags = {KIND_TAG: KIND} | ({} if tracking.experiment else {LAYOUT_TAG: LAYOUT, **views_of(stage)})
    name = tracking.experiment or layout
    elsewhere = f"{name} at {tracking.root}"
    for candidate in chain((name, elsewhere), (f"{elsewhere} {number}" for number in count(2))):
        known = mlflow_client.get_experiment_by_name(candidate)  # also a deleted one
        if known is None:
            location = tracking.artifacts
            made = str(mlflow_client.create_experiment(candidate, artifact_location=location, tags=tags))
            if not tracking.experiment:
                mlflow_client.set_experiment_tag(made, "mlflow.note.content", note_of(stage, made))
            return made
        if known.lifecycle_stage == "active" and known.artifact_location == tracking.artifacts:
            return str(known.experiment_id)
    raise AssertionError  # there is always another name


@contextmanager
def start_run(
    tracking: TrackingConfig, what: str, stage: str, params: Values = None, tags: Tags = None
) -> Iterator[tuple[MlflowClient, str]]:
    """Open a run, and close it as finished, failed (any exception) or killed (Ctrl-C).

    The run is named by `what` was run, its stage, such as "train", and the parameter `dataset`, if there is one; these
    two decide its experiment. The stage is stored as a tag beside `tags`. Yields the client and the run's id, for
    `client.log_metric(run_id, ...)` and its kin.
    """
    mlflow_client = client(tracking)
    dataset = str((params or {}).get("dataset", ""))
    all_tags = {STAGE_TAG: stage, **code_version(), **(tags or {})}
    experiment = experiment_id(mlflow_client, tracking, stage, dataset)
    with _open_run(mlflow_client, experiment, run_name(what, stage, dataset), all_tags) as run_id:
        log(mlflow_client, run_id, params)
        yield mlflow_client, run_id


@contextmanager
def _open_run(mlflow_client: MlflowClient, experiment: str, name: str, tags: Mapping[str, str]) -> Iterator[str]:
    run_id = str(mlflow_client.create_run(experiment, tags=dict(tags), run_name=name).info.run_id)
    try:
        yield run_id
    except BaseException as error:
        with suppress(TrackingError):  # the error that ends the run says more
            mlflow_client.set_terminated(run_id, status="KILLED" if isinstance(error, KeyboardInterrupt) else "FAILED")
        raise
    mlflow_client.set_terminated(run_id, status="FINISHED")


def log(mlflow_client: MlflowClient, run_id: str, params: Values = None, metrics: Values = None, step: int = 0) -> None:
    """Log parameters and metrics of a run, in few transactions. Metrics that are not finite are left out."""
    from mlflow.entities import Metric, Param

    now = int(time.time() * 1000)
    numbers = [Metric(key, float(v), now, step) for key, v in (metrics or {}).items() if math.isfinite(v)]
    texts = [Param(key, str(value)) for key, value in (params or {}).items()]
    for begin in range(0, max(len(numbers), 1), AT_ONCE):
        mlflow_client.log_batch(run_id, numbers[begin : begin + AT_ONCE], texts if begin == 0 else [])


@dataclass(frozen=True)
class NestedRun:
    """A run within another, before it is logged: what was run, parameters, metrics and files."""

    what: str  # and under which conditions, see `wheretolook.utils.tracking_layout.joined`
    params: Mapping[str, Any]
    metrics: Mapping[str, float]
    files: Sequence[Path] = ()


def log_nested(tracking: TrackingConfig, parent: str, stage: str, runs: Iterable[NestedRun], tags: Tags = None) -> None:
    """Log finished runs of a stage within another one, whose id is `parent`; all get the same tags.

    MLflow needs 25 ms for a run and 0.3 ms for a metric (`tests/benchmarks/bench_tracking.py`): hundreds of runs take
    half a minute. Each is logged when the one before is done. Metrics that are not finite are left out.
    """
    mlflow_client = client(tracking)
    experiment = str(mlflow_client.get_run(parent).info.experiment_id)
    all_tags = {STAGE_TAG: stage, **code_version(), **(tags or {}), PARENT_TAG: parent}
    for run in runs:
        name = run_name(run.what, stage, str(run.params.get("dataset", "")))
        with _open_run(mlflow_client, experiment, name, all_tags) as run_id:
            log(mlflow_client, run_id, run.params, run.metrics)
            for file in run.files:
                mlflow_client.log_artifact(run_id, str(file))


def newest_run(
    tracking: TrackingConfig, stage: str, tags: Tags = None, params: Tags = None, file: str = ""
) -> Run | None:
    """The newest finished top-level run of a stage, or None. Does not create a store.

    The run must have these tags and parameters, and this file as an artifact ("" for any run).
    """
    return next(finished_runs(tracking, stage, tags, params, file), None)


def finished_runs(
    tracking: TrackingConfig, stage: str, tags: Tags = None, params: Tags = None, file: str = ""
) -> Iterator[Run]:
    """All finished top-level runs of a stage, the newest first; see `newest_run`."""
    if not (tracking.root / "mlflow.db").exists():
        return
    mlflow_client = client(tracking)
    searched = experiment_ids(mlflow_client, tracking)
    query = f"tags.{STAGE_TAG} = '{stage}' AND tags.`{PARENT_TAG}` IS NULL AND attributes.status = 'FINISHED'"
    order = ["attributes.start_time DESC"]
    token: str | None = None
    while searched and token != "":
        page = mlflow_client.search_runs(searched, query, max_results=PAGE, order_by=order, page_token=token)
        for run in page:
            fits = all(run.data.tags.get(key) == str(value) for key, value in (tags or {}).items())
            fits &= all(run.data.params.get(key) == str(value) for key, value in (params or {}).items())
            if fits and (not file or artifact(tracking, run.info.run_id, file).is_file()):
                yield run
        token = page.token or ""


def fingerprint_of(params: Mapping[str, Any], *results: str) -> str:
    """16 hexadecimal digits that change with any parameter of a run, as MLflow keeps it, and any of its results."""
    texts = {str(name): str(value) for name, value in params.items()}
    return hashlib.sha256(json.dumps([sorted(texts.items()), *results]).encode()).hexdigest()[:16]


def logged_last(tracking: TrackingConfig, stage: str, dataset: str, fingerprint: str, file: str) -> str | None:
    """Id of the newest finished run of a stage about a dataset if it has this fingerprint and this file, or None.

    Then there is nothing new to log. An older run with the fingerprint does not count: what reads the newest run, as
    figures do, must find this one.
    """
    run = newest_run(tracking, stage, params={"dataset": dataset})
    if run is None or run.data.tags.get(FINGERPRINT_TAG) != fingerprint:
        return None
    return str(run.info.run_id) if artifact(tracking, run.info.run_id, file).is_file() else None


def newest_artifact(tracking: TrackingConfig, stage: str, file: str, dataset: str = "") -> Path:
    """An artifact of the newest finished top-level run of a stage that has it, about a dataset, or about any ("").

    Raises MissingRunError if there is no such run.
    """
    run = newest_run(tracking, stage, params={"dataset": dataset} if dataset else None, file=file)
    if run is None:
        fix = "`wheretolook figures` tells which command makes it, `wheretolook log-release` logs what ships."
        raise MissingRunError(f"there is no run of {stage} with {file}", path=tracking.root, fix=fix)
    return artifact(tracking, run.info.run_id, file)


def artifact(tracking: TrackingConfig, run_id: str, path: str) -> Path:
    """Local path of an artifact of a run, wherever the store lay when the run was logged."""
    return Path(tracking.artifacts) / run_id / "artifacts" / path


def ui_command(tracking: TrackingConfig) -> str:
    """The shell line that opens MLflow's UI on the store."""
    program = Path(sys.executable).with_name("mlflow")
    if not program.exists():
        program = Path("mlflow")
    elif program.is_relative_to(Path.cwd()):
        program = program.relative_to(Path.cwd())
    store = tracking.root / "mlflow.db"
    if store.is_relative_to(Path.cwd()):  # three slashes and a relative path
        store = store.relative_to(Path.cwd())
    return f"{program} ui --backend-store-uri {shlex.quote(f'sqlite:///{store}')}"


@cache
def code_version() -> dict[str, str]:
    """Version of this package and, in a checkout, the git commit ("+" appended when files differ from it)."""
    version = {"code_version": VERSION}
    here = Path(__file__).resolve().parents[1]

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(here), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout

    with suppress(OSError, subprocess.SubprocessError):
        top, commit = git("rev-parse", "--show-toplevel", "HEAD").split("\n")[:2]
        # an installed copy may lie inside an unrelated checkout (a virtual environment does)
        if here == Path(top) / "src" / "wheretolook":
            changed = git("status", "--porcelain", "--untracked-files=no").strip()
            version["git_commit"] = commit + ("+" if changed else "")
    return version
