"""The field of view of a camera of any model, tabulated over the sphere of directions.

The table is the sphere's octahedral map (Praun and Hoppe, "Spherical parametrization and remeshing", 2003): the
octahedron |x| + |y| + |z| = 1 is unfolded onto the square [-1, 1]^2, which is cut into size x size square cells.
`cell_of` in `counting_kernel` finds the cell of a direction.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from wheretolook.geometry.camera import ColmapCamera
from wheretolook.geometry.poses import Float

COARSEST_SIZE = 256  # cells along the first table's side, and of a cell's side in the next
REFINEMENT = 4
TABLE_SIZE = 1024  # cells along a side of the table: 0.06 to 0.19 degrees from a cell's centre to its farthest corner
MAX_DEPTH_RAD = 0.25  # larger depths are clipped to this; few cells of the sphere need more

EDGE_SAMPLES = 2048  # pixels sampled along each edge of the image, and each side of a grid over it
GRID_SAMPLES = 512
BISECTIONS = 20  # of the gap between neighbouring centres on either side of the border, which is found to 1e-8 rad


@dataclass(frozen=True, eq=False)
class FieldOfView:
    """Lower bound on how far each direction of the camera frame is inside the field of view.

    Where the table says zero the camera itself must be asked. So one table serves every camera model, and the answer
    stays that of the model. (The table would miss a hole in the field of view smaller than a cell of the first table,
    or a lobe so narrow that it also falls between a grid of pixels. Only absurd distortion makes such.)
    """

    size: int  # cells along a side of the octahedral map
    # (size * size,) float32. Positive: every direction of the cell is in view and at least this angle from the border
    # of the field of view; negative: likewise out of view; zero: the border may pass through the cell.
    depth_rad: NDArray[np.float32]


@lru_cache(maxsize=8)
def tabulate(camera: ColmapCamera, size: int = TABLE_SIZE) -> FieldOfView:
    """The table of a camera, which takes half a second. The latest are kept.

    A large table is made from one with fewer cells: what is certain of a cell there is certain of its parts, and only
    the parts of the others are examined.
    """
    centers, radii = cell_centers(size)
    depth = np.zeros(size * size, dtype=np.float32)
    if size % REFINEMENT == 0 and size // REFINEMENT >= COARSEST_SIZE:
        coarse = tabulate(camera, size // REFINEMENT).depth_rad.reshape((size // REFINEMENT,) * 2)
        depth = coarse.repeat(REFINEMENT, axis=0).repeat(REFINEMENT, axis=1).reshape(-1)
    cells = np.flatnonzero(depth == 0)  # of which nothing is known yet
    seen = depth > 0
    seen[cells] = camera.sees(centers[cells])
    a, b = _neighbours(cells, size)
    a, b = (cell[seen[a] != seen[b]] for cell in (a, b))
    inside = np.where(seen[a], a, b)
    outside = np.where(seen[a], b, a)
    rays, on_edge = _rays_of_image(camera)
    border = np.concatenate([_border_between(camera, centers[inside], centers[outside]), rays[on_edge]])
    between_centers = rays[~seen[cells_of(rays, size)]]  # strips and lobes too narrow for the centres
    if len(border):
        chord, _ = cKDTree(border).query(between_centers)
        between_centers = between_centers[chord > 4 * radii.max()]
    border = np.concatenate([border, between_centers])
    sign = np.where(seen[cells], 1.0, -1.0)
    if len(border) == 0:
        depth[cells] = sign * MAX_DEPTH_RAD
        return FieldOfView(size, depth)
    reach = 2 * np.sin(MAX_DEPTH_RAD / 2)
    chord, _ = cKDTree(border).query(centers[cells], distance_upper_bound=reach, workers=-1)
    angle = 2 * np.arcsin(np.minimum(chord, reach) / 2)
    # Every point of a cell is within the cell's radius of its centre. Points found on the border are at most a cell apart, so the border
    # passes within a radius of one of them. The remaining half radius is a margin.
    depth[cells] = sign * np.maximum(angle - 2.5 * radii[cells], 0)
    return FieldOfView(size, depth)


def _neighbours(cells: NDArray[np.int64], size: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of cells (n,) and (n,) that share a side, of which at least one is among the given."""
    row, column = np.divmod(np.tile(cells, 4), size)
    step = np.repeat(((0, 1), (1, 0), (0, -1), (-1, 0)), len(cells), axis=0)
    row = row + step[:, 0]
    column = column + step[:, 1]
    # the map's edge folds onto itself, mirrored: beyond (row, size - 1) is (size - 1 - row, size - 1)
    across = (column < 0) | (column >= size)
    along = (row < 0) | (row >= size)
    row = np.where(across, size - 1 - row, row)
    column = np.where(along, size - 1 - column, column)
    return np.tile(cells, 4), row.clip(0, size - 1) * size + column.clip(0, size - 1)


