"""Optional packages, installed reports, and pycolmap's log."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from wheretolook.utils.errors import ConfigError, StorageError
from wheretolook.utils.files import STORAGE_FIX

EXTRAS = {
    "cv2": "photographs",
    "open3d": "depth",
    "ompl": "plan",
    "pyarrow": "plan",
    "mlflow": "plan",
    "lightning": "train",
    "torchmetrics": "train",
    "sklearn": "train",
    "kornia": "learned",
    "lightgbm": "paper",
    "jinja2": "paper",
    "ray": "ray",
    "rerun": "view",
}
"""Extras by module; of several that install it, the smallest."""


def missing_package(module: str) -> ConfigError:
    """Return the error for an optional module that is not installed."""
    fix = f"pip install 'wheretolook[{EXTRAS[module]}]'."
    if module == "ompl" and sys.platform == "win32":
        fix = "It has no wheels for Windows: plan on Linux or macOS, or install OMPL with its Python bindings."
    return ConfigError(f"this needs the package {module}, which is not installed", fix=fix)


def require(module: str) -> None:
    """Raise ConfigError, with the command that installs it, if an optional module is missing."""
    if find_spec(module) is None:
        raise missing_package(module)


def reports(stage: str) -> list[Callable[..., Any]]:
    """Return the functions of installed packages that report on a stage: entry points of this name.

    `label`, `evaluate`, `look_sets`, `plan`, `demo` and `film` are called by the commands where they import this function.
    """
    return [entry.load() for entry in entry_points(group="wheretolook.reports", name=stage)]


@contextmanager
def quiet_colmap(least: Literal["WARNING", "ERROR"] = "WARNING") -> Iterator[None]:
    """Silence COLMAP's log below a level: it would interrupt progress bars."""
    import pycolmap

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = max(level, getattr(pycolmap.logging.Level, least).value)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


@contextmanager
def storing_in_database(database: Path) -> Iterator[None]:
    """Re-raise COLMAP's errors about a database that cannot be written as StorageError."""
    try:
        yield
    except RuntimeError as error:
        match = re.search(r"SQLite error: (.*)|No registered database factory succeeded", str(error))
        if not match:
            raise
        reason = match[1] or "SQLite cannot make it"
        raise StorageError(f"cannot be written: {reason}", path=database, fix=STORAGE_FIX) from error
