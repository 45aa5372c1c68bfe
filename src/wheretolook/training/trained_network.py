"""The range of a model's training views, and warnings about views outside of it."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import isfinite
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from wheretolook.dataset.config import ACCURACY, Accuracy, checked_accuracy
from wheretolook.geometry.camera import Camera, camera_of_record, field_of_view_deg
from wheretolook.geometry.poses import Float
from wheretolook.inputs.landmark_features import ViewLandmarks
from wheretolook.training.weights import check_method_of_weights, read_weights, write_weights
from wheretolook.utils.errors import ConfigError, OutOfRangeWarning, WeightsError

QUANTITIES = {
    "distance_m": "mean distance of the landmarks in view {:.3g} m",
    "depth_m": "mean depth of the filled bins {:.3g} m",
    "in_view": "{:.0f} landmarks in view",
    "across_deg": "field of view across {:.1f} degrees",
    "down_deg": "field of view down {:.1f} degrees",
    "focal_px": "angle of a pixel {:.2g} degrees",
}
"""Quantities of a view, NaN where unknown, and their text in messages. The mean distance is geometric."""

ANGLES = ("across_deg", "down_deg")
DISTANCES = ("distance_m", "depth_m")
MARGIN = 1.25  # factor that widens the range beyond these quantiles; for angles, degrees
MARGIN_DEG = 2.0


@dataclass(frozen=True)
class TrainingRange:
    """Lowest and highest value of some of `QUANTITIES` over the training views; the others are unbounded."""

    bounds: Mapping[str, tuple[float, float]]

    @classmethod
    def of(cls, quantities: Float) -> TrainingRange:
        """Return the range of views with `QUANTITIES` (B, 6), without those that have no landmark."""
        bounds = {}
        for name, values in zip(QUANTITIES, quantities[_have_landmarks(quantities)].T, strict=True):
            known = values[np.isfinite(values)]
            if len(known):
                # quantiles of the training views bound the range
                low, high = np.quantile(known, (0.005, 0.995)).tolist()
                wider = (low - MARGIN_DEG, high + MARGIN_DEG) if name in ANGLES else (low / MARGIN, high * MARGIN)
                if name in DISTANCES:
                    # three quarters of the farther views are of three scenes, and scenes that are scaled in training
                    # show the same surfaces: neither covers spaces of that size
                    wider = low / MARGIN, float(np.quantile(known, 0.975))
                bounds[name] = (round(wider[0], 4), round(wider[1], 4))
        return cls(bounds)

    @classmethod
    def of_camera(cls, camera: Camera | None) -> TrainingRange:
        """Return the range that only a training camera's field of view bounds; unbounded without a camera."""
        if camera is None:
            return cls({})
        angles = zip(ANGLES, field_of_view_deg(camera), strict=True)
        return cls({name: (angle - MARGIN_DEG, angle + MARGIN_DEG) for name, angle in angles})

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> TrainingRange:
        """Return the range of a `record`; KeyError, TypeError, IndexError or ValueError if it is invalid."""
        bounds = dict(record)
        result = cls({name: (float(bounds[name][0]), float(bounds[name][1])) for name in QUANTITIES if name in bounds})
        low, high = result._limits
        if not (low <= high).all():
            raise ValueError("a range is empty or not a number")
        return result

    def at_accuracy(self, ratio: float) -> TrainingRange:
        """Return the range for an accuracy `ratio` times that of the training labels.

        Errors grow with distance, so a finer accuracy is in range up to distances as many times shorter. A coarser one
        does not extend the range: spaces of that size are not covered.
        """
        bounds = dict(self.bounds)
        for name in bounds.keys() & DISTANCES:
            low, high = bounds[name]
            farthest = high * min(ratio, 1.0)
            bounds[name] = min(low, farthest), farthest
        return TrainingRange(bounds)

    def record(self) -> dict[str, list[float]]:
        """Return the bounds as JSON values."""
        return {name: list(bounds) for name, bounds in self.bounds.items()}

    @property
    def bounds_landmarks(self) -> bool:
        """Whether the range bounds more than the camera."""
        return any(name in self.bounds for name in ("distance_m", "depth_m", "in_view"))

    @cached_property
    def _limits(self) -> Float:
        """Lowest and highest value of each of `QUANTITIES`, (2, 6)."""
        return np.array([self.bounds.get(name, (-np.inf, np.inf)) for name in QUANTITIES]).T

    def outside(self, quantities: Float) -> NDArray[np.bool_]:
        """Return which of `QUANTITIES` (B, 6) are outside the range; unknown ones are not."""
        low, high = self._limits
        return np.asarray((quantities < low) | (quantities > high))

    def contains(self, quantities: Float) -> NDArray[np.bool_]:
        """Return which views with `QUANTITIES` (B, 6) are in the range, (B,)."""
        return np.asarray(~self.outside(quantities).any(axis=1))

    def complaint(self, quantities: Float, tolerated: float = 0.0) -> str:
        """Describe how views leave the range; "" if at most the share `tolerated` of those with landmarks does.

        Each quantity is reported by its median over the views where it is outside.
        """
        with_landmarks = quantities[_have_landmarks(quantities)]
        outside = self.outside(with_landmarks)
        n_outside = int(np.count_nonzero(outside.any(axis=1)))
        if n_outside <= tolerated * len(outside):
            return ""
        parts = []
        for column, name in enumerate(QUANTITIES):
            if outside[:, column].any():
                parts.append(self._text(name, float(np.median(with_landmarks[outside[:, column], column]))))
        return f"{n_outside} of {len(outside)} views are unlike the training views: {', '.join(parts)}"

    def texts(self, quantities: Float) -> list[str]:
        """Return the quantities outside the range of each of the views with `QUANTITIES` (B, 6), "" for views within."""
        texts = []
        for values, outside in zip(quantities.tolist(), self.outside(quantities), strict=True):
            named = zip(QUANTITIES, values, outside, strict=True)
            texts.append(", ".join(self._text(name, value) for name, value, is_out in named if is_out))
        return texts

    def _text(self, name: str, value: float) -> str:
        """Return a quantity, its value and its range; a focal length as the angle of a pixel in the middle."""
        low, high = self.bounds[name]
        if name == "focal_px":
            value, low, high = (float(np.degrees(1 / focal_px)) for focal_px in (value, high, low))
        return f"{QUANTITIES[name].format(value)} (in range: {low:.3g} to {high:.3g})"


