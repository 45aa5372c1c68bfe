"""Tables in Markdown, numbers of things, and the logs of this package and of libraries."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Literal

from wheretolook.utils.errors import LockWarning, MapWarning, OutOfRangeWarning, TrackingWarning


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table whose columns also line up as plain text."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    lines = []
    for line in (header, ["-" * width for width in widths], *rows):
        cells = [cell.ljust(width) for cell, width in zip(line, widths, strict=True)]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def counted(number: float, noun: str) -> str:
    """Return a rounded number and its noun, such as "1 landmark" and "1,260 landmarks"."""
    return f"{number:,.0f} {noun}{'s' * (round(number) != 1)}"


def score_text(score: float) -> str:
    """Format a score: two decimals for probabilities, three digits for the larger scores of other methods."""
    return f"{score:.2f}" if abs(score) < 10 else f"{score:.3g}"


LOG = logging.getLogger("wheretolook")
"""Of what the package finds out by itself, such as which files are used; the command line prints it."""


class _Printing(logging.Handler):
    """Prints messages to standard output."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print the message of a record."""
        print(record.getMessage(), flush=True)


def quiet_libraries() -> None:
    """Silence libraries' messages and warnings; the project's own messages and warnings are printed as one line each."""
    LOG.setLevel(logging.INFO)
    LOG.handlers = [_Printing()]
    os.environ.setdefault("GLOG_minloglevel", "2")
    os.environ.setdefault("PYTHONWARNINGS", "ignore")  # for worker processes
    warnings.simplefilter("ignore")
    for kind in (OutOfRangeWarning, MapWarning, LockWarning, TrackingWarning):
        warnings.simplefilter("default", kind)
    warnings.formatwarning = lambda message, *_, **__: f"wheretolook: warning: {message}\n"
    for name in ("lightning", "lightning.pytorch", "lightning.fabric", "mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.ERROR)


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
