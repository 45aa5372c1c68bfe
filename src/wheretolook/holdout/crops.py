"""Simulates narrower views from the keypoints of photographs, so that more of them fail to localize."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from wheretolook.geometry.camera import Camera, PinholeCamera, field_of_view_deg
from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import ConfigError

PANS = (0.0, -1.0, 1.0)  # of the crops of a photograph: the middle one, and those at its left and right side


@lru_cache(maxsize=64)
def crops_of(camera: Camera, fov_deg: float) -> tuple[PinholeCamera, Float]:
    """Return the pinhole of crops of a camera's images, and their rotations crop_from_camera (3, 3, 3).

    The pinhole has the camera's focal length and proportions, and the horizontal field of view `fov_deg`. Raises
    ConfigError if it is not narrower than the camera's.
    """
    whole_deg = field_of_view_deg(camera)[0]
    if not fov_deg < whole_deg:
        problem = "the photographs do not show more than the narrower views to simulate"
        raise ConfigError(problem, value=f"{fov_deg:g} of {whole_deg:.0f} degrees", fix="Give a smaller --fov.")
    focal = camera.colmap.mean_focal_px
    width = max(2, round(2 * focal * np.tan(np.radians(fov_deg) / 2)))
    pinhole = PinholeCamera(width, max(2, round(width * camera.height / camera.width)), focal)
    pans = np.multiply(PANS, (whole_deg - fov_deg) / 2)
    return pinhole, Rotation.from_euler("y", pans[:, None], degrees=True).as_matrix()


def crop_pixels(camera: Camera, pixels: Float, fov_deg: float, crop: int) -> tuple[Float, NDArray[np.bool_]]:
    """Return where pixels (K, 2) of a camera's image are in a crop, (K, 2), and which of them it shows, (K,)."""
    pinhole, rotations = crops_of(camera, fov_deg)
    rays = camera.colmap.unproject(np.asarray(pixels, dtype=np.float64)) @ rotations[crop].T
    ahead = rays[:, 2] > 1e-6
    moved = pinhole.project(np.where(ahead[:, None], rays, (0.0, 0.0, 1.0)))
    return moved, ahead & pinhole.in_image(moved)
