"""A trained network with all that is needed to use it again, on disk and back."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

import torch
from torch import Tensor, nn

from wheretolook.geometry.camera import Camera, camera_of_record
from wheretolook.training.old_names import name_of_header
from wheretolook.training.training_range import TrainingRange
from wheretolook.training.weights import check_serves, read_weights, write_weights
from wheretolook.utils.errors import ConfigError, WeightsError


class StoredNetwork(nn.Module, ABC):
    """A network that can be built anew from what it tells of itself."""

    @abstractmethod
    def description(self) -> dict[str, Any]:
        """All that defines the network but its weights, as JSON values."""

    @classmethod
    @abstractmethod
    def of_description(cls, stored: Mapping[str, Any]) -> Self:
        """The untrained network with this description; a WeightsError if it asks for what is not known here."""

    @property
    def stored(self) -> nn.Module:
        """The part whose weights are stored."""
        return self


NetworkT = TypeVar("NetworkT", bound=StoredNetwork)


class TrainedNetwork(Generic[NetworkT]):
    """A network, the camera of its training views, and what calibrates its logits: scale * logit + offset.

    `training_range` says what the training views were like, if the file of weights tells.
    """

    def __init__(
        self,
        method: str,
        network: NetworkT,
        camera: Camera | None,
        scale: float = 1.0,
        offset: float = 0.0,
        training_range: TrainingRange | None = None,
    ) -> None:
        self.method = method
        self.network = network.eval()
        self.camera = camera
        self.scale = scale
        self.offset = offset
        self.training_range = training_range

    def calibrated(self, logits: Tensor) -> Tensor:
        """Calibrated log-odds of the network's logits, in the same shape and precision."""
        return self.scale * logits + self.offset

    def save(self, path: Path, training: Mapping[str, Any] | None = None) -> None:
        """Write one safetensors file, atomically, with JSON values on the training. Equal networks, equal bytes."""
        header = {
            **self.network.description(),
            "camera": None if self.camera is None else self.camera.record(),
            "scale": self.scale,
        }
        if self.training_range is not None:
            header["range"] = self.training_range.record()
        header |= {"offset": self.offset, "training": dict(training or {})}
        write_weights(path, self.method, self.network.stored.state_dict(), header)

    @classmethod
    def load(
        cls, path: str | Path, network_class: type[NetworkT], *methods: str, device: str = "cpu"
    ) -> TrainedNetwork[NetworkT]:
        """Read what `save` wrote for one of these methods, ready to score on a device (dropout off, no gradients).

        Raises a WeightsError if the file is missing, damaged, foreign, of another method, or unlike its description.
        """
        tensors, header = read_weights(Path(path))
        check_serves(path, header, *methods)
        fix = f"Train again, or give other weights of {methods[0]}."
        try:
            with torch.device("meta"):  # so that what is described is only made if it is as large as what is stored
                expected = network_class.of_description(header).stored.state_dict()
            _check_sizes(expected, tensors)
            network = network_class.of_description(header)
            camera = None if header["camera"] is None else camera_of_record(header["camera"])
            scale = float(header.get("scale", 1.0))
            offset = float(header.get("offset", 0.0))
            if not (isfinite(scale) and isfinite(offset)):
                raise ValueError(f"scale {scale} and offset {offset} are not finite")
            known = TrainingRange.of_record(header["range"]) if "range" in header else None
        except WeightsError as error:
            raise WeightsError(error.problem, path=path, value=error.value, fix=error.fix or fix) from error
        except (KeyError, TypeError, ValueError, IndexError, AttributeError, RuntimeError, ConfigError) as error:
            raise WeightsError(f"damaged description in the header: {error}", path=path, fix=fix) from error
        try:
            network.stored.load_state_dict(tensors)
        except RuntimeError as error:
            problem = f"the weights do not fit the network they describe: {error}"
            raise WeightsError(problem, path=path, fix=fix) from error
        found = network.to(device).requires_grad_(False)
        return TrainedNetwork(name_of_header(header), found, camera, scale, offset, known)


def _check_sizes(expected: Mapping[str, Tensor], found: Mapping[str, Tensor]) -> None:
    for name in sorted({*expected, *found}):
        sizes = [tuple(tensors[name].shape) if name in tensors else None for tensors in (expected, found)]
        if sizes[0] != sizes[1]:
            problem = f"the weights do not fit the network they describe: {name} is of size {sizes[1]}, not {sizes[0]}"
            raise WeightsError(problem)
