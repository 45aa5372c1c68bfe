"""Occlusion models: which landmarks have a free line of sight from a location (paper, Sec. 3.2).

Occlusion depends on the location only, so one answer serves every direction a camera may look in from there.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from wheretolook.errors import TableError
from wheretolook.geometry import Float

if TYPE_CHECKING:
    from wheretolook.rendering.raycasting import MeshRaycaster

MATCH_M = 1e-4
"""Locations closer than this are taken for the same stored location."""


class OcclusionModel(Protocol):
    """Tells which landmarks nothing stands in front of."""

    def unoccluded(self, locations: Float, points: Float) -> NDArray[np.bool_]:
        """Lines of sight from locations (L, 3) m to points (N, 3) m; (L, N), True where free."""
        ...


class NoOcclusion:
    """Sees through walls: every landmark has a free line of sight, as in the paper's released code."""

    def unoccluded(self, locations: Float, points: Float) -> NDArray[np.bool_]:
        """All True, (L, N)."""
        return np.ones((len(locations), len(points)), dtype=bool)


class MeshOcclusion:
    """Exact occlusion by the scene's mesh: one ray for each location and landmark.

    Args:
        raycaster: the mesh.
        margin_m: a surface this close in front of a landmark is the landmark's own.
    """

    def __init__(self, raycaster: MeshRaycaster, margin_m: float = 0.05) -> None:
        self.raycaster, self.margin_m = raycaster, margin_m

    def unoccluded(self, locations: Float, points: Float) -> NDArray[np.bool_]:
        """(L, N), True where no triangle stands between location and landmark."""
        return ~self.raycaster.occluded(locations, points, margin_m=self.margin_m)


class StoredOcclusion:
    """Occlusion computed once for the locations of a dataset and read back, so that no mesh is needed any more.

    Args:
        locations: (L, 3) metres.
        mask: (L, N), True where the line of sight is free; columns follow the map's landmarks.
    """

    def __init__(self, locations: ArrayLike, mask: ArrayLike) -> None:
        self.locations = np.asarray(locations, dtype=np.float64)
        self.mask = np.asarray(mask, dtype=bool)
        self._tree = cKDTree(self.locations)

    def unoccluded(self, locations: Float, points: Float) -> NDArray[np.bool_]:
        """(L, N) rows of the stored mask.

        Raises:
            TableError: a location was not stored, or the mask belongs to a map with another number of landmarks.
        """
        if len(points) != self.mask.shape[1]:
            raise TableError(
                f"stored occlusion is of {self.mask.shape[1]} landmarks, the map has {len(points)}",
                fix="Run the sample stage again: the map has changed since.",
            )
        distance, row = self._tree.query(np.asarray(locations), distance_upper_bound=MATCH_M)
        if not np.all(np.isfinite(distance)):
            unknown = np.asarray(locations)[~np.isfinite(distance)][0]
            raise TableError(
                "no stored occlusion for this location",
                value=tuple(np.round(unknown, 3).tolist()),
                fix="Use a mesh for free locations, or sample this location first.",
            )
        return self.mask[row]

    def save(self, path: Path) -> None:
        """Write locations and the bit-packed mask as a compressed NPZ, atomically."""
        partial = path.with_name(path.name + ".partial")
        with open(partial, "wb") as file:
            np.savez_compressed(
                file, locations=self.locations, mask=np.packbits(self.mask, axis=1), n_landmarks=self.mask.shape[1]
            )
        os.replace(partial, path)

    @classmethod
    def load(cls, path: Path) -> StoredOcclusion:
        """Read what `save` wrote.

        Raises:
            TableError: the file is missing or damaged.
        """
        try:
            with np.load(path) as data:
                return cls(data["locations"], np.unpackbits(data["mask"], axis=1, count=int(data["n_landmarks"])))
        except Exception as error:  # a damaged zip raises many kinds of errors
            raise TableError(
                f"cannot read stored occlusion: {error}", path=path, fix="Run the sample stage again."
            ) from error
