"""Logs runs to an MLflow store and finds them again.

A run is named `<what>[, <condition>]... (<stage> <dataset>)`, such as "set, mesh, best 100 (evaluate release)": MLflow
cuts long names, so what distinguishes runs comes first. MLflow stores absolute artifact paths. If a store was moved,
its runs are still found here, since the artifacts of a run are in a folder named by its id; MLflow's UI does not show
the artifacts of earlier runs."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import re
import shlex
import subprocess
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from itertools import chain, count
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any, cast

from wheretolook.utils.errors import MissingRunError, StorageError, TrackingError, TrackingWarning, no_option
from wheretolook.utils.files import copy_file, storage_errors, temporary_folder, write_json
from wheretolook.utils.package import VERSION
from wheretolook.utils.processes import hold

if TYPE_CHECKING:
    import pandas as pd
    from mlflow import MlflowClient
    from mlflow.entities import Run


@dataclass(frozen=True)
class TrackingConfig:
    """Where runs are logged.

    Args:
        folder: folder of the MLflow store. Created when needed; holds `mlflow.db` and `artifacts/`.
        experiment: name of one MLflow experiment for all runs; by default, each dataset and purpose has its own, such
            as `release: evaluation`.
    """

    folder: str = "mlruns"
    experiment: str = no_option("")

    @property
    def root(self) -> Path:
        """Absolute path of the store's folder."""
        return Path(self.folder).expanduser().resolve()

    @property
    def uri(self) -> str:
        """Tracking URI of the store."""
        return f"sqlite:///{self.root / 'mlflow.db'}"

    @property
    def artifacts(self) -> str:
        """Artifact location of the experiments."""
        return str(self.root / "artifacts")


_FIX = "Repair or move the store, or name another folder: --tracking.folder FOLDER."


def check_store(tracking: TrackingConfig) -> None:
    """Raise TrackingError unless the store can be opened and has room for another megabyte; create it if missing.

    To be called before hours of work whose result is then logged.
    """
    client(tracking)
    with store_errors(tracking.root):
        artifacts = Path(tracking.artifacts)
        artifacts.mkdir(exist_ok=True)
        if not os.access(tracking.root / "mlflow.db", os.W_OK):
            raise TrackingError("the store is read-only", path=tracking.root / "mlflow.db", fix=_FIX)
        for folder in (tracking.root, artifacts):
            with storage_errors(folder), TemporaryFile(dir=folder) as file:
                file.write(bytes(2**20))


def client(tracking: TrackingConfig) -> MlflowClient:
    """Return a client of the store, which is created if missing; its methods raise TrackingError."""
    return _client(tracking.root, tracking.uri)


@contextmanager
def kept_if_not_logged(what: str, note: Path | None = None, content: Any = None) -> Iterator[None]:
    """Warn instead of raising a TrackingError in this block, which logs results that are already on disk.

    `note` is an optional JSON file with `content`, which exists until the results are logged.
    """
    if note is not None:
        write_json(note, content)
    try:
        yield
    except TrackingError as error:
        warn_not_logged(what, error)
    else:
        if note is not None:
            note.unlink(missing_ok=True)


def warn_not_logged(what: str, error: TrackingError) -> None:
    """Warn that results are on disk but not logged, and how to log them later."""
    later = "Fix that and run the stage again: it logs the missing results."
    text = f"{what}: saved, but not logged: {error.path}: {error.problem}. {later}"
    warnings.warn(text, TrackingWarning, stacklevel=3)


@cache
def _client(root: Path, uri: str) -> MlflowClient:
    database = root / "mlflow.db"
    # characters that SQLAlchemy interprets in the path of a database
    misread = re.search(r"\?|%[0-9a-fA-F]{2}", str(root))
    if misread:
        fix = "Name another folder: --tracking.folder FOLDER."
        raise TrackingError("MLflow misreads the path of this folder", path=root, value=misread[0], fix=fix)
    with store_errors(root):
        if not database.exists():
            _create(database)
        wrapped = mlflow_package().MlflowClient(tracking_uri=uri)
        wrapped.search_experiments(max_results=1)
    return cast("MlflowClient", _Client(root, wrapped))


def _create(database: Path) -> None:
    """Create an empty store in a temporary folder and move it into place, by one process at a time."""
    with storage_errors(database):
        database.parent.mkdir(parents=True, exist_ok=True)
    # another process creates it in 4 s on two cores
    with hold(database.with_name(".making.lock"), "creating the MLflow store", wait_s=60.0):
        if database.exists():
            return
        with temporary_folder() as folder:
            new = folder / "mlflow.db"
            mlflow_package().MlflowClient(tracking_uri=f"sqlite:///{new}").search_experiments(max_results=1)
            copy_file(new, database)


