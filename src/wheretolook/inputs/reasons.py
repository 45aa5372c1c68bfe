"""Why landmarks in an image are not expected to be matched."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import cos, log, radians

import numpy as np
import torch
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float
from wheretolook.inputs.landmark_features import LandmarkDescriber
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.visibility.occlusion import NoOcclusion

TOO_FAR = 2.0  # distance over the mean mapping distance
TOO_OBLIQUE_DEG = 45.0  # angle to the mean mapping direction
REPEATED = 0.95  # cosine between the descriptor and the nearest one of another landmark
"""Limits of a landmark, beyond which the bundled weights expect it to be detected about half as often, or less."""


@dataclass(frozen=True, eq=False)
class ReasonCounts:
    """Numbers of landmarks that are hard to match in B views; a landmark may have several reasons."""

    n_occluded: NDArray[np.int64]  # (B,) in the image, but behind something
    n_too_far: NDArray[np.int64]  # (B,) of the visible ones
    n_too_oblique: NDArray[np.int64]  # (B,) of the visible ones
    n_repeated: Float  # (B,) of the visible ones; NaN for a map without descriptors


class ReasonCounter:
    """Counts the landmarks of a map that are hard to match in views of it, by reason."""

    def __init__(self, localization_map: LocalizationMap) -> None:
        hidden = not isinstance(localization_map.occlusion, NoOcclusion)
        self._unoccluded = replace(localization_map, occlusion=NoOcclusion()) if hidden else None
        self._describer = LandmarkDescriber(localization_map, ("distance_ratio", "mapped_angle", "ambiguity"))
        self._has_descriptors = bool(np.isfinite(localization_map.landmarks.ambiguity).any())

    def count(self, cam_from_world: Float) -> ReasonCounts:
        """Count for poses (B, 3, 4)."""
        n_occluded = np.zeros(len(cam_from_world), dtype=np.int64)
        if self._unoccluded is not None:
            starts, _ = self._unoccluded.in_view_on_device(cam_from_world)
            n_occluded += np.diff(starts)
        counts = np.zeros((len(cam_from_world), 3), dtype=np.int64)
        for rows, described, n_visible in self._describer.in_blocks(cam_from_world):
            if self._unoccluded is not None:
                n_occluded[rows] -= n_visible.cpu().numpy()
            ratio, cosine, ambiguity = described.values.unbind(1)
            limits = ratio > log(TOO_FAR), cosine < cos(radians(TOO_OBLIQUE_DEG)), ambiguity > REPEATED
            hard = torch.stack(limits, 1).double()
            sums = torch.segment_reduce(hard, "sum", lengths=described.counts, axis=0, initial=0.0)
            counts[rows] = sums.cpu().numpy()
        too_far, too_oblique, repeated = counts.T
        return ReasonCounts(n_occluded, too_far, too_oblique, repeated * (1.0 if self._has_descriptors else np.nan))
