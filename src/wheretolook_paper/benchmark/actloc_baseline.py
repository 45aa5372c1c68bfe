"""The views that the benchmark's baseline, max_visibility.py, returns as it ships."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import MapError
from wheretolook_paper.benchmark.folder import CAMERA

SHIPPED = "max-visibility-shipped"
MENDED = "max-visibility"

MAX_ERROR_PX = 0.5  # landmarks that count: below either
MAX_DEPTH_M = 3.0
_REACH_M = 4.0  # from a waypoint; none farther is in an image and within that depth
_ELEVATIONS = np.arange(-60, 60, 20)
_AZIMUTHS = np.arange(-180, 180, 20)


def shipped_views(points: ArrayLike, waypoints: ArrayLike) -> Float:
    """Poses cam_from_world (W, 3, 4) at waypoints (W, 3) m, of a map's landmarks (N, 3) with an error below 0.5 px.

    The baseline counts the landmarks in the image and nearer than 3 m, through walls, in 6 x 18 views, and takes the
    first view with most. It then returns that view's two angles exchanged: elevation for azimuth and azimuth for
    elevation. Besides, its elevation is from straight up, so that no view it counts looks lower than 30 degrees above
    level, and views of a negative one hang upside down. Where nothing is in reach, its code stops; here the first view
    stands for it.

    Raises a MapError if there is no landmark.
    """
    landmarks, places = (np.asarray(values, dtype=np.float64).reshape(-1, 3) for values in (points, waypoints))
    if len(landmarks) == 0:
        raise MapError("the baseline counts landmarks with a mean error below 0.5 px, and there are none", value=0)
    angles = [(elevation, azimuth) for elevation in _ELEVATIONS.tolist() for azimuth in _AZIMUTHS.tolist()]
    world_from_cam = np.stack([orientation(azimuth, elevation) for elevation, azimuth in angles])
    poses = np.empty((len(places), 3, 4))
    for row, place in enumerate(places):
        rays = landmarks - place
        rays = rays[np.linalg.norm(rays, axis=1) < _REACH_M]
        elevation, azimuth = angles[int(np.argmax([_count(rays @ rotation) for rotation in world_from_cam]))]
        rotation = orientation(elevation, azimuth).T  # exchanged, as in its code
        poses[row] = np.column_stack([rotation, -rotation @ place])
    return poses


def orientation(azimuth_deg: float, elevation_deg: float) -> Float:
    """Orientation (3, 3) of a camera in the world by the baseline's angles: Rz(azimuth) Rx(elevation) Rz(180)."""
    a, e = np.radians((azimuth_deg, elevation_deg))
    about_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, np.cos(e), -np.sin(e)], [0, np.sin(e), np.cos(e)]])
    return np.asarray(about_z @ about_x @ np.diag([-1.0, -1.0, 1.0]))


def _count(points_cam: Float) -> int:
    """How many points (N, 3) in the camera's frame are in the image and within reach."""
    ahead = points_cam[(points_cam[:, 2] > 0) & (points_cam[:, 2] < MAX_DEPTH_M)]
    return int(CAMERA.in_image(CAMERA.project(ahead)).sum())
