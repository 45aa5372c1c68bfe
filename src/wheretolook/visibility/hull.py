"""Convex hulls that contain the origin: their length along directions, and a filter of points far below them.

Most of the millions of landmarks around a location are deep below the hull, and need neither be passed to Qhull nor
compared with its facets. Directions are sorted into cells of an octahedral map. The farthest points of each cell span
an inner hull; points below it in all of their cell are skipped.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from wheretolook.geometry.poses import Float
from wheretolook.visibility.field_of_view import cells_of, octahedral_directions

LEAST_POINTS = 50_000  # of fewer, the hull of all takes no longer
_POINTS_IN_CELL = 8.0  # on average, with which it was fastest
_MOST_CELLS = 512  # along a side of the map
_ROUNDING = 1e-7  # by which, of a length, the hull may lie lower than computed here
_FLAT = 1e-12  # least volume that a facet's corners and the origin span
_NO_LENGTH = 1e-12  # keeps facets through the origin, which no direction leaves by, from dividing by zero


def may_be_near_hull(directions: Float, lengths: Float, margin: float) -> NDArray[np.bool_]:
    """Which points (N,) may lie on the convex hull of all and the origin, or less than a margin below it.

    They are given by unit vectors (N, 3) from the origin and positive lengths (N,). Those that surely do not are False.
    """
    every = np.ones(len(lengths), dtype=bool)
    if len(lengths) < LEAST_POINTS:
        return every
    size = 2 * min(_MOST_CELLS // 2, round(np.sqrt(len(lengths) / _POINTS_IN_CELL) / 2))
    cells = cells_of(directions, size)
    farthest = np.zeros(size**2)
    np.maximum.at(farthest, cells, lengths)
    chosen = lengths >= farthest[cells]
    try:
        hull = ConvexHull(np.concatenate([directions[chosen] * lengths[chosen, None], np.zeros((1, 3))]))
    except QhullError:  # the chosen ones lie in a plane
        return every
    return lengths + margin >= (_least_lengths(hull, size) * (1 - _ROUNDING))[cells]


def _least_lengths(hull: ConvexHull, size: int) -> Float:
    """Length (size^2,) that the hull reaches in all directions of each cell; 0 where it may not.

    The hull holds the points where the cell's corners leave it, and so all their mixes, in which every direction of the
    cell meets it. If these points are h or more from the origin, and their directions at most an angle a apart, mixes
    w have a squared length of at least h^2 times the sum of w_i w_j cos(a), which is h^2 cos(a).
    """
    edge = np.arange(size + 1) / size * 2 - 1
    corners = octahedral_directions(edge[None, :], edge[:, None])
    corners /= np.linalg.norm(corners, axis=-1, keepdims=True)
    lengths = _lengths_for_sure(hull, corners.reshape(-1, 3)).reshape(size + 1, size + 1)
    parts = [(slice(i, i + size), slice(j, j + size)) for i in (0, 1) for j in (0, 1)]
    pairs = [(a, b) for number, a in enumerate(parts) for b in parts[:number]]
    least = np.min([lengths[part] for part in parts], axis=0)
    cosine = np.min([(corners[a] * corners[b]).sum(-1) for a, b in pairs], axis=0)
    return np.asarray((least * np.sqrt(cosine.clip(0))).reshape(-1))


def _lengths_for_sure(hull: ConvexHull, directions: Float) -> Float:
    """Distances (M,) from the origin at which directions (M, 3) leave the hull; 0 for those that do not point into it.

    A direction leaves by a facet if it is a mix, without negative shares, of the directions of the facet's corners.
    """
    facet, _ = leaving_facets(hull, directions)
    a, b, c = np.moveaxis(hull.points[hull.simplices[facet]], 1, 0)
    sides = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    volume = (a * sides[:, 0]).sum(-1)
    volume[np.abs(volume) < _FLAT] = np.inf
    shares = np.einsum("nij,nj->ni", sides, directions) / volume[:, None]
    total = shares.sum(1)
    return np.where((shares >= -1e-9).all(1) & (total > 0.5), 1 / np.maximum(total, 0.5), 0.0)


def hull_length(hull: ConvexHull, directions: Float) -> Float:
    """Distance (N,) from the origin to where each of directions (N, 3) leaves a 3D convex hull that holds the origin.

    Directions are unit vectors that point into the hull.
    """
    return np.asarray(1 / np.maximum(leaving_facets(hull, directions)[1], _NO_LENGTH))


def leaving_facets(hull: ConvexHull, directions: Float) -> tuple[NDArray[np.int64], Float]:
    """The facets by which directions (N, 3) leave a 3D convex hull that holds the origin, and 1 over the distance to
    there, (N,) each.

    Along u, a facet's plane n x = d is met at d / (n u), and the hull's boundary at the least of these, that is, at the
    facet with the greatest u (n / d). The n / d are the corners of a convex polyhedron, the hull's dual. So moving from
    facet to better neighbouring facet ends at the best one, as in the simplex method. Directions are unit vectors that
    point into the hull.
    """
    dual = hull.equations[:, :3] / np.maximum(-hull.equations[:, 3:], _NO_LENGTH)
    centers = hull.points[hull.simplices].mean(axis=1)
    centers /= np.maximum(np.linalg.norm(centers, axis=1, keepdims=True), _NO_LENGTH)
    facet = cKDTree(centers).query(directions)[1]  # near the one looked for
    value = np.sum(dual[facet] * directions, axis=1)
    climbing = np.arange(len(directions))
    while len(climbing):
        neighbours = hull.neighbors[facet[climbing]]
        values = np.einsum("ijk,ik->ij", dual[neighbours], directions[climbing])
        best = values.argmax(axis=1)
        better = values.max(axis=1) > value[climbing]
        climbing = climbing[better]
        best = best[better]
        facet[climbing] = neighbours[better, best]
        value[climbing] = values[better, best]
    return facet, value
