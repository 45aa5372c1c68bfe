"""The views that the benchmark's baseline, max_visibility.py, selects in its released version."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import MapError
from wheretolook_paper.benchmark.files import CAMERA

ACTLOC = "max-visibility-shipped"
ACTLOC_FIXED = "max-visibility"

MAX_ERROR_PX = 0.5  # of counted landmarks
MAX_DEPTH_M = 3.0
_ELEVATIONS = np.arange(-60, 60, 20)
_AZIMUTHS = np.arange(-180, 180, 20)


def actloc_views(points: ArrayLike, waypoints: ArrayLike) -> Float:
    """Return poses (W, 3, 4) at waypoints (W, 3) m, given landmarks (N, 3) m with reprojection errors below 0.5 px.

    The baseline counts landmarks in the image within 3 m of depth, ignoring occlusion, in 6 x 18 views and takes the
    first view with the maximum. It then returns the view's azimuth and elevation exchanged. Its elevation is measured
    from the vertical, so all counted views look at least 30 degrees above the horizon, and those with a negative
    elevation are upside down. Without a landmark in reach its code fails; here the first view is returned.

    Raises a MapError if there is no landmark.
    """
    landmarks, centers = (np.asarray(values, dtype=np.float64).reshape(-1, 3) for values in (points, waypoints))
    if len(landmarks) == 0:
        raise MapError("the map has no landmark with a reprojection error below 0.5 px")
    angles = [(elevation, azimuth) for elevation in _ELEVATIONS.tolist() for azimuth in _AZIMUTHS.tolist()]
    world_from_cam = np.stack([orientation(azimuth, elevation) for elevation, azimuth in angles])
    poses = np.empty((len(centers), 3, 4))
    for row, center in enumerate(centers):
        rays = landmarks - center
        rays = rays[np.linalg.norm(rays, axis=1) < 4.0]  # farther landmarks are outside the image or deeper than that
        elevation, azimuth = angles[int(np.argmax([_count(rays @ rotation) for rotation in world_from_cam]))]
        rotation = orientation(elevation, azimuth).T  # exchanged, as in its code
        poses[row] = np.column_stack([rotation, -rotation @ center])
    return poses


def orientation(azimuth_deg: float, elevation_deg: float) -> Float:
    """Return world_from_cam (3, 3) of the baseline's angles: Rz(azimuth) Rx(elevation) Rz(180)."""
    a, e = np.radians((azimuth_deg, elevation_deg))
    about_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, np.cos(e), -np.sin(e)], [0, np.sin(e), np.cos(e)]])
    return np.asarray(about_z @ about_x @ np.diag([-1.0, -1.0, 1.0]))


def _count(points_cam: Float) -> int:
    """Count the points (N, 3) in the camera's frame that are in the image and near enough."""
    ahead = points_cam[(points_cam[:, 2] > 0) & (points_cam[:, 2] < MAX_DEPTH_M)]
    return int(CAMERA.in_image(CAMERA.project(ahead)).sum())