@contextmanager
def store_errors(root: Path) -> Iterator[None]:
    """Re-raise OS errors and errors of MLflow, SQLAlchemy and SQLite in this block as TrackingErrors of one line."""
    try:
        yield
    except TrackingError:
        raise
    except StorageError as error:
        raise TrackingError(error.problem, path=error.path, value=error.value, fix=_FIX) from error
    except OSError as error:
        path = error.filename if isinstance(error.filename, str) else root
        raise TrackingError(f"the store cannot be used: {error.strerror or error}", path=path, fix=_FIX) from error
    except Exception as error:
        if type(error).__module__.partition(".")[0] not in ("mlflow", "sqlalchemy", "sqlite3", "alembic"):
            raise
        first_line = (str(error).splitlines() or [""])[0] or type(error).__name__
        problem = f"the store cannot be used: {first_line.rstrip('.')}"
        raise TrackingError(problem, path=root / "mlflow.db", fix=_FIX) from error


class _Client:
    """MlflowClient whose methods raise TrackingErrors, and which copies artifacts atomically."""

    def __init__(self, root: Path, wrapped: MlflowClient) -> None:
        self._root = root
        self._wrapped = wrapped

    def log_artifact(self, run_id: str, local_path: str, artifact_path: str = "") -> None:
        """Copy a file to the artifacts of a run."""
        source = Path(local_path)
        with store_errors(self._root):
            copy_file(source, self._root / "artifacts" / run_id / "artifacts" / artifact_path / source.name)

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._wrapped, name)

        def call(*arguments: Any, **options: Any) -> Any:
            with store_errors(self._root):
                return method(*arguments, **options)

        return call


@cache
def mlflow_package() -> Any:
    """Import MLflow when first needed, without telemetry, notes on migrations and retries of a broken store."""
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
    import mlflow
    from mlflow.store.db import utils

    utils.MAX_RETRY_COUNT = 1
    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.WARNING)
    return mlflow


Values = Mapping[str, Any] | None
"""Parameters or metrics by name."""

Tags = Mapping[str, str] | None
"""Tags by name."""

STAGE_TAG = "stage"
"""Tag of every run: "label", "train", "evaluate", "plan", "paths", "learners" or "benchmark"."""

PARENT_TAG = "mlflow.parentRunId"
FINGERPRINT_TAG = "fingerprint"
"""Tag with the `fingerprint_of` of a run's parameters and results."""

BEST_TAG = "best"
"""Tag of a run that compares methods or learners: the one whose metrics the run itself has."""

REGRET = "1_regret"
SHARE = "1_share"
AUC = "1_auc"
"""Metrics to sort runs by: the first view chosen (N = 1), at the strictest threshold. MLflow orders columns by name,
digits first."""

ALL_METHODS = "all methods"
"""What a comparison of methods runs."""


_MADE_BY = "made_by"  # tag of experiments of a dataset and purpose


def experiment_name(stage: str, dataset: str) -> str:
    """Return the name of the experiment of a stage's runs on a dataset, such as "release: evaluation"; "" for no dataset."""
    purposes = {
        "evaluate": "evaluation",
        "train": "training",
        "adapt": "adapting",
        "plan": "plans",
        "label": "labels",
        "benchmark": "benchmarks",
    }
    return ": ".join(filter(None, (dataset, purposes.get(stage, stage))))


def run_name(what: str, stage: str, dataset: str) -> str:
    """Return the name of a run; `what` is what was run, with its conditions (see `joined`)."""
    return f"{what} ({' '.join(filter(None, (stage, dataset)))})"


def joined(what: str, *conditions: str) -> str:
    """Join what was run and its non-empty conditions by commas."""
    return ", ".join(filter(None, (what, *conditions)))


def experiment_ids(mlflow_client: MlflowClient, tracking: TrackingConfig) -> list[str]:
    """Return the ids of this package's experiments in the store, also of those logged before the store was moved."""
    name = tracking.experiment
    ids = []
    for experiment in mlflow_client.search_experiments():
        named = experiment.name == name or experiment.name.startswith(f"{name} at ")
        if named if name else experiment.tags.get(_MADE_BY) == "wheretolook":
            ids.append(str(experiment.experiment_id))
    return ids


