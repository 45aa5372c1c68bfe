"""Occlusion estimated from the landmarks alone: hidden-point removal (Katz et al., 2007)."""

from __future__ import annotations

from dataclasses import dataclass
from threading import Lock

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from wheretolook.geometry.poses import Float
from wheretolook.utils.devices import in_threads
from wheretolook.utils.errors import MapError, SceneError, check_range
from wheretolook.utils.processes import cores
from wheretolook.visibility.config import OcclusionConfig
from wheretolook.visibility.frustum import cell_corners, cells_of
from wheretolook.visibility.occlusion import OcclusionInputs, OcclusionModel

LEAST_POINTS = 50_000  # of fewer, the hull of all takes no longer
_NO_LENGTH = 1e-12  # keeps facets through the origin, which no direction leaves by, from dividing by zero


def may_be_near_hull(directions: Float, lengths: Float, margin: float) -> NDArray[np.bool_]:
    """Which points (N,) may lie on the convex hull of all and the origin, or less than a margin below it.

    They are given by unit vectors (N, 3) from the origin and positive lengths (N,). Those that surely do not are False.
    """
    every = np.ones(len(lengths), dtype=bool)
    if len(lengths) < LEAST_POINTS:
        return every
    size = 2 * min(256, round(np.sqrt(len(lengths) / 8) / 2))  # 8 points in a cell were fastest
    cells = cells_of(directions, size)
    farthest = np.zeros(size**2)
    np.maximum.at(farthest, cells, lengths)
    chosen = lengths >= farthest[cells]
    try:
        hull = ConvexHull(np.concatenate([directions[chosen] * lengths[chosen, None], np.zeros((1, 3))]))
    except QhullError:  # the chosen ones lie in a plane
        return every
    # by rounding, the hull may lie lower than computed here
    return lengths + margin >= (_least_lengths(hull, size) * (1 - 1e-7))[cells]


def _least_lengths(hull: ConvexHull, size: int) -> Float:
    """Length (size^2,) that the hull reaches in all directions of each cell; 0 where it may not.

    The hull holds the points where the cell's corners leave it, and so their convex combinations, in which every direction of the
    cell meets it. If these points are h or more from the origin, and their directions at most an angle a apart, mixes
    w have a squared length of at least h^2 times the sum of w_i w_j cos(a), which is h^2 cos(a).
    """
    corners = cell_corners(size)
    lengths = _least_hull_lengths(hull, corners.reshape(-1, 3)).reshape(size + 1, size + 1)
    parts = [(slice(i, i + size), slice(j, j + size)) for i in (0, 1) for j in (0, 1)]
    pairs = [(a, b) for number, a in enumerate(parts) for b in parts[:number]]
    least = np.min([lengths[part] for part in parts], axis=0)
    cosine = np.min([(corners[a] * corners[b]).sum(-1) for a, b in pairs], axis=0)
    return np.asarray((least * np.sqrt(cosine.clip(0))).reshape(-1))


def _least_hull_lengths(hull: ConvexHull, directions: Float) -> Float:
    """Distances (M,) from the origin at which directions (M, 3) leave the hull; 0 for those that do not point into it.

    A direction leaves by a facet if it is a mix, without negative shares, of the directions of the facet's corners.
    """
    facet, _ = leaving_facets(hull, directions)
    a, b, c = np.moveaxis(hull.points[hull.simplices[facet]], 1, 0)
    sides = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    volume = (a * sides[:, 0]).sum(-1)
    volume[np.abs(volume) < 1e-12] = np.inf
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


@dataclass(frozen=True, eq=False)
class _Places:
    """Distinct positions of a map's landmarks; computing them takes seconds for two million, so they are reused."""

    points: Float  # (N, 3)
    distinct: Float  # (P, 3) the places that differ
    place: NDArray[np.int64]  # (N,) rows of these
    tree: cKDTree  # of the distinct ones

    @classmethod
    def of(cls, points: Float) -> _Places:
        distinct, place = np.unique(points, axis=0, return_inverse=True)
        return cls(points.copy(), distinct, place.reshape(-1), cKDTree(distinct))


