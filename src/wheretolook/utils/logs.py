"""Logging of the libraries that this package uses."""

from __future__ import annotations

import logging
import os
import warnings

from wheretolook.utils.errors import LockWarning, MapWarning, OutOfRangeWarning, TrackingWarning


def quiet_libraries() -> None:
    """Silence libraries' messages and warnings; the project's own warnings are printed as one line each."""
    os.environ.setdefault("GLOG_minloglevel", "2")
    os.environ.setdefault("PYTHONWARNINGS", "ignore")  # for worker processes
    warnings.simplefilter("ignore")
    for kind in (OutOfRangeWarning, MapWarning, LockWarning, TrackingWarning):
        warnings.simplefilter("default", kind)
    warnings.formatwarning = lambda message, *_, **__: f"wheretolook: warning: {message}\n"
    for name in ("lightning", "lightning.pytorch", "lightning.fabric", "mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.ERROR)
