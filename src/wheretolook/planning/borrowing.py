"""Views for places whose voxel is not free: those of a voxel nearby."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wheretolook.planning.path_planning import Space
from wheretolook.planning.viewpoint_map import ViewpointMap

REACH = 2
"""A voxel borrows from voxels at most this many away along each axis."""

INSIDE = np.stack(np.meshgrid(*[(-1 / 3, 0.0, 1 / 3)] * 3, indexing="ij"), -1).reshape(-1, 3)
"""Points of a voxel that are tested for free space (27, 3), relative to its centre in units of its size."""


def with_borrowed_views(viewpoint_map: ViewpointMap, space: Space) -> ViewpointMap:
    """A map for planners: voxels with free space but an occupied centre get the views of the nearest voxel in reach.

    A voxel is in reach if a camera can go straight to its centre, so nothing is borrowed through walls. In the result,
    a derived map (`MapOrigin.derived`), voxels share rows, so it can be neither saved nor updated.
    """
    grid = viewpoint_map.grid
    rows, centers = viewpoint_map.row_of_voxel.copy(), grid.centers()
    size = grid.voxel_m
    known = np.flatnonzero(rows >= 0)
    unknown = np.flatnonzero(rows < 0)
    points = centers[unknown][:, None] + INSIDE * size
    free = space.is_free(points.reshape(-1, 3)).reshape(len(unknown), len(INSIDE))
    order = np.argsort((INSIDE**2).sum(1), kind="stable")
    for voxel, own, is_free in zip(unknown, points, free, strict=True):
        if not is_free.any():
            continue
        start = own[order[is_free[order]][0]]  # the free point nearest to the centre
        near = known[(np.abs(centers[known] - centers[voxel]) <= (REACH + 1e-6) * size).all(1)]
        near = near[np.argsort(np.linalg.norm(centers[near] - start, axis=1), kind="stable")]
        if len(near):
            clear = space.segments_are_free(np.tile(start, (len(near), 1)), centers[near])
            if clear.any():
                rows[voxel] = viewpoint_map.row_of_voxel[near[int(np.argmax(clear))]]
    return replace(viewpoint_map, row_of_voxel=rows, origin=viewpoint_map.origin.derive("views borrowed by neighbours"))
