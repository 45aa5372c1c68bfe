"""Silences COLMAP's log, and names databases in its errors."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from wheretolook.utils.errors import StorageError
from wheretolook.utils.files import STORAGE_FIX


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
