"""The MLflow store itself: checked before work starts, made by one process at a time, and with one kind of error.

What MLflow does with a store that it cannot use is to try again for minutes, in pauses that double. So nothing reaches
it that was not found usable, and what fails all the same is a TrackingError at once.
"""

from __future__ import annotations

import logging
import os
import re
import resource
import shutil
import sqlite3
import time
import warnings
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any, cast

from wheretolook.utils.errors import StorageError, TrackingError, TrackingWarning
from wheretolook.utils.files import copy_file, storage_errors, temporary_folder, write_json
from wheretolook.utils.locks import hold
from wheretolook.utils.tracking_config import TrackingConfig

if TYPE_CHECKING:
    from mlflow import MlflowClient

ROOM_BYTES = 2**20  # that are free before work starts; a new store takes as much, a run's artifacts often less
_MAKING_S = 60.0  # to wait for another process that makes the store, which takes it 4 s on two cores
_CHECK_S = 2.0  # a large database is not checked to its end
_FIX = "Mend or move it, or name another folder: --tracking.folder FOLDER."
_VERSION_TABLE = "alembic_version"  # where MLflow keeps which version made the store
_MISREAD = re.compile(r"\?|%[0-9a-fA-F]{2}")  # in the path of a database, which SQLAlchemy reads as an address


def check_store(tracking: TrackingConfig) -> None:
    """Raise TrackingError unless runs can be logged to the store: to be called before work starts.

    The store is made if there is none. It cannot be used if its path has letters that MLflow misreads, is not a folder,
    or holds a database that is damaged, of another version of MLflow, or read-only; or if there is no room for another
    megabyte.
    """
    root = tracking.root
    database = tracking.root / "mlflow.db"
    opened_client(tracking)
    with _told(root):
        if not os.access(database, os.W_OK):
            raise TrackingError("the store is read-only", path=database, fix=_FIX)
        _check_limit(database)
        Path(tracking.artifacts).mkdir(exist_ok=True)
        for folder in (root, Path(tracking.artifacts)):
            with storage_errors(folder), TemporaryFile(dir=folder) as file:
                file.write(bytes(ROOM_BYTES))


def opened_client(tracking: TrackingConfig) -> MlflowClient:
    """A client of the store, which is made if there is none. What fails in it raises a TrackingError."""
    return _opened(tracking.root, tracking.uri)


