"""Learning to score viewpoints. Names are imported when first used: PyTorch and Lightning take seconds to load."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from wheretolook.learning.config import TrainConfig

if TYPE_CHECKING:
    from wheretolook.learning.classifier import ViewpointClassifier
    from wheretolook.learning.data import ViewpointDataModule
    from wheretolook.learning.network import InputStatistics, NetworkSpec, ViewpointNetwork
    from wheretolook.learning.training import TrainedModel, train
    from wheretolook.learning.weights import load_classifier, save_classifier

__all__ = [
    "InputStatistics",
    "NetworkSpec",
    "TrainConfig",
    "TrainedModel",
    "ViewpointClassifier",
    "ViewpointDataModule",
    "ViewpointNetwork",
    "load_classifier",
    "save_classifier",
    "train",
]

_MODULES = {
    "ViewpointClassifier": "classifier",
    "ViewpointDataModule": "data",
    "InputStatistics": "network",
    "NetworkSpec": "network",
    "ViewpointNetwork": "network",
    "TrainedModel": "training",
    "train": "training",
    "load_classifier": "weights",
    "save_classifier": "weights",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
