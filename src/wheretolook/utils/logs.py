"""Logging of this package and of the libraries that it uses."""

from __future__ import annotations

import logging
import os
import warnings

from wheretolook.utils.errors import LockWarning, MapWarning, OutOfRangeWarning, TrackingWarning

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
