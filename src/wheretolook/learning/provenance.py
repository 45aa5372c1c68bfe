"""What weights were trained on, and whether that is still what a dataset holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wheretolook.dataset.folders import Dataset
from wheretolook.learning.data import with_also
from wheretolook.utils.errors import ConfigError, TableError


@dataclass(frozen=True)
class TrainedModel:
    """What training one variant left.

    Attributes:
        variant: the input variant.
        path: its weights.
        run_id: its MLflow run, at the time of training.
        metrics: metrics of the epoch whose weights were kept, and that epoch's number (from 0) as "epoch".
        reused: whether it was trained before and only found again.
    """

    variant: str
    path: Path
    run_id: str
    metrics: dict[str, float]
    reused: bool = False


def training_fingerprint(dataset: Dataset) -> str:
    """16 hexadecimal digits that change with anything a network learns from: the train and val scenes."""
    return Dataset(dataset.root, dataset.camera, (*dataset.split("train"), *dataset.split("val"))).fingerprint()


def was_trained_on(dataset: Dataset, training: Mapping[str, Any]) -> bool:
    """Whether weights with a record of training were trained on what a dataset, and others beside it, now hold.

    Where another dataset that they learnt from is not at hand, the dataset's own scenes tell.
    """
    also = training.get("also", ())
    if also and not all((dataset.root.parent / name / "dataset.json").is_file() for name in also):
        return bool(training.get("own_fingerprint") == training_fingerprint(dataset))
    try:
        together = with_also(dataset, also)
    except (TableError, ConfigError):
        return False  # what lies there now cannot have been learnt from
    return bool(training.get("dataset_fingerprint") == training_fingerprint(together))
