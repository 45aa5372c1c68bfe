"""Where runs are logged: an MLflow store of one SQLite file and one folder of artifacts, both in one place.

MLflow writes absolute artifact paths into its database (it resolves relative ones against the current folder), so a
moved store would point at the old place. `client` notices that and rewrites the paths.
"""

from __future__ import annotations

import logging
import math
import os
import shlex
import sqlite3
import subprocess
import sys
import time
import uuid
from collections.abc import Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheretolook.utils.errors import MissingRunError
from wheretolook.utils.version import VERSION

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mlflow import MlflowClient
    from mlflow.entities import Run

STAGE_TAG = "stage"
"""Tag of every run this package logs: "label", "train", "evaluate", "plan", "paths", "learners" or "benchmark"."""


@dataclass(frozen=True)
class TrackingConfig:
    """Where runs are logged.

    Args:
        folder: folder of the MLflow store, holding `mlflow.db` and `artifacts/`. Made when needed.
        experiment: name of the MLflow experiment that the runs belong to.
    """

    folder: str = "mlruns"
    experiment: str = "wheretolook"

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
        """Artifact location of the experiment."""
        return str(self.root / "artifacts")


def client(tracking: TrackingConfig) -> MlflowClient:
    """A client of the store, which is made if there is none and repaired if it was moved."""
    tracking.root.mkdir(parents=True, exist_ok=True)
    mlflow_client: MlflowClient = _mlflow().MlflowClient(tracking_uri=tracking.uri)
    experiment = mlflow_client.get_experiment_by_name(tracking.experiment)
    if experiment is not None and experiment.artifact_location != tracking.artifacts:
        _relocate(tracking, experiment.artifact_location)
    return mlflow_client


def experiment_id(mlflow_client: MlflowClient, tracking: TrackingConfig) -> str:
    """Id of the experiment, which is created if there is none."""
    experiment = mlflow_client.get_experiment_by_name(tracking.experiment)
    if experiment is not None:
        return str(experiment.experiment_id)
    return str(mlflow_client.create_experiment(tracking.experiment, artifact_location=tracking.artifacts))


@contextmanager
def start_run(
    tracking: TrackingConfig,
    name: str,
    stage: str,
    params: Mapping[str, Any] | None = None,
    parent: str | None = None,
    tags: Mapping[str, str] | None = None,
) -> Iterator[tuple[MlflowClient, str]]:
    """Open a run, and close it as finished, failed (any exception) or killed (Ctrl-C).

    Args:
        tracking: the store.
        name: name of the run in the UI.
        stage: such as "train" or "evaluate", stored as a tag.
        params: parameters to log.
        parent: id of the run this one is nested under.
        tags: further tags.

    Yields:
        The client and the run's id, for `client.log_metric(run_id, ...)` and its kin.
    """
    mlflow_client = client(tracking)
    all_tags = {STAGE_TAG: stage, **code_version(), **(tags or {})}
    if parent is not None:
        all_tags["mlflow.parentRunId"] = parent
    run = mlflow_client.create_run(experiment_id(mlflow_client, tracking), tags=all_tags, run_name=name)
    run_id = str(run.info.run_id)
    status = "FAILED"
    try:
        log(mlflow_client, run_id, params=params or {})
        yield mlflow_client, run_id
        status = "FINISHED"
    except KeyboardInterrupt:
        status = "KILLED"
        raise
    finally:
        mlflow_client.set_terminated(run_id, status=status)


def log(
    mlflow_client: MlflowClient,
    run_id: str,
    params: Mapping[str, Any] | None = None,
    metrics: Mapping[str, float] | None = None,
    step: int = 0,
) -> None:
    """Log parameters and metrics of a run in one transaction. Metrics that are not finite are left out."""
    from mlflow.entities import Metric, Param

    now = int(time.time() * 1000)
    mlflow_client.log_batch(
        run_id,
        metrics=[Metric(key, float(v), now, step) for key, v in (metrics or {}).items() if math.isfinite(v)],
        params=[Param(key, str(value)) for key, value in (params or {}).items()],
    )


@dataclass(frozen=True)
class NestedRun:
    """A run within another, before it is logged: its name, parameters and metrics."""

    name: str
    params: Mapping[str, Any]
    metrics: Mapping[str, float]


def log_nested(
    tracking: TrackingConfig, parent: str, stage: str, runs: Sequence[NestedRun], tags: Mapping[str, str] | None = None
) -> list[str]:
    """Log many finished runs within another one, all but the first in one transaction of the database.

    One by one through MLflow each takes a tenth of a second, and an evaluation has hundreds.

    Args:
        tracking: the store.
        parent: id of the run they are nested under.
        stage: their tag.
        runs: what to log. Metrics that are not finite are left out.
        tags: further tags, the same for all.

    Returns:
        Their ids.
    """
    if not runs:
        return []
    with start_run(tracking, runs[0].name, stage, runs[0].params, parent, tags) as (mlflow_client, first):
        log(mlflow_client, first, metrics=runs[0].metrics)
    ids = [first, *(uuid.uuid4().hex for _ in runs[1:])]
    with closing(sqlite3.connect(tracking.root / "mlflow.db", timeout=60)) as connection, connection:
        cursor = connection.execute("SELECT * FROM runs WHERE run_uuid = ?", (first,))
        columns, template = [column[0] for column in cursor.description], cursor.fetchone()
        all_tags = connection.execute("SELECT key, value FROM tags WHERE run_uuid = ?", (first,)).fetchall()
        now = template[columns.index("start_time")]
        for run_id, run in zip(ids[1:], runs[1:], strict=True):
            row = dict(zip(columns, template, strict=True))
            row |= {"run_uuid": run_id, "name": run.name, "artifact_uri": row["artifact_uri"].replace(first, run_id)}
            named = [(key, run.name if key == "mlflow.runName" else value) for key, value in all_tags]
            metrics = [(key, float(v), now, run_id, 0, 0) for key, v in run.metrics.items() if math.isfinite(v)]
            marks = ", ".join("?" * len(columns))
            connection.execute(f"INSERT INTO runs ({', '.join(columns)}) VALUES ({marks})", list(row.values()))
            for table, pairs in (("tags", named), ("params", [(key, str(v)) for key, v in run.params.items()])):
                connection.executemany(
                    f"INSERT INTO {table} (key, value, run_uuid) VALUES (?, ?, ?)", [(*pair, run_id) for pair in pairs]
                )
            for table in ("metrics", "latest_metrics"):
                connection.executemany(
                    f"INSERT INTO {table} (key, value, timestamp, run_uuid, step, is_nan) VALUES (?, ?, ?, ?, ?, ?)",
                    metrics,
                )
    return ids


