"""Estimates the pose of one image from its 2D-3D matches."""

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
"""Keypoints are accurate to a fraction of a pixel. PoseLib's default scale, half of RANSAC's limit, weighs outliers just
within the limit as accurate ones, which makes poses worse."""


class PoseEstimator:
    """Estimates the pose of an image from matches with points (N, 3) m by P3P in PoseLib's LO-RANSAC and refinement.

    It computes in metres from `origin`, so that coordinates of a national grid lose no precision.
    """

    def __init__(self, points: Float, config: LocalizerConfig = LocalizerConfig()) -> None:
        self.config = config
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
        """Estimate cam_from_world (3, 4) and the inlier mask (M,) from pixels (M, 2) and rows (M,) of the points.

        Needs four matches or more. Returns None if RANSAC finds no pose.
        """
        result = self.estimate_local(pixels, self.points[rows], camera)
        return None if result is None else (poses_from(result[0], -self.origin), result[1])

    def estimate_local(
        self, pixels: Float, points: Float, camera: Camera, max_trials: int | None = None
    ) -> tuple[Float, NDArray[np.bool_]] | None:
        """Estimate as `estimate`, but points (M, 3) and pose are in metres from `origin`."""
        camera_options, pixels = poselib_camera(camera.colmap, np.asarray(pixels, dtype=np.float64))
        options = {**self.ransac, "max_iterations": max_trials or self.config.max_trials}
        pose, info = poselib.estimate_absolute_pose(pixels, points, camera_options, options, REFINEMENT)
        if info["num_inliers"] < 3 or not np.isfinite(pose.Rt).all():  # fewer than three do not determine a pose
            return None
        return pose.Rt, np.asarray(info["inliers"], dtype=bool)


def squared_errors(camera: Camera, pixels: Float, points: Float, cam_from_world: Float) -> Float:
    """Squared reprojection errors (M,) of points (M, 3) at pixels (M, 2) of a pose's image; infinite behind it."""
    in_camera = cam_from_world[:, :3] @ points.T  # (3, M): coordinates are contiguous
    in_camera += cam_from_world[:, 3:]
    fisheye = camera.colmap.model.endswith("FISHEYE")
    ahead = np.arange(len(points)) if fisheye else np.flatnonzero(in_camera[2] > 1e-6)
    x, y = (camera.project(in_camera.take(ahead, axis=1).T) - pixels.take(ahead, axis=0)).T
    squared = x**2 + y**2
    result = np.full(len(points), np.inf)
    result[ahead] = np.where(np.isnan(squared), np.inf, squared)
    return result


POSELIB_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")


def poselib_camera(camera: ColmapCamera, pixels: Float) -> tuple[dict[str, Any], Float]:
    """Convert a camera and pixels (M, 2) of its image to what PoseLib takes.

    For a model that PoseLib does not support, pixels become those of a pinhole camera with the same focal length. Those
    more than 84 degrees off the axis are moved far outside the image, where they are never inliers.
    """
    if camera.model in POSELIB_MODELS:
        return camera.record(), pixels
    pinhole = PinholeCamera(camera.width, camera.height, camera.mean_focal_px)
    rays = camera.unproject(pixels)
    ahead = rays[:, 2:] > 0.1
    return pinhole.colmap.record(), np.where(ahead, pinhole.project(np.where(ahead, rays, (0, 0, 1))), 1e6)