@dataclass
class RangeWatch:
    """Checks scored views until it has warned; `watching` is whether there is anything left to check."""

    watching: bool

    def check(self, name: str, training_range: TrainingRange, quantities: Sequence[Float]) -> None:
        """Warn once, with an `OutOfRangeWarning`, if too many views of `quantities`, parts (B, 6), are out of range.

        The warning points to the caller of the calling function.
        """
        if not self.watching or not quantities:
            return
        # as many of the views scored at once may be out of range without a warning
        if complaint := training_range.complaint(np.concatenate(quantities), 0.05):
            self.watching = False
            text = f"{name}: {complaint}. Their scores are less reliable; Scorer.in_range returns which."
            warnings.warn(text, OutOfRangeWarning, stacklevel=3)


def _have_landmarks(quantities: Float) -> NDArray[np.bool_]:
    """Return which views with `QUANTITIES` (B, 6) see any landmark, (B,): they have a distance or a depth."""
    return np.asarray(np.isfinite(quantities[:, :2]).any(axis=1))


def camera_quantities(camera: Camera) -> Float:
    """Return the `QUANTITIES` (6,) of a camera; the field of view is 360 degrees if no ray meets the image's edges."""
    angles = np.nan_to_num(field_of_view_deg(camera), nan=360.0)
    return np.array([np.nan, np.nan, np.nan, *angles, camera.mean_focal_px])


def bin_quantities(depth_sums: Float, n_filled: NDArray[np.integer[Any]]) -> Float:
    """Return `QUANTITIES` (B, 6) of binned views: sums (B,) of the mean depths of their bins, and filled bins (B,)."""
    quantities = np.full((len(depth_sums), len(QUANTITIES)), np.nan)
    some = n_filled > 0
    quantities[some, 1] = depth_sums[some] / n_filled[some]
    return quantities


def view_quantities(landmarks: ViewLandmarks, n_visible: Tensor, of_camera: Float) -> Float:
    """Return `QUANTITIES` (B, 6) of views, from all of their `n_visible` (B,) landmarks or a sample.

    `of_camera` are the `camera_quantities` of their camera.
    """
    log_distance = landmarks.values[:, landmarks.attributes.index("distance")].contiguous()
    mean = torch.segment_reduce(log_distance, "mean", lengths=landmarks.counts)
    quantities = np.tile(of_camera, (len(landmarks), 1))
    counts = n_visible.cpu().numpy()
    quantities[:, 0] = mean.exp().cpu().numpy()
    quantities[:, 2] = np.where(counts > 0, counts, np.nan)
    return quantities


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


@dataclass(frozen=True)
class MapCalibration:
    """Errors of poses and probabilities of detection on a map of photographs, by its own images.

    Standard errors are over held-out blocks of the images, None where the images determine nothing. Adapted weights store
    the scale alone; their network contains the offset.
    """

    error_scale: float  # pixels: the map's keypoint noise times a factor by its tracks
    log_error_scale_error: float | None = None
    error_spread: float | None = None  # standard deviation of the log errors of positions, the same for all maps
    detection_offset: float | None = None  # of the log-odds of detection
    detection_offset_error: float | None = None

    def describe(self) -> str:
        """State the numbers for a summary."""
        text = f"calibration by the map's images: pose errors as by a keypoint noise of {self.error_scale:.2f} px"
        if self.log_error_scale_error is not None:
            text += f" (standard error {self.log_error_scale_error:.0%})"
        if self.error_spread is not None:
            text += f", with a deviation of their logs of {self.error_spread:.2f}"
        if self.detection_offset is not None:
            text += f"; offset of the log-odds of detection {self.detection_offset:+.2f}"
        if self.detection_offset_error is not None:
            text += f" (standard error {self.detection_offset_error:.2f})"
        return text


@dataclass(frozen=True, eq=False)
class TrainedNetwork(Generic[NetworkT]):
    """A network and the calibration scale * logit + offset of its logits."""

    method: str
    network: NetworkT
    camera: Camera | None  # of its training views; None for several
    scale: float = 1.0
    offset: float = 0.0
    training_range: TrainingRange | None = None  # of its training views; None if the weights do not store it
    accuracy: Accuracy = ACCURACY  # limits of its training views' errors, in metres and degrees
    of_map: MapCalibration | None = None  # see `scorers.set.score.for_map`; None for a map of renders

    def __post_init__(self) -> None:
        self.network.eval()

    def calibrated(self, logits: Tensor) -> Tensor:
        """Return calibrated log-odds of the network's logits, in the same shape and precision."""
        return self.scale * logits + self.offset

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
            offset = finite(header.get("offset", 0.0))
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
        return TrainedNetwork(header["method"], network, camera, scale, offset, training_range, accuracy)


def finite(value: Any) -> float:
    """Return a number of a header; ValueError if it is not finite."""
    number = float(value)
    if not isfinite(number):
        raise ValueError(f"{value} is not a finite number")
    return number
