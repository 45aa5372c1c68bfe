"""Occlusion that is computed once for a location, whoever asks again."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float
from wheretolook.visibility.occlusion import DevicePoints, OcclusionModel

DECIMALS = 5  # locations that agree to this many decimals of a metre are one


class CachedOcclusion(OcclusionModel):
    """Another model's answers for the landmarks of one map, kept as a bit for each line of sight.

    Hidden-point removal takes a tenth of a second for a location, and is asked several times: for the scores of all
    directions, then for those of the best views, and for what these see. At most `most_bytes` are kept; then all is
    forgotten. Not for several threads that ask about the same location.
    """

    def __init__(self, model: OcclusionModel, most_bytes: int = 1 << 30) -> None:
        self.model = model
        self.most_bytes = most_bytes
        self.name = model.name
        self.uses_all_cores = model.uses_all_cores
        self.landmarks_hide = model.landmarks_hide
        self._known: dict[tuple[float, ...], NDArray[np.uint8]] = {}
        self._bytes = 0

    def unoccluded(self, locations: Float, points: Float) -> NDArray[np.bool_]:
        """As the model's, (L, N)."""
        at = np.asarray(locations, dtype=np.float64).reshape(-1, 3)
        keys = [tuple(key) for key in (np.round(at, DECIMALS) + 0.0).tolist()]
        new = [row for row, key in enumerate(keys) if key not in self._known]
        mask = np.empty((len(at), len(points)), dtype=bool)
        if new:
            mask[new] = self.model.unoccluded(at[new], points)
        known = [row for row, key in enumerate(keys) if key in self._known]
        for row in known:
            mask[row] = np.unpackbits(self._known[keys[row]], count=len(points)).view(bool)
        for row, packed in zip(new, np.packbits(mask[new], axis=1), strict=True):
            if self._bytes + packed.nbytes > self.most_bytes:
                self._known = {}
                self._bytes = 0
            self._known[keys[row]] = packed
            self._bytes += packed.nbytes
        return mask

    def unoccluded_on_device(self, locations: Float, points: DevicePoints) -> Any | None:
        """As the model's where that is on a GPU, which need not remember; else by `unoccluded`."""
        if points.device != "cpu" and not self.uses_all_cores:
            return self.model.unoccluded_on_device(locations, points)
        return super().unoccluded_on_device(locations, points)

    def inside_geometry(self, locations: Float) -> NDArray[np.bool_]:
        """As the model's, (L,)."""
        return self.model.inside_geometry(locations)

    def check(self, locations: Float, points: Float) -> None:
        """As the model's."""
        self.model.check(locations, points)
