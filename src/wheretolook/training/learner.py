"""The interface of learners: from a dataset to a model and its metrics."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pandas as pd
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.linear_model import LogisticRegression

from wheretolook.dataset.layout import Dataset
from wheretolook.geometry.camera import Camera
from wheretolook.training.config import SharedConfig
from wheretolook.training.data import ViewsDataModule
from wheretolook.training.fit import EpochRecord, RunLog, ViewpointClassifier, fit
from wheretolook.training.trained_network import StoredNetwork, TrainedNetwork


class Model(Protocol):
    """A trained model that is stored in a weights file."""

    def save(self, path: Path, training: dict[str, Any] | None = None) -> None:
        """Write one safetensors file, atomically, with JSON values about the training in its header."""


@dataclass(frozen=True, eq=False)
class TrainingResult:
    """The result of training."""

    model: Model  # to be saved
    metrics: dict[str, float]  # of the stored weights on the validation views, with "val_average_precision"
    # of the training data, such as n_train; logged as parameters
    counts: dict[str, Any] = field(default_factory=dict)
    history: pd.DataFrame | None = None  # metrics of each epoch, None where there are no epochs


@dataclass(frozen=True, eq=False)
class TrainingJob:
    """What to train, on which data, with which options."""

    dataset: Dataset  # labelled train scenes, and val scenes if it has any
    method: str  # name of the method to train
    config: SharedConfig  # options that all learners share
    options: Any  # the method's own, such as a `FittingConfig`
    title: str = ""  # of its progress bar
    progress: bool = False  # whether to show it
    run_log: RunLog | None = None  # takes the metrics of epochs; None logs none
    # what one learner leaves for the next, such as binned views
    kept: dict[str, Any] = field(default_factory=dict)

    @property
    def camera(self) -> Camera | None:
        """The camera of all training views; None if there are several."""
        cameras = self.dataset.cameras
        return cameras[0] if len(cameras) == 1 else None


def train_network(
    network: StoredNetwork,
    data: ViewsDataModule,
    task: TrainingJob,
    class_weights: tuple[float, float] = (1.0, 1.0),
    calibrate: bool = True,
) -> TrainingResult:
    """Train a network and, on request, calibrate it on the validation views."""
    classifier = ViewpointClassifier(network, task.options, class_weights, task.config.seed)
    record = EpochRecord(task.title, task.options, task.progress, task.run_log)
    fit(classifier, data, record, task.config)
    metrics = record.restore(classifier)
    network.eval()
    scale, offset = 1.0, 0.0
    if calibrate:
        logits, labels = _predict(network, data)
        scale, offset = fit_platt(logits, labels)
    model = TrainedNetwork(task.method, network.cpu(), task.camera, scale, offset, data.training_range)
    counts = class_counts(train=data.labels(data.train_rows), val=data.labels(data.val_rows))
    return TrainingResult(model, metrics, counts, pd.DataFrame(record.rows))


def _predict(network: StoredNetwork, data: ViewsDataModule) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return logits and labels (B,) of the validation views."""
    logits = []
    labels = []
    with torch.inference_mode():
        for batch in data.val_dataloader():
            logits.append(network.to(batch.inputs[0].device)(*batch.inputs).float().cpu())
            labels.append(batch.labels.cpu())
    return torch.cat(logits).numpy(), torch.cat(labels).numpy()


def class_counts(**sides: NDArray[Any]) -> dict[str, Any]:
    """Return the number of views of each split and their share of positives, named as parameters of runs."""
    counts: dict[str, Any] = {f"n_{name}": len(labels) for name, labels in sides.items()}
    return counts | {f"positives_{name}": round(float(labels.mean()), 4) for name, labels in sides.items()}


def fit_platt(logits: ArrayLike, labels: ArrayLike) -> tuple[float, float]:
    """Return the scale and offset for which scale * logits + offset best predict labels (B,) (Platt 1999).

    They are 1 and 0 if the scale would reverse the order, or the labels are of one class.
    """
    values = np.asarray(logits, dtype=np.float64)
    truth = np.asarray(labels).astype(bool)
    if truth.all() or not truth.any():
        return 1.0, 0.0
    line = LogisticRegression(C=1e6).fit(values[:, None], truth)
    scale = float(line.coef_[0, 0])
    return (scale, float(line.intercept_[0])) if scale > 0 else (1.0, 0.0)
