"""Where runs are logged: an MLflow store of one SQLite file and one folder of artifacts, both in one place.

MLflow writes absolute artifact paths into its database (it resolves relative ones against the current folder), so a
moved store would point at the old place. `client` notices that and rewrites the paths.
"""

from __future__ import annotations

import logging
import os
import shlex
import sqlite3
import subprocess
import sys
from collections.abc import Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import wheretolook

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mlflow import MlflowClient
    from mlflow.entities import Run

STAGE_TAG = "stage"
"""Tag of every run this package logs: "label", "train" or "evaluate"."""


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
        stage: "label", "train" or "evaluate", stored as a tag.
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
    import math
    import time

    from mlflow.entities import Metric, Param

    now = int(time.time() * 1000)
    mlflow_client.log_batch(
        run_id,
        metrics=[Metric(key, float(v), now, step) for key, v in (metrics or {}).items() if math.isfinite(v)],
        params=[Param(key, str(value)) for key, value in (params or {}).items()],
    )


def newest_run(tracking: TrackingConfig, stage: str, tags: Mapping[str, str] | None = None) -> Run | None:
    """The newest finished top-level run of a stage, or None. Does not create a store.

    Args:
        tracking: the store.
        stage: "label", "train" or "evaluate".
        tags: tags the run must have.
    """
    if not (tracking.root / "mlflow.db").is_file():
        return None
    mlflow_client = client(tracking)
    experiment = mlflow_client.get_experiment_by_name(tracking.experiment)
    if experiment is None:
        return None
    wanted = {STAGE_TAG: stage, **(tags or {})}
    clauses = [f"tags.{key} = '{value}'" for key, value in wanted.items()] + ["attributes.status = 'FINISHED'"]
    token: str | None = ""
    while token is not None:  # an evaluation may have hundreds of children, all newer than itself
        runs = mlflow_client.search_runs(
            [experiment.experiment_id], " and ".join(clauses), order_by=["attributes.start_time DESC"],
            max_results=100, page_token=token or None,
        )  # fmt: skip
        for run in runs:
            if "mlflow.parentRunId" not in run.data.tags:
                return run
        token = runs.token or None
    return None


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
    version = {"code_version": wheretolook.__version__}
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
