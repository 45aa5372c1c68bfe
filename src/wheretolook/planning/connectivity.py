"""Test whether free space connects two positions, to explain why no path was found."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.ndimage import label

from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.geometry.poses import Float

CELL_M = 0.1
MAX_CELLS = 100_000


def separating_cell_m(ends: Float, space: Any, bounds: Float) -> float | None:
    """Return the side in metres of the cells on which start and goal (2, 3) m are in separate parts of the free space.

    Cells of the box `bounds` (2, 3) m connect to their 26 neighbours. None if both are in one part.
    """
    size = bounds[1] - bounds[0]
    cell_m = max(CELL_M, float(np.prod(size) / MAX_CELLS) ** (1 / 3))
    nx, ny, nz = np.maximum(np.ceil(size / cell_m), 1).astype(int).tolist()
    centers = VoxelGrid.over(bounds, (nx, ny, nz)).centers()
    free = space.is_free(centers)
    if not free.any():
        return None
    parts = label(free.reshape(nx, ny, nz), np.ones((3, 3, 3)))[0].ravel()
    nearest = [np.where(free, np.linalg.norm(centers - end, axis=1), np.inf).argmin() for end in ends]
    return cell_m if parts[nearest[0]] != parts[nearest[1]] else None
