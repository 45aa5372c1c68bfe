"""The range of a model's training views, to detect views outside of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wheretolook.geometry.camera import Camera, field_of_view_deg
from wheretolook.geometry.poses import Float
from wheretolook.inputs.landmark_features import ViewLandmarks

QUANTITIES = {
    "distance_m": "mean distance of the landmarks in view {:.3g} m",
    "depth_m": "mean depth of the filled bins {:.3g} m",
    "in_view": "{:.0f} landmarks in view",
    "across_deg": "field of view across {:.1f} degrees",
    "down_deg": "field of view down {:.1f} degrees",
    "focal_px": "focal length {:.4g} px",
}
"""Quantities of a view, NaN where unknown, and their text in messages. The mean distance is geometric."""

OF_CAMERA = ("across_deg", "down_deg", "focal_px")
_ANGLES = ("across_deg", "down_deg")

QUANTILES = (0.005, 0.995)  # of the training views that bound the range
MARGIN = 1.25  # a range is wider than these quantiles: by this factor, or angle
MARGIN_DEG = 2.0


@dataclass(frozen=True)
class TrainingRange:
    """Lowest and highest value of some of `QUANTITIES` over the training views; the others are unbounded."""

    bounds: Mapping[str, tuple[float, float]]

    @classmethod
    def of(cls, quantities: Float, enlarged: float = 1.0) -> TrainingRange:
        """The range of views described by `QUANTITIES` (B, 6); those without landmarks do not count.

        If scenes come larger and smaller by up to a factor while learning, so do the distances.
        """
        seeing = quantities[_have_landmarks(quantities)]
        bounds = {}
        for name, values in zip(QUANTITIES, seeing.T, strict=True):
            known = values[np.isfinite(values)]
            if len(known):
                low, high = np.quantile(known, QUANTILES).tolist()
                factor = MARGIN * (enlarged if name == "distance_m" else 1.0)
                wider = (low - MARGIN_DEG, high + MARGIN_DEG) if name in _ANGLES else (low / factor, high * factor)
                bounds[name] = (round(wider[0], 4), round(wider[1], 4))
        return cls(bounds)

    @classmethod
    def of_camera(cls, camera: Camera | None) -> TrainingRange:
        """The range where nothing but the camera of the views is known: its field of view. Any, where it is not."""
        if camera is None:
            return cls({})
        angles = zip(_ANGLES, field_of_view_deg(camera), strict=True)
        return cls({name: (angle - MARGIN_DEG, angle + MARGIN_DEG) for name, angle in angles})

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> TrainingRange:
        """The range of a `record`. Raises KeyError, TypeError or ValueError if it is none."""
        return cls({name: (float(record[name][0]), float(record[name][1])) for name in QUANTITIES if name in record})

    def record(self) -> dict[str, list[float]]:
        """The bounds as JSON values."""
        return {name: list(bounds) for name, bounds in self.bounds.items()}

    @property
    def asks_for_landmarks(self) -> bool:
        """Whether the range bounds more than the camera."""
        return not {*self.bounds} <= {*OF_CAMERA}

    @cached_property
    def _limits(self) -> Float:
        """Lowest and highest value of each of `QUANTITIES`, (2, 6)."""
        return np.array([self.bounds.get(name, (-np.inf, np.inf)) for name in QUANTITIES]).T

    def outside(self, quantities: Float) -> NDArray[np.bool_]:
        """Which of `QUANTITIES` (B, 6) lie outside the range; what is not known does not."""
        low, high = self._limits
        return np.asarray((quantities < low) | (quantities > high))

    def contains(self, quantities: Float) -> NDArray[np.bool_]:
        """Which views, described by `QUANTITIES` (B, 6), are like those learnt from, (B,)."""
        return np.asarray(~self.outside(quantities).any(axis=1))

    def complaint(self, quantities: Float, tolerated: float = 0.0) -> str:
        """What is unlike the views learnt from, in words; "" if no more than this share of the views that see anything.

        Each quantity is reported by its median over the views where it is outside.
        """
        seeing = quantities[_have_landmarks(quantities)]
        outside = self.outside(seeing)
        n_outside = int(np.count_nonzero(outside.any(axis=1)))
        if n_outside <= tolerated * len(seeing):
            return ""
        parts = []
        for column, (name, text) in enumerate(QUANTITIES.items()):
            if outside[:, column].any():
                low, high = self.bounds[name]
                value = np.median(seeing[outside[:, column], column])
                parts.append(f"{text.format(value)} (trained on: {low:.3g} to {high:.3g})")
        return f"{n_outside} of {len(seeing)} views are unlike the training views: {', '.join(parts)}"


def _have_landmarks(quantities: Float) -> NDArray[np.bool_]:
    """Which views, described by `QUANTITIES` (B, 6), see any landmark, (B,): it then has a distance or a depth."""
    return np.asarray(np.isfinite(quantities[:, :2]).any(axis=1))


def camera_quantities(camera: Camera) -> Float:
    """`QUANTITIES` (6,) that the camera alone tells. One whose image has edges that no ray leads to sees all around."""
    angles = np.nan_to_num(field_of_view_deg(camera), nan=360.0)
    return np.array([np.nan, np.nan, np.nan, *angles, camera.mean_focal_px])


def bin_quantities(depth_sums: Float, n_filled: NDArray[np.integer[Any]]) -> Float:
    """`QUANTITIES` (B, 6) that bins tell: sums (B,) of the mean depths of a view's bins, and how many are filled."""
    found = np.full((len(depth_sums), len(QUANTITIES)), np.nan)
    some = n_filled > 0
    found[some, 1] = depth_sums[some] / n_filled[some]
    return found


def view_quantities(landmarks: ViewLandmarks, n_in_view: Tensor, of_camera: Float) -> Float:
    """`QUANTITIES` (B, 6) of views by landmarks that they see, all or a sample of the `n_in_view` (B,) of each.

    `of_camera` is what `camera_quantities` tells of the camera that looks.
    """
    log_distance = landmarks.values[:, landmarks.attributes.index("distance")].contiguous()
    mean = torch.segment_reduce(log_distance, "mean", lengths=landmarks.counts)
    found = np.empty((len(landmarks), len(QUANTITIES)))
    found[:] = of_camera
    counts = n_in_view.cpu().numpy()
    found[:, 0] = mean.exp().cpu().numpy()
    found[:, 2] = np.where(counts > 0, counts, np.nan)
    return found
