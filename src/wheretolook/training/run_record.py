"""What a train run holds in the tracking store: parameters, metrics of the retained weights, and a history by epoch."""

from __future__ import annotations

from collections.abc import Mapping
from io import StringIO
from typing import TYPE_CHECKING, Any

from wheretolook.tracking.runs import AUC

if TYPE_CHECKING:
    import pandas as pd

HISTORY_CSV = "history.csv"
"""Artifact of a train run with a row for each epoch."""

NOT_LOGGED = "not_logged"
"""In the record of weights whose training is not logged yet: "params" and "history", the text of `HISTORY_CSV`."""


def params_of(about: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of a train run from the record of its weights."""
    return {name: about[name] for name in ("method", "dataset", "dataset_fingerprint")} | about["config"]


def kept_metrics(metrics: Mapping[str, float]) -> dict[str, float]:
    """Return the metrics of a train run from those of the epoch of the retained weights; the one to sort by is first."""
    first = {AUC: metrics["val_roc_auc"]} if "val_roc_auc" in metrics else {}
    return first | {f"kept_{name}": value for name, value in metrics.items()}


def history_not_logged(record: Mapping[str, Any]) -> pd.DataFrame | None:
    """Return the history in the record of a training that is not logged yet; None if there is none."""
    import pandas as pd

    kept = record.get(NOT_LOGGED)
    text = kept.get("history") if isinstance(kept, dict) else None
    return pd.read_csv(StringIO(text), float_precision="round_trip") if isinstance(text, str) and text else None
