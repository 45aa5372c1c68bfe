"""The MLflow store: its options, its making, and its errors."""

from __future__ import annotations

import logging
import os
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any, cast

from wheretolook.utils.errors import StorageError, TrackingError, TrackingWarning, no_option
from wheretolook.utils.files import copy_file, storage_errors, temporary_folder, write_json
from wheretolook.utils.processes import hold

if TYPE_CHECKING:
    from mlflow import MlflowClient


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


_FREE_BYTES = 2**20  # required before work starts
_LOCK_WAIT_S = 60.0  # for another process that creates the store, which takes it 4 s on two cores
_FIX = "Repair or move the store, or name another folder: --tracking.folder FOLDER."
_MISREAD = re.compile(r"\?|%[0-9a-fA-F]{2}")  # characters that SQLAlchemy interprets in the path of a database


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
                file.write(bytes(_FREE_BYTES))


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
    misread = _MISREAD.search(str(root))
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
    with hold(database.with_name(".making.lock"), "creating the MLflow store", wait_s=_LOCK_WAIT_S):
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