@contextmanager
def kept_if_not_logged(what: str, note: Path | None = None, content: Any = None) -> Iterator[None]:
    """A block that logs results which lie on disk: if that fails, a TrackingWarning says so, and how to log them later.

    The note, if one is asked for, is a JSON file with this content that lies there until the results are logged.
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
    """Warn that results which lie on disk are not logged, and say how to log them later."""
    later = "Mend that and run the stage again: it logs what is not logged yet."
    text = f"{what}: kept, but not logged, since {error.path}: {error.problem}. {later}"
    warnings.warn(text, TrackingWarning, stacklevel=3)


@cache
def _opened(root: Path, uri: str) -> MlflowClient:
    database = root / "mlflow.db"
    with _told(root):
        found = _MISREAD.search(str(root))
        if found or not _is_text(root):
            problem = "MLflow misreads the path of this folder"
            raise TrackingError(problem, path=root, value=found and found[0], fix="Name another: --tracking.folder.")
        with storage_errors(root):
            root.mkdir(parents=True, exist_ok=True)
        if not database.exists() or (database.is_file() and database.stat().st_size == 0):
            _make(root, database)
        _check_database(database)
        opened = mlflow_package().MlflowClient(tracking_uri=uri)
        opened.search_experiments(max_results=1)
    return cast("MlflowClient", _Client(root, opened))


def _is_text(path: Path) -> bool:
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True


def _make(root: Path, database: Path) -> None:
    """Make an empty store elsewhere, and put it in its place: a process that is killed leaves no half."""
    _check_limit(database)
    with hold(root / ".making.lock", "making the MLflow store", wait_s=_MAKING_S):
        if database.exists() and database.stat().st_size:
            return  # another process has made it
        for leftover in root.glob("*.making"):
            shutil.rmtree(leftover, ignore_errors=True)
        with storage_errors(root), TemporaryFile(dir=root) as file:
            file.write(bytes(2 * ROOM_BYTES))
        with temporary_folder(".making", parent=root) as folder:
            new = folder / "mlflow.db"
            mlflow_package().MlflowClient(tracking_uri=f"sqlite:///{new}").search_experiments(max_results=1)
            copy_file(new, database)


def _check_limit(database: Path) -> None:
    limit, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    needed = ROOM_BYTES + (database.stat().st_size if database.exists() else 0)
    if limit != resource.RLIM_INFINITY and limit < needed:
        problem = f"the store needs files of {needed:,} bytes, and files have a limit (ulimit -f)"
        raise TrackingError(problem, path=database, value=limit, fix="Raise the limit.")


def _check_database(database: Path) -> None:
    """Raise TrackingError if the file is no whole SQLite database."""
    if not database.is_file():
        raise TrackingError("this is no file of a store", path=database, fix=_FIX)
    mode = "rw" if os.access(database, os.W_OK) else "ro"  # what a killed process began is rolled back, if possible
    until = time.monotonic() + _CHECK_S
    with closing(sqlite3.connect(f"{database.as_uri()}?mode={mode}", uri=True)) as connection:
        connection.set_progress_handler(lambda: time.monotonic() > until, 10_000)
        try:
            found = str(connection.execute("PRAGMA quick_check(1)").fetchone()[0])
            named = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode in (sqlite3.SQLITE_INTERRUPT, sqlite3.SQLITE_BUSY):
                return
            raise
    with database.open("rb") as file:
        page = int.from_bytes(file.read(18)[16:], "big")
    if (found == "ok" and database.stat().st_size % (65536 if page == 1 else page or 1) != 0) or not page:
        found = "the file is truncated"  # SQLite takes one of a few bytes for empty, and rounds
    if found != "ok":
        raise TrackingError(f"the database is damaged: {' '.join(found.split())}", path=database, fix=_FIX)
    if named and (_VERSION_TABLE,) not in named:
        raise TrackingError("this is another program's database", path=database, value=named[0][0], fix=_FIX)


@contextmanager
def _told(root: Path) -> Iterator[None]:
    """Turn what goes wrong in a store, in whichever library, into a TrackingError of one line."""
    try:
        yield
    except TrackingError:
        raise
    except StorageError as error:
        raise TrackingError(error.problem, path=error.path, value=error.value, fix=_FIX) from error
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)
        path = error.filename if isinstance(error.filename, str) else root
        raise TrackingError(f"the store cannot be used: {reason}", path=path, fix=_FIX) from error
    except Exception as error:
        if type(error).__module__.partition(".")[0] not in ("mlflow", "sqlalchemy", "sqlite3", "alembic"):
            raise
        first = re.sub(r"^\(\w+\.\w+\) ", "", (str(error).splitlines() or [""])[0]).partition(" NOTE:")[0].rstrip(".")
        problem = f"the store cannot be used: {first or type(error).__name__}"
        raise TrackingError(problem, path=root / "mlflow.db", fix=_FIX) from error


class _Client:
    """An MLflow client that raises TrackingErrors, and copies artifacts whole or not at all."""

    def __init__(self, root: Path, wrapped: MlflowClient) -> None:
        self._root = root
        self._wrapped = wrapped

    def log_artifact(self, run_id: str, local_path: str, artifact_path: str = "") -> None:
        """Copy a file to the artifacts of a run."""
        source = Path(local_path)
        with _told(self._root):
            copy_file(source, self._root / "artifacts" / run_id / "artifacts" / artifact_path / source.name)

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._wrapped, name)

        def call(*arguments: Any, **options: Any) -> Any:
            with _told(self._root):
                return found(*arguments, **options)

        return call if callable(found) else found


@cache
def mlflow_package() -> Any:
    """MLflow, imported when first needed, without its notes on database migrations, telemetry, and repeated trials."""
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
    import mlflow
    from mlflow.store.db import utils

    utils.MAX_RETRY_COUNT = 1  # a file does not become a database by waiting
    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.WARNING)
    return mlflow
