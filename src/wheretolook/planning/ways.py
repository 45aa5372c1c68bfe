"""Whether a camera can get from one place to another, by a deterministic search on a grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from wheretolook.geometry.poses import Float
from wheretolook.space.free_space import FreeSpace
from wheretolook.space.mapped_space import MappedSpace

MOST = 200_000
"""Largest number of places on a grid."""

BLOCK = 10_000
"""Places tested for free space at a time."""

NEAREST = 8
"""Number of places on the grid from which a way to a given point is tried."""


class Ways:
    """A graph of free places on a grid over `space`, with edges between neighbours where a camera can go straight.

    `step_m` is the step of the grid; it is widened where there would be more than `MOST` places.
    """

    def __init__(self, space: FreeSpace | MappedSpace, step_m: float) -> None:
        self.space = space
        low, high = np.asarray(space.bounds, dtype=np.float64)
        step_m = max(step_m, float(np.prod(high - low) / MOST) ** (1 / 3))
        axes = [np.arange(a + step_m / 2, max(b, a + step_m), step_m) for a, b in zip(low, high, strict=True)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        number = np.full(points.shape[:3], -1)
        blocks = np.array_split(points.reshape(-1, 3), points.size // (3 * BLOCK) + 1)
        free = np.concatenate([space.is_free(block) for block in blocks]).reshape(number.shape)
        number[free] = np.arange(free.sum())
        self._places: Float = points[free]
        pairs = []
        for axis in range(3):
            here, there = (np.moveaxis(number, axis, 0)[part].ravel() for part in (slice(None, -1), slice(1, None)))
            both = (here >= 0) & (there >= 0)
            pairs.append(np.stack([here[both], there[both]], axis=1))
        edges = np.concatenate(pairs)
        edges = edges[space.segments_are_free(self._places[edges[:, 0]], self._places[edges[:, 1]])]
        n = len(self._places)
        graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
        self._part = connected_components(graph, directed=False)[1] if n else np.empty(0, dtype=np.int32)
        self._tree = cKDTree(self._places) if n else None

    def joins(self, a: ArrayLike, b: ArrayLike) -> bool:
        """Whether the grid has a way between points (3,) m."""
        return bool(self._parts_near(a) & self._parts_near(b))

    def _parts_near(self, point: ArrayLike) -> set[int]:
        at = np.asarray(point, dtype=np.float64)
        if self._tree is None:
            return set()
        near = np.atleast_1d(self._tree.query(at, k=min(NEAREST, len(self._places)))[1])
        straight = self.space.segments_are_free(np.tile(at, (len(near), 1)), self._places[near])
        return {int(part) for part in self._part[near[straight]]}
