"""Quieter logs of COLMAP."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal


@contextmanager
def quiet_colmap(least: Literal["WARNING", "ERROR"] = "WARNING") -> Iterator[None]:
    """Silence COLMAP's log below a level: it would break up the progress bars."""
    import pycolmap

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = max(level, getattr(pycolmap.logging.Level, least).value)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