def experiment_id(mlflow_client: MlflowClient, tracking: TrackingConfig, stage: str, dataset: str = "") -> str:
    """Return the id of the experiment for new runs of a stage on a dataset, which is created if missing.

    An experiment keeps the absolute path of its artifacts. In a store that was moved, new runs therefore go to another
    experiment, named after the new path; likewise if the experiment was deleted, since MLflow keeps its name.
    """
    name = tracking.experiment or experiment_name(stage, dataset)
    moved_name = f"{name} at {tracking.root}"
    for candidate in chain((name, moved_name), (f"{moved_name} {number}" for number in count(2))):
        known = mlflow_client.get_experiment_by_name(candidate)  # also a deleted one
        if known is None:
            break
        if known.lifecycle_stage == "active" and known.artifact_location == tracking.artifacts:
            return str(known.experiment_id)
    tags = {"mlflow.experimentKind": "custom_model_development"}  # lets MLflow open the table of runs
    if not tracking.experiment:
        tags[_MADE_BY] = "wheretolook"
    created = str(mlflow_client.create_experiment(candidate, artifact_location=tracking.artifacts, tags=tags))
    if not tracking.experiment:
        # functions (stage, experiment_id) -> tags that describe a new experiment
        for entry_point in entry_points(group="wheretolook.experiment_notes"):
            for tag, text in entry_point.load()(stage, created).items():
                mlflow_client.set_experiment_tag(created, tag, text)
    return created


