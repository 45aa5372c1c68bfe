"""The pose of one image from its 2D-3D matches: what every localization here, of one look or several, stands on."""

from __future__ import annotations

from typing import Any

import numpy as np
import poselib
from numpy.typing import NDArray

from wheretolook.geometry.camera import Camera, ColmapCamera, PinholeCamera
from wheretolook.geometry.local_origin import local_origin, poses_from
from wheretolook.geometry.poses import Float
from wheretolook.localization.config import LocalizerConfig

REFINEMENT = {"loss_type": "CAUCHY", "loss_scale": 1.0}
"""Keypoints are accurate to a fraction of a pixel. PoseLib's own scale is half of RANSAC's limit, as if outliers just
within the limit were accurate, too: poses are then worse."""


class PoseEstimator:
    """Estimates the pose of an image from its matches with points (N, 3) m: P3P in PoseLib's LO-RANSAC, then refined.

    It computes in metres from `origin`, so that the coordinates of a national grid lose nothing.
    """

    def __init__(self, points: Float, config: LocalizerConfig | None = None) -> None:
        self.config = config or LocalizerConfig()
        self.origin = local_origin(points)
        self.points = np.asarray(points, dtype=np.float64) - self.origin
        self.ransac = {
            "max_reproj_error": self.config.max_error_px,
            "seed": self.config.seed,
            "success_prob": self.config.confidence,
            "min_iterations": self.config.min_trials,
            "max_iterations": self.config.max_trials,
            "dyn_num_trials_mult": 1.0,  # as many trials as the confidence asks for; PoseLib makes three times as many
        }

    def estimate(
        self, pixels: Float, rows: NDArray[np.int64], camera: Camera
    ) -> tuple[Float, NDArray[np.bool_]] | None:
        """cam_from_world (3, 4), and which of the matches agree with it, (M,); None if RANSAC finds no pose.

        The matches are pixels (M, 2) of the camera's image, and rows (M,) of the points; at least four.
        """
        found = self.estimate_local(pixels, self.points[rows], camera)
        return None if found is None else (poses_from(found[0], -self.origin), found[1])

    def estimate_local(
        self, pixels: Float, points: Float, camera: Camera, trials: int | None = None
    ) -> tuple[Float, NDArray[np.bool_]] | None:
        """As `estimate`, of points (M, 3) in metres from `origin`; the pose is of the world with that origin.

        RANSAC makes so many trials at most, as many as the settings say unless given.
        """
        taken_with, seen = poselib_camera(camera.colmap, np.asarray(pixels, dtype=np.float64))
        options = {**self.ransac, "max_iterations": trials or self.config.max_trials}
        pose, found = poselib.estimate_absolute_pose(seen, points, taken_with, options, REFINEMENT)
        if found["num_inliers"] < 3 or not np.isfinite(pose.Rt).all():  # no three matches determine a pose
            return None
        return pose.Rt, np.asarray(found["inliers"], dtype=bool)


POSELIBS_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")


def poselib_camera(camera: ColmapCamera, pixels: Float) -> tuple[dict[str, Any], Float]:
    """A camera as PoseLib takes it, and pixels (M, 2) of its image.

    Of a model that PoseLib does not know, pixels become those of a pinhole with the same focal length, by their rays.
    Rays that it would not see, more than 84 degrees off its axis, go far outside, where they are nobody's inliers.
    """
    if camera.model in POSELIBS_MODELS:
        return camera.record(), pixels
    pinhole = PinholeCamera(camera.width, camera.height, camera.mean_focal_px)
    rays = camera.unproject(pixels)
    ahead = rays[:, 2:] > 0.1
    return pinhole.colmap.record(), np.where(ahead, pinhole.project(np.where(ahead, rays, (0, 0, 1))), 1e6)
