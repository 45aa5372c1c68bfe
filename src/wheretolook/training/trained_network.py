"""A trained network with what is needed to score with it, saved to a weights file and loaded."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

import torch
from torch import Tensor, nn

from wheretolook.dataset.thresholds import ACCURACY, Accuracy, checked_accuracy
from wheretolook.geometry.camera import Camera, camera_of_record
from wheretolook.training.training_range import TrainingRange
from wheretolook.training.weights import check_method_of_weights, read_weights, write_weights
from wheretolook.utils.errors import ConfigError, WeightsError


class StoredNetwork(nn.Module, ABC):
    """A network that is rebuilt from its description and its state."""

    @abstractmethod
    def description(self) -> dict[str, Any]:
        """Return all that defines the network but its weights, as JSON values."""

    @classmethod
    @abstractmethod
    def of_description(cls, stored: Mapping[str, Any]) -> Self:
        """Build the untrained network of a description; ValueError if it is invalid or names unknown inputs."""

    @property
    def stored(self) -> nn.Module:
        """The module whose state is stored."""
        return self


NetworkT = TypeVar("NetworkT", bound=StoredNetwork)


@dataclass(frozen=True, eq=False)
class TrainedNetwork(Generic[NetworkT]):
    """A network and the calibration scale * logit + offset of its logits.

    A network trained on rendered views predicts probabilities that are too low for most photographs:
    `for_photographs` adds `photograph_offset` to the log-odds (docs/research/cameras.md).
    """

    method: str
    network: NetworkT
    camera: Camera | None  # of its training views; None for several
    scale: float = 1.0
    offset: float = 0.0
    training_range: TrainingRange | None = None  # of its training views; None if the weights do not store it
    accuracy: Accuracy = ACCURACY  # limits of its training views' errors, in metres and degrees
    photograph_offset: float = 0.0

    def __post_init__(self) -> None:
        self.network.eval()

    def calibrated(self, logits: Tensor) -> Tensor:
        """Return calibrated log-odds of the network's logits, in the same shape and precision."""
        return self.scale * logits + self.offset

    def for_photographs(self) -> Self:
        """Return the same network, calibrated for maps of photographs."""
        return replace(self, offset=self.offset + self.photograph_offset, photograph_offset=0.0)

    def range_at(self, accuracy: Accuracy) -> TrainingRange:
        """Return the range of scores at an accuracy; without a stored one, that of the training camera."""
        known = self.training_range or TrainingRange.of_camera(self.camera)
        return known.at_accuracy(accuracy[0] / self.accuracy[0])

    def save(self, path: Path, training: Mapping[str, Any] | None = None) -> None:
        """Write one safetensors file, atomically, with JSON values about the training in its header."""
        header = self.network.description()
        header |= {"camera": None if self.camera is None else self.camera.record(), "scale": self.scale}
        if self.training_range is not None:
            header["range"] = self.training_range.record()
        header |= {"offset": self.offset, "training": dict(training or {})}
        if self.photograph_offset:
            header["photograph_offset"] = self.photograph_offset
        write_weights(path, self.method, self.network.stored.state_dict(), header)

    @classmethod
    def load(
        cls, path: str | Path, network_class: type[NetworkT], *methods: str, device: str = "cpu"
    ) -> TrainedNetwork[NetworkT]:
        """Load weights of one of these methods, ready to score on a device.

        Raises a WeightsError if the file is missing, damaged, of another method, or does not fit its header.
        """
        tensors, header = read_weights(Path(path))
        check_method_of_weights(path, header, *methods)
        try:
            with torch.device("meta"):  # check sizes first: build only a network as large as what is stored
                expected = network_class.of_description(header).stored
            expected.load_state_dict({name: tensor.to("meta") for name, tensor in tensors.items()})
            network = network_class.of_description(header)
            network.stored.load_state_dict(tensors)
            camera = None if header["camera"] is None else camera_of_record(header["camera"])
            scale = finite(header.get("scale", 1.0))
            if scale <= 0:
                raise ValueError(f"the scale of the logits is {scale:g}")
            offset, photograph_offset = (finite(header.get(name, 0.0)) for name in ("offset", "photograph_offset"))
            training_range = TrainingRange.of_record(header["range"]) if "range" in header else None
            options = header.get("training", {}).get("config", {})
            names = ("max_error_m", "max_error_deg")
            limits = [finite(options.get(name, limit)) for name, limit in zip(names, ACCURACY, strict=True)]
            accuracy = checked_accuracy(limits)
        except (KeyError, TypeError, ValueError, IndexError, AttributeError, RuntimeError, ConfigError) as error:
            problem = f"the header does not describe these weights: {error}"
            fix = "Use the version that wrote them, or train again."
            raise WeightsError(problem, path=path, fix=fix) from error
        network.to(device).requires_grad_(False)
        calibration = scale, offset, training_range, accuracy, photograph_offset
        return TrainedNetwork(header["method"], network, camera, *calibration)


def finite(value: Any) -> float:
    """Return a number of a header; ValueError if it is not finite."""
    number = float(value)
    if not isfinite(number):
        raise ValueError(f"{value} is not a finite number")
    return number