def newest_run(
    tracking: TrackingConfig,
    stage: str,
    tags: Mapping[str, str] | None = None,
    params: Mapping[str, str] | None = None,
    file: str = "",
) -> Run | None:
    """The newest finished top-level run of a stage, or None. Does not create a store.

    Args:
        tracking: the store.
        stage: its tag, such as "evaluate".
        tags: tags the run must have.
        params: parameters the run must have.
        file: artifact the run must have; "" for any run.
    """
    return next(finished_runs(tracking, stage, tags, params, file), None)


def finished_runs(
    tracking: TrackingConfig,
    stage: str,
    tags: Mapping[str, str] | None = None,
    params: Mapping[str, str] | None = None,
    file: str = "",
) -> Iterator[Run]:
    """All finished top-level runs of a stage, the newest first; see `newest_run`."""
    store = tracking.root / "mlflow.db"
    if not store.is_file():
        return
    mlflow_client = client(tracking)
    experiment = mlflow_client.get_experiment_by_name(tracking.experiment)
    if experiment is None:
        return
    # asked of the database: MLflow cannot search for runs without a parent, and an evaluation has hundreds of children
    one = "EXISTS (SELECT 1 FROM {} t WHERE t.run_uuid = r.run_uuid AND t.key = ? AND t.value = ?)"
    wanted = [("tags", STAGE_TAG, stage), *(("tags", *pair) for pair in (tags or {}).items())]
    wanted += [("params", *pair) for pair in (params or {}).items()]
    query = " AND ".join([
        "SELECT r.run_uuid FROM runs r WHERE r.experiment_id = ? AND r.status = 'FINISHED'",
        "r.lifecycle_stage = 'active'",
        "NOT EXISTS (SELECT 1 FROM tags t WHERE t.run_uuid = r.run_uuid AND t.key = 'mlflow.parentRunId')",
        *(one.format(table) for table, _, _ in wanted),
    ]) + " ORDER BY r.start_time DESC, r.rowid DESC"  # fmt: skip
    values = [experiment.experiment_id, *(text for _, key, value in wanted for text in (key, str(value)))]
    with closing(sqlite3.connect(store, timeout=60)) as connection:
        ids = [row[0] for row in connection.execute(query, values)]
    for run_id in ids:
        run = mlflow_client.get_run(run_id)
        if not file or (Path(run.info.artifact_uri) / file).is_file():
            yield run


def newest_artifact(tracking: TrackingConfig, stage: str, file: str, dataset: str = "") -> Path:
    """An artifact of the newest finished top-level run that has it.

    Args:
        tracking: the store.
        stage: of the run.
        file: the artifact.
        dataset: that the run is about; "" for any.

    Raises:
        MissingRunError: there is no such run.
    """
    run = newest_run(tracking, stage, params={"dataset": dataset} if dataset else None, file=file)
    if run is None:
        fix = "`wheretolook figures` tells which command makes it, `wheretolook log-release` logs what ships."
        raise MissingRunError(f"there is no run of {stage} with {file}", path=tracking.root, fix=fix)
    return Path(run.info.artifact_uri) / file


def artifact(tracking: TrackingConfig, run_id: str, path: str) -> Path:
    """Local path of an artifact of a run."""
    return Path(client(tracking).get_run(run_id).info.artifact_uri) / path


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
    here = Path(__file__).resolve().parent
    try:
        git = ["git", "-C", str(here)]
        top, commit = subprocess.run(
            [*git, "rev-parse", "--show-toplevel", "HEAD"], capture_output=True, text=True, check=True, timeout=10
        ).stdout.split("\n")[:2]
        # an installed copy may lie inside an unrelated checkout (a virtual environment does)
        if here == Path(top) / "src" / "wheretolook":
            status = [*git, "status", "--porcelain", "--untracked-files=no"]
            changed = subprocess.run(status, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
            version["git_commit"] = commit + ("+" if changed else "")
    except (OSError, subprocess.SubprocessError):
        pass
    return version


def _relocate(tracking: TrackingConfig, old: str) -> None:
    """Point artifact paths under `old` to where the store lies now."""
    with closing(sqlite3.connect(tracking.root / "mlflow.db")) as connection, connection:
        for table, column in (("experiments", "artifact_location"), ("runs", "artifact_uri")):
            connection.execute(
                f"UPDATE {table} SET {column} = ? || substr({column}, ?) WHERE substr({column}, 1, ?) = ?",
                (tracking.artifacts, len(old) + 1, len(old), old),
            )


@cache
def _mlflow() -> Any:
    """MLflow, imported when first needed, without its notes on database migrations and without telemetry."""
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
    import mlflow

    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.WARNING)
    return mlflow
