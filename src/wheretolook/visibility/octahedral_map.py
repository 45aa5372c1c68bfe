"""The octahedral map of the sphere of directions (Praun and Hoppe, "Spherical parametrization and remeshing", 2003).

The octahedron |x| + |y| + |z| = 1 is unfolded onto the square [-1, 1]^2, which is cut into size x size square cells.
`cell_of` in `sphere_cells_kernel` finds the cell of a direction.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.poses import Float


def octahedral_directions(u: ArrayLike, v: ArrayLike) -> Float:
    """Directions (..., 3) with |x| + |y| + |z| = 1 of points (u, v) of the octahedral map, each in [-1, 1]."""
    u, v = np.broadcast_arrays(np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64))
    z = 1 - np.abs(u) - np.abs(v)
    sign_u, sign_v = np.where(u >= 0, 1.0, -1.0), np.where(v >= 0, 1.0, -1.0)
    x = np.where(z >= 0, u, (1 - np.abs(v)) * sign_u)
    y = np.where(z >= 0, v, (1 - np.abs(u)) * sign_v)
    return np.stack([x, y, z], axis=-1)


def cell_centers(size: int) -> tuple[Float, Float]:
    """Unit directions (size * size, 3) of the cells' centres, row by row, and the angle (size * size,) in radians from
    each to the farthest corner of its cell."""
    middle, edge = (np.arange(size) + 0.5) / size * 2 - 1, np.arange(size + 1) / size * 2 - 1
    centers = octahedral_directions(middle[None, :], middle[:, None])
    corners = octahedral_directions(edge[None, :], edge[:, None])
    centers /= np.linalg.norm(centers, axis=-1, keepdims=True)
    corners /= np.linalg.norm(corners, axis=-1, keepdims=True)
    chords = [np.linalg.norm(centers - corners[i : i + size, j : j + size], axis=-1) for i in (0, 1) for j in (0, 1)]
    return np.asarray(centers.reshape(-1, 3)), 2 * np.arcsin(np.max(chords, axis=0) / 2).reshape(-1)


def cells_of(directions: ArrayLike, size: int) -> NDArray[np.int64]:
    """Cells (...) of directions (..., 3) of any length but zero: what `cell_of` in the kernels computes, in NumPy."""
    at = np.asarray(directions, dtype=np.float64)
    x, y, z = np.moveaxis(at / np.abs(at).sum(-1, keepdims=True), -1, 0)
    sign_x, sign_y = np.where(x >= 0, 1.0, -1.0), np.where(y >= 0, 1.0, -1.0)
    u = np.where(z >= 0, x, (1 - np.abs(y)) * sign_x)
    v = np.where(z >= 0, y, (1 - np.abs(x)) * sign_y)
    column, row = (np.clip(((part + 1) / 2 * size).astype(np.int64), 0, size - 1) for part in (u, v))
    return row * size + column
