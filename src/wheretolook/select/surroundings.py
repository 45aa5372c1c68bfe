"""Waypoints on a grid over free space, and checks of waypoints against a map."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.select.waypoints import Waypoints
from wheretolook.utils.errors import ConfigError, SceneError, TableError

if TYPE_CHECKING:
    from wheretolook.inputs.localization_map import LocalizationMap

MOST_LOCATIONS = 1_000_000  # voxels of a grid; more are refused before any work
REACH_SHARE = 0.95  # of the landmarks' mapping distances: so far from all of them nothing is known
ON_LANDMARK_M = 1e-6  # a place this close to a landmark is on a surface
LISTED = 5  # waypoints that an error names


def _short(x: float) -> str:
    """A coordinate to three digits, but to the metre at least."""
    return f"{x:.0f}" if abs(x) >= 1000 else f"{x:.3g}"


def grid_waypoints(localization_map: LocalizationMap, space: Any, spacing_m: float) -> Waypoints:
    """Places `spacing_m` apart in all free space; names are their voxels' ids.

    Raises a ConfigError if the spacing is no length or makes too many, a SceneError if none is free.
    """
    if not 0 < spacing_m < np.inf:
        raise ConfigError("the spacing of a grid is a length in metres", value=spacing_m, fix="Such as 0.5.")
    low, high = np.asarray(space.bounds, dtype=np.float64)
    cells = np.maximum(np.ceil((high - low) / spacing_m), 1)
    if np.prod(cells) > MOST_LOCATIONS:
        fix = f"The map is {high[0] - low[0]:.3g} x {high[1] - low[1]:.3g} x {high[2] - low[2]:.3g} m; widen the grid."
        raise ConfigError(f"the grid has more than {MOST_LOCATIONS:,} places", value=spacing_m, fix=fix)
    nx, ny, nz = (int(n) for n in cells)
    middle = (low + high) / 2
    half = cells * spacing_m / 2
    grid = VoxelGrid.over(np.stack([middle - half, middle + half]), (nx, ny, nz))
    centers = grid.centers()
    free = np.flatnonzero(space.is_free(centers))
    free = free[~localization_map.occlusion.inside_geometry(centers[free])]
    if len(free) == 0:
        raise SceneError("no place of the grid is free", value=spacing_m, fix="Narrow the grid.")
    return Waypoints(centers[free], tuple(map(str, free)))


def usable_waypoints(localization_map: LocalizationMap, waypoints: Waypoints, skip: bool = False) -> NDArray[np.bool_]:
    """At which waypoints views can be judged, (W,): at all of them, unless others are to be left out.

    Outside the map is what is farther from every landmark, and from every mapping camera, than all but 5 % of the
    landmarks were from the cameras that mapped them. Raises a TableError that names the first of those outside the map
    or inside geometry, or if none is left.
    """
    from scipy.spatial import cKDTree

    landmarks = localization_map.landmarks
    reach = float(np.quantile(landmarks.mapping_distance_m, REACH_SHARE))
    to_landmark = cKDTree(landmarks.points).query(waypoints.points)[0]
    nearest: Float = to_landmark
    if localization_map.mapping_poses is not None:
        centers = camera_centers(localization_map.mapping_poses.astype(np.float64))
        nearest = np.minimum(nearest, cKDTree(centers).query(waypoints.points)[0])
    outside = nearest > reach
    inside = ~outside & (to_landmark <= ON_LANDMARK_M)
    rest = np.flatnonzero(~outside & ~inside)
    inside[rest] = localization_map.occlusion.inside_geometry(waypoints.points[rest])
    bad = outside | inside
    if not bad.any() or (skip and not bad.all()):
        return np.asarray(~bad)
    problems = []
    for row in np.flatnonzero(bad)[:LISTED]:
        why = f"{nearest[row]:.3g} m from all landmarks and cameras" if outside[row] else "inside geometry"
        problems.append(f"{waypoints.where(row)} {why}")
    more = f", and {bad.sum() - LISTED} more" if bad.sum() > LISTED else ""
    problem = f"{bad.sum()} of {len(waypoints)} waypoints lie outside the map or inside geometry"
    low, high = np.quantile(landmarks.points, (0.01, 0.99), axis=0)
    box = " to ".join("(" + ", ".join(_short(x) for x in corner) + ")" for corner in (low, high))
    fix = f"The map's landmarks lie within {box}, in its unit: check unit and axes"
    fix += "." if bad.all() else ", or leave these out: --skip, in Python skip=True."
    raise TableError(problem, path=waypoints.path, value="; ".join(problems) + more, fix=fix)
