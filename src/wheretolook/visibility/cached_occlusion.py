"""Caches the unoccluded landmarks of locations."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float
from wheretolook.visibility.occlusion import DevicePoints, OcclusionModel

DECIMALS = 5  # locations that agree to this many decimals of a metre are one


class CachedOcclusion(OcclusionModel):
    """Caches the masks of another model, one bit for each line of sight.

    Hidden-point removal takes a tenth of a second for a location, and is evaluated several times: for the scores of all
    directions, for those of the best views, and for their visible landmarks. When `max_bytes` are exceeded the cache is
    cleared. Not safe for several threads with the same location.
    """

    def __init__(self, model: OcclusionModel, max_bytes: int = 1 << 30) -> None:
        self.model = model
        self.max_bytes = max_bytes
        self.name = model.name
        self.uses_all_cores = model.uses_all_cores
        self.landmarks_hide = model.landmarks_hide
        self._known: dict[tuple[float, ...], NDArray[np.uint8]] = {}

    def unoccluded(self, locations: Float, points: Float) -> NDArray[np.bool_]:
        """Mask (L, N) of the model, from the cache where possible."""
        at = np.asarray(locations, dtype=np.float64).reshape(-1, 3)
        of_points = len(points), float(np.sum(points))  # differ between sets of landmarks
        keys = [(*of_points, *key) for key in (np.round(at, DECIMALS) + 0.0).tolist()]
        new = [row for row, key in enumerate(keys) if key not in self._known]
        mask = np.empty((len(at), len(points)), dtype=bool)
        if new:
            mask[new] = self.model.unoccluded(at[new], points)
        for row, key in enumerate(keys):
            if key in self._known:
                mask[row] = np.unpackbits(self._known[key], count=len(points)).view(bool)
        for row, packed in zip(new, np.packbits(mask[new], axis=1), strict=True):
            if (len(self._known) + 1) * packed.nbytes > self.max_bytes:
                self._known = {}
            self._known[keys[row]] = packed
        return mask

    def unoccluded_on_device(self, locations: Float, points: DevicePoints) -> Any | None:
        """Mask of the model where that runs on a GPU, uncached; else by `unoccluded`."""
        if points.device != "cpu" and not self.uses_all_cores:
            return self.model.unoccluded_on_device(locations, points)
        return super().unoccluded_on_device(locations, points)

    def inside_geometry(self, locations: Float) -> NDArray[np.bool_]:
        """Result of the model, (L,)."""
        return self.model.inside_geometry(locations)

    def check(self, locations: Float, points: Float) -> None:
        """Validate by the model."""
        self.model.check(locations, points)