class HiddenPointRemoval(OcclusionModel):
    """Occlusion by hidden-point removal (Katz, Tal and Basri, "Direct Visibility of Point Sets", SIGGRAPH 2007).

    A landmark at distance r from a location is moved along its line of sight to the distance 2 R - r, which puts near
    landmarks outside of far ones. The landmarks on the convex hull of the moved ones and the location are those with a
    free line of sight. One hull serves all directions at the location.

    The larger R, the nearer to a sphere the moved landmarks lie and the more of them are found free: a small R loses
    landmarks on surfaces seen at a slant, a large one sees through surfaces with few landmarks on them. The result does
    not depend on the map's orientation, scale (if the margin is scaled with it) or order of landmarks. But R, and so
    the result, depends on the farthest landmark, even if that is an outlier far outside the scene.

    `radius` is R as a multiple of the distance from the location to the farthest landmark, at least 1. A landmark that
    would be free if it were `margin_m` nearer is free: what stands this close in front of it is its own surface, as in
    `MeshOcclusion`. A margin of 0 is the published method, with which a landmark is hidden by a neighbour a millimetre
    nearer. Each CPU core processes one location at a time. A hull takes about 0.4 KB a landmark while it is made. Raises a ConfigError if a value is out of range.
    """

    name = "hidden-points"
    uses_all_cores = True
    _lock = Lock()  # so that threads that ask about the same landmarks do not all sort them

    def __init__(self, radius: float = OcclusionConfig.radius, margin_m: float = 0.05) -> None:
        check_range("radius", radius, 1)
        check_range("margin_m", margin_m, 0)
        self.radius = float(radius)
        self.margin_m = float(margin_m)
        self._places: _Places | None = None  # of the landmarks that were asked about last

    @classmethod
    def from_inputs(cls, inputs: OcclusionInputs) -> HiddenPointRemoval:
        """Make the model with the options' radius and margin."""
        return cls(inputs.occlusion_config.radius, inputs.occlusion_config.margin_m)

    def unoccluded(self, locations: Float, points: Float) -> NDArray[np.bool_]:
        """(L, N), True where no surface that the landmarks suggest stands between; raises what `check` raises."""
        at = np.asarray(locations, dtype=np.float64)
        landmarks = np.asarray(points, dtype=np.float64)
        self.check(at, landmarks)
        places = self._places_of(landmarks)
        free = np.empty((len(at), len(landmarks)), dtype=bool)

        def fill(row: int) -> None:
            free[row] = self._free_from(at[row], places.distinct)[places.place]

        list(in_threads(fill, range(len(at)), cores()))
        return free

    def check(self, locations: Float, points: Float) -> None:
        """Validate locations (L, 3) m and points (N, 3) m, before any long work.

        Raises a MapError if there are no landmarks, or one is not finite; a SceneError if a location is not finite, or
        a landmark is at it, so that a camera there would be inside geometry. Without a mesh, other locations inside
        geometry are not detected.
        """
        super().check(locations, points)
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        if len(bad):
            raise MapError(f"{len(bad)} landmarks are not finite", value=points[bad[0]].tolist())
        tree = self._places_of(np.asarray(points, dtype=np.float64)).tree
        distance, _ = tree.query(locations, distance_upper_bound=2e-6)
        touching = np.asarray(locations)[distance <= 1e-6]  # metres: such a landmark has no direction
        if len(touching):
            problem = "a landmark is at the location, which is on a surface or inside geometry"
            raise SceneError(problem, value=touching[0].tolist(), fix="Choose locations in free space.")

    def _places_of(self, points: Float) -> _Places:
        with self._lock:
            if self._places is None or not np.array_equal(self._places.points, points):
                self._places = _Places.of(points)
            return self._places

    def _free_from(self, location: Float, places: Float) -> NDArray[np.bool_]:
        """Which of the distinct places (N, 3) are free from a location (3,); (N,)."""
        lines = places - location
        distance = np.linalg.norm(lines, axis=1)
        # in units of 2 R, so that the numbers are near 1 whatever the scale of the scene
        unit_m = 2 * self.radius * distance.max()
        return on_hull(lines / distance[:, None], 1 - distance / unit_m, self.margin_m / unit_m)


def on_hull(directions: Float, lengths: Float, margin: float = 0.0) -> NDArray[np.bool_]:
    """Which points (N,) lie on the convex hull of all and the origin, or less than a margin below it.

    They are given by unit vectors (N, 3) from the origin and positive lengths (N,). Same result as
    `on_hull_plain`, computed only for points that may be on the hull.
    """
    on = may_be_near_hull(directions, lengths, margin)
    on[on] = on_hull_plain(directions[on], lengths[on], margin)
    return on


def on_hull_plain(directions: Float, lengths: Float, margin: float = 0.0) -> NDArray[np.bool_]:
    """As `on_hull`, by the hull of all points."""
    points = directions * lengths[:, None]
    hull = ConvexHull(np.concatenate([points, np.zeros((1, 3)), _missing_axes(directions)]))
    on = np.zeros(len(hull.points), dtype=bool)
    on[hull.vertices] = True
    on = on[: len(points)]
    if margin > 0:
        inner = np.flatnonzero(~on)
        on[inner] = hull_length(hull, directions[inner]) - lengths[inner] <= margin
    return on


def _missing_axes(directions: Float) -> Float:
    """Unit vectors, each with its opposite, across the plane or the line that all directions (N, 3) lie in, if any.

    With them the hull has three dimensions, as Qhull needs; its section with the plane or line stays the same.
    """
    spread, axes = np.linalg.eigh(directions.T @ directions)
    across = axes[:, spread <= 1e-12 * len(directions)].T  # of the mean square along an axis
    return np.concatenate([across, -across])