@contextmanager
def start_run(
    tracking: TrackingConfig, what: str, stage: str, params: Values = None, tags: Tags = None
) -> Iterator[tuple[MlflowClient, str]]:
    """Open a run, and close it as finished, failed (any exception) or killed (Ctrl-C).

    The run's name is made of `what` was run, its stage, such as "train", and the parameter `dataset`, if there is one;
    the latter two select its experiment. Yields the client and the run's id, for `client.log_metric(run_id, ...)` etc.
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
        with suppress(TrackingError):  # the error that ends the run is more informative
            mlflow_client.set_terminated(run_id, status="KILLED" if isinstance(error, KeyboardInterrupt) else "FAILED")
        raise
    mlflow_client.set_terminated(run_id, status="FINISHED")


def log(
    mlflow_client: MlflowClient, run_id: str, params: Values = None, metrics: Values = None, files: Iterable[Path] = ()
) -> None:
    """Log parameters, metrics and files of a run. Metrics that are not finite are skipped."""
    log_metrics(mlflow_client, run_id, [(0, metrics or {})])
    if params:
        param = mlflow_package().entities.Param
        texts = [param(key, str(value)) for key, value in params.items()]
        mlflow_client.log_batch(run_id, params=texts)
    for file in files:
        mlflow_client.log_artifact(run_id, str(file))


def log_history(mlflow_client: MlflowClient, run_id: str, history: pd.DataFrame) -> None:
    """Log a training history, one row per `epoch`, as training itself logs it."""
    rows = history.drop(columns="epoch").to_dict("records")
    log_metrics(mlflow_client, run_id, zip(map(int, history["epoch"]), rows, strict=True))


def log_metrics(mlflow_client: MlflowClient, run_id: str, steps: Iterable[tuple[int, Mapping[Any, Any]]]) -> None:
    """Log metrics of steps in batches. Metrics that are not finite are skipped."""
    metric = mlflow_package().entities.Metric
    now = int(time.time() * 1000)
    metrics = []
    for step, values in steps:
        metrics += [metric(str(name), float(v), now, step) for name, v in values.items() if math.isfinite(v)]
    at_once = 800  # MLflow takes 1000 metrics and parameters together
    for begin in range(0, len(metrics), at_once):
        mlflow_client.log_batch(run_id, metrics=metrics[begin : begin + at_once])


@dataclass(frozen=True)
class NestedRun:
    """A run within another, before it is logged: what was run, parameters, metrics and files."""

    what: str  # with its conditions, see `joined`
    params: Mapping[str, Any]
    metrics: Mapping[str, float]
    files: Sequence[Path] = ()


def log_nested(tracking: TrackingConfig, parent: str, stage: str, runs: Iterable[NestedRun], tags: Tags = None) -> None:
    """Log finished runs of a stage within the run with id `parent`, all with the same tags.

    MLflow needs 25 ms for a run and 0.3 ms for a metric (measured with SQLite): hundreds of runs take
    half a minute.
    """
    mlflow_client = client(tracking)
    experiment = str(mlflow_client.get_run(parent).info.experiment_id)
    all_tags = {STAGE_TAG: stage, **code_version(), **(tags or {}), PARENT_TAG: parent}
    for run in runs:
        name = run_name(run.what, stage, str(run.params.get("dataset", "")))
        with _open_run(mlflow_client, experiment, name, all_tags) as run_id:
            log(mlflow_client, run_id, run.params, run.metrics, run.files)


def newest_run(
    tracking: TrackingConfig, stage: str, tags: Tags = None, params: Tags = None, file: str = ""
) -> Run | None:
    """Return the newest of `finished_runs`, or None."""
    return next(finished_runs(tracking, stage, tags, params, file), None)


def finished_runs(
    tracking: TrackingConfig, stage: str, tags: Tags = None, params: Tags = None, file: str = ""
) -> Iterator[Run]:
    """Yield the finished top-level runs of a stage, newest first; none if there is no store.

    Only runs with these tags and parameters, and with `file` as an artifact ("" for any run).
    """
    if not (tracking.root / "mlflow.db").exists():
        return
    mlflow_client = client(tracking)
    searched = experiment_ids(mlflow_client, tracking)
    query = f"tags.{STAGE_TAG} = '{stage}' AND tags.`{PARENT_TAG}` IS NULL AND attributes.status = 'FINISHED'"
    order = ["attributes.start_time DESC"]
    token: str | None = None
    while searched and token != "":
        page = mlflow_client.search_runs(searched, query, max_results=50, order_by=order, page_token=token)
        for run in page:
            matches = all(run.data.tags.get(key) == str(value) for key, value in (tags or {}).items())
            matches &= all(run.data.params.get(key) == str(value) for key, value in (params or {}).items())
            if matches and (not file or artifact(tracking, run.info.run_id, file).is_file()):
                yield run
        token = page.token or ""


def fingerprint_of(params: Mapping[str, Any], *results: str) -> str:
    """Return 16 hexadecimal digits that change with any parameter of a run, as MLflow stores it, and any of its results."""
    texts = {str(name): str(value) for name, value in params.items()}
    return hashlib.sha256(json.dumps([sorted(texts.items()), *results]).encode()).hexdigest()[:16]


def logged_last(tracking: TrackingConfig, stage: str, dataset: str, fingerprint: str, file: str) -> str | None:
    """Return the id of the newest finished run of a stage on a dataset if it has this fingerprint and file, or None.

    Then there is nothing new to log. An older run with the fingerprint does not count, since figures read the newest.
    """
    run = newest_run(tracking, stage, params={"dataset": dataset})
    if run is None or run.data.tags.get(FINGERPRINT_TAG) != fingerprint:
        return None
    return str(run.info.run_id) if artifact(tracking, run.info.run_id, file).is_file() else None


def newest_artifact(tracking: TrackingConfig, stage: str, file: str, dataset: str = "") -> Path:
    """Return an artifact of the newest finished top-level run of a stage that has it, on a dataset or on any ("").

    Raises MissingRunError if there is no such run.
    """
    run = newest_run(tracking, stage, params={"dataset": dataset} if dataset else None, file=file)
    if run is None:
        fix = "`wheretolook figures` lists the command that makes it; `wheretolook log-release` logs the release."
        raise MissingRunError(f"there is no run of {stage} with {file}", path=tracking.root, fix=fix)
    return artifact(tracking, run.info.run_id, file)


def artifact(tracking: TrackingConfig, run_id: str, path: str) -> Path:
    """Return the local path of an artifact of a run, also after the store was moved."""
    return Path(tracking.artifacts) / run_id / "artifacts" / path


def ui_command(tracking: TrackingConfig) -> str:
    """Return the shell command that opens MLflow's UI on the store."""
    return f"wheretolook ui --tracking.folder {shlex.quote(tracking.folder)}"


@cache
def code_version() -> dict[str, str]:
    """Return the version of this package and, in a checkout, the git commit ("+" appended when files differ from it)."""
    version = {"code_version": VERSION}
    here = Path(__file__).resolve().parent

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(here), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout

    with suppress(OSError, subprocess.SubprocessError):
        top, commit = git("rev-parse", "--show-toplevel", "HEAD").split("\n")[:2]
        # an installed copy may be inside an unrelated checkout (a virtual environment is)
        if here == Path(top) / "src" / "wheretolook":
            changed = git("status", "--porcelain", "--untracked-files=no").strip()
            version["git_commit"] = commit + ("+" if changed else "")
    return version
