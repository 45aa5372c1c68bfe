"""Plausibility checks of maps of unknown origin: metres, z up, and the frame of a mesh."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.mapping.gravity import estimate_gravity
from wheretolook.utils.errors import MapWarning

if TYPE_CHECKING:
    from wheretolook.rendering.raycasting import MeshRaycaster

DISTANCE_M = (0.2, 50.0)
"""Plausible range of the median distance from mapping cameras to landmarks, from tabletops to plazas."""
SPACING_M = 5.0
"""Largest plausible median distance from a mapping camera to the nearest other one."""
TILT_DEG = {"level": 25.0, "mean": 50.0}
"""Largest plausible angle between z and the estimated up, by `Gravity.method`: people roll a camera by a few degrees,
but may tilt all their photographs of an object the same way."""
MESH_DISTANCE_M = (0.3, 100.0)
"""Largest plausible median distance of landmarks to a mesh, and the farthest distance that is measured."""
_MAX_MEASURED = 10_000  # landmarks whose distance to a mesh is measured: enough for a median
LOOKING_DOWN = 0.7  # mean of the cameras' axes along -z above which their roll does not determine up


def warn_of_mesh(mesh: str | Path, points: ArrayLike, raycaster: MeshRaycaster) -> None:
    """Issue a `MapWarning` if a map's landmarks (N, 3) m seem not to be in the frame or unit of a mesh."""
    if message := mesh_warning(points, raycaster):
        warnings.warn(f"{mesh}: {message}", MapWarning, stacklevel=2)


def mesh_warning(points: ArrayLike, raycaster: MeshRaycaster) -> str:
    """Message if a mesh seems not to be in a map's frame and unit, because landmarks (N, 3) m are far from it; else ""."""
    at = np.asarray(points, dtype=np.float64)
    at = at[:: max(1, -(-len(at) // _MAX_MEASURED))]
    off_m = float(np.median(raycaster.distance_to_surface(at, MESH_DISTANCE_M[1])))
    if not off_m > MESH_DISTANCE_M[0]:
        return ""
    far = f"{off_m:.2f} m or more" if np.isfinite(off_m) else f"more than {MESH_DISTANCE_M[1]:g} m"
    return (
        f"half of the landmarks are {far} from the mesh, so it seems to be in another frame or unit than the model. "
        "Export both in the same frame and unit; a mesh with y up (glTF's own) `wheretolook map --model` "
        "turns with --mapping.existing.mesh_up y"
    )


def scale_warning(mapping_distance_m: ArrayLike, centers: ArrayLike) -> str:
    """Message if a map seems not to be in metres; else "".

    Takes the mean distance of each landmark's mapping cameras (N,), and the cameras' centres (M, 3).
    """
    from scipy.spatial import cKDTree  # takes longer than all of --help

    distance = float(np.median(np.asarray(mapping_distance_m)))
    at = np.asarray(centers, dtype=np.float64)
    spacing = float(np.median(cKDTree(at).query(at, 2)[0][:, 1])) if len(at) > 1 else 0.0
    low, high = DISTANCE_M
    if low <= distance <= high and spacing <= SPACING_M:
        return ""
    lengths = f"landmarks are {distance:.3g} m from the cameras that mapped them, and these {spacing:.3g} m from the "
    lengths += f"nearest other (medians); plausible are {low:g} to {high:g} m, and at most {SPACING_M:g} m"
    fix = "Correct --scale, --distance or --positions. Ignore this warning if it is metric"
    return f"the model seems not to be in metres: {lengths}. {fix}"


def up_axis_warning(cam_from_world: ArrayLike) -> str:
    """Message if z seems not to be up in a map, by the poses (M, 3, 4) of its cameras; else ""."""
    poses = np.asarray(cam_from_world, dtype=np.float64)
    gravity = estimate_gravity(poses)
    off_deg = float(np.degrees(np.arccos(np.clip(gravity.up[2], -1, 1))))
    if off_deg <= TILT_DEG[gravity.method] or poses[:, 2, 2].mean() < -LOOKING_DOWN:
        return ""
    how = "upside down" if off_deg > 135 else "on their side" if off_deg > 45 else "askew"
    up = " ".join(f"{value:.2f}" for value in np.round(gravity.up, 2) + 0.0)  # no -0.00
    return (
        f"the cameras are {how}: the up direction estimated from their orientations is ({up}), {off_deg:.0f} degrees from z, which is "
        "up here. --up level turns it upright. Ignore this warning if the cameras were held so"
    )