def _rays_of_image(camera: ColmapCamera) -> tuple[Float, NDArray[np.bool_]]:
    """Unit rays (n, 3) that the camera sees through a grid of pixels and the image's edge, and which lie on it."""
    side = np.linspace(1e-9, 1 - 1e-9, EDGE_SAMPLES)
    coarse = side[:: EDGE_SAMPLES // GRID_SAMPLES]
    x, y = (part.ravel() for part in np.meshgrid(coarse, coarse))
    ends = np.full(EDGE_SAMPLES, side[0]), np.full(EDGE_SAMPLES, side[-1])
    x = np.concatenate([x, side, side, *ends]) * camera.width
    y = np.concatenate([y, *ends, side, side]) * camera.height
    rays = camera.unproject(np.column_stack([x, y]))
    on_edge = np.arange(len(rays)) >= len(rays) - 4 * EDGE_SAMPLES
    seen = camera.sees(rays)
    return rays[seen], on_edge[seen]


def _border_between(camera: ColmapCamera, seen: Float, unseen: Float) -> Float:
    """Points (n, 3) on the border of the field of view between unit directions (n, 3) in and out of view."""
    for _ in range(BISECTIONS):
        middle = seen + unseen
        middle /= np.linalg.norm(middle, axis=1, keepdims=True)
        is_seen = camera.sees(middle)[:, None]
        seen = np.where(is_seen, middle, seen)
        unseen = np.where(is_seen, unseen, middle)
    return seen


def octahedral_directions(u: ArrayLike, v: ArrayLike) -> Float:
    """Directions (..., 3) with |x| + |y| + |z| = 1 of points (u, v) of the octahedral map, each in [-1, 1]."""
    u, v = np.broadcast_arrays(np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64))
    z = 1 - np.abs(u) - np.abs(v)
    sign_u = np.where(u >= 0, 1.0, -1.0)
    sign_v = np.where(v >= 0, 1.0, -1.0)
    x = np.where(z >= 0, u, (1 - np.abs(v)) * sign_u)
    y = np.where(z >= 0, v, (1 - np.abs(u)) * sign_v)
    return np.stack([x, y, z], axis=-1)


def cell_centers(size: int) -> tuple[Float, Float]:
    """Unit directions (size^2, 3) of cells' centres, and the angle (size^2,) rad from each to its farthest corner."""
    middle = (np.arange(size) + 0.5) / size * 2 - 1
    edge = np.arange(size + 1) / size * 2 - 1
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
    sign_x = np.where(x >= 0, 1.0, -1.0)
    sign_y = np.where(y >= 0, 1.0, -1.0)
    u = np.where(z >= 0, x, (1 - np.abs(y)) * sign_x)
    v = np.where(z >= 0, y, (1 - np.abs(x)) * sign_y)
    column, row = (np.clip(((part + 1) / 2 * size).astype(np.int64), 0, size - 1) for part in (u, v))
    return row * size + column
