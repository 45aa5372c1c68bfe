"""Compares known rotations between the views of a rig with those of the views' own poses."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, product

import numpy as np

from wheretolook.geometry.poses import camera_centers, compose_poses, pose_error
from wheretolook.localization.estimation import PoseEstimator
from wheretolook.localization.hypotheses import Hypothesis, RigMatches, SingleViewPoses
from wheretolook.localization.rig import Look

MAX_DEVIATIONS = 4.0
"""Errors of so many standard deviations contradict the assumed noise: at most 0.1 % of those of three Gaussian angles do."""

MAX_POSITION_DEVIATION_M = 0.25  # between two views' own poses that are compared
MAX_DEVIATION_DEG = 1.0  # with larger ones, poses from a small part of the image have errors beyond their covariance
MOVE_M = 0.02  # of a camera that turns about its base


def turn_errors(
    estimator: PoseEstimator, looks: Sequence[Look], poses: Sequence[SingleViewPoses], noise_deg: float
) -> tuple[float, float]:
    """Compare known rotations, given their assumed noise, with each view's poses as a single image.

    Wrong poses of two views hardly ever agree in their location, so those that do are compared in their orientation.
    Returns the noise about each axis that explains the errors, and the largest error between two views, in degrees: if
    an error exceeds `MAX_DEVIATIONS` of the assumed noise and of the poses' own deviations. Otherwise the assumed noise
    and 0.
    """
    own = [_own_poses(estimator, look, of_view) for look, of_view in zip(looks, poses, strict=True)]
    pairs = [_smallest_error(first, second) for first, second in combinations(own, 2)]
    compared = np.array([pair for pair in pairs if pair is not None]).reshape(-1, 2)
    error, variance = compared.T
    if (error <= MAX_DEVIATIONS * np.sqrt(2 * noise_deg**2 + variance)).all():
        return noise_deg, 0.0
    noise = np.sqrt(np.maximum(error**2 / 3 - variance, 0).mean() / 2)
    return max(float(noise), noise_deg), float(error.max())


def _own_poses(estimator: PoseEstimator, look: Look, poses: SingleViewPoses) -> list[Hypothesis]:
    """Return a view's poses with enough inliers as those of the rig, refined on the view's inliers alone."""
    rig = RigMatches(estimator, [look], 0.0)
    refined = [rig.refine(rig.rig_pose(0, pose)) for pose, _ in poses]
    return [pose for pose in refined if pose.n_inliers >= estimator.config.min_inliers]


def _smallest_error(first: Sequence[Hypothesis], second: Sequence[Hypothesis]) -> tuple[float, float] | None:
    """Return the angle (deg) between two views' poses of the rig, and its variance about the least certain axis (deg^2).

    Of all pairs of poses that place the second view at the same location the one with the smallest angle; None if there
    is none. An error of the rotation moves this location by up to its chord times the distance between the views.
    """
    errors = []
    for pose, other in product(first, second):
        covariance = pose.covariance + other.covariance
        deviation_m = np.sqrt(np.trace(covariance[:3, :3]))
        (place,) = other.rig.cam_from_rig
        error_m, error_deg = pose_error(compose_poses(place, pose.rig_from_world), other.cams_from_world[0])
        apart_m = np.linalg.norm(camera_centers(place) - camera_centers(pose.rig.cam_from_rig[0]))
        moved_m = 2 * np.sin(np.radians(error_deg) / 2) * apart_m
        limit_m = MAX_DEVIATIONS * deviation_m + MOVE_M + moved_m
        if error_m < limit_m and deviation_m < MAX_POSITION_DEVIATION_M:
            variance = np.degrees(1) ** 2 * np.linalg.eigvalsh(covariance[3:, 3:])[-1]
            if variance < MAX_DEVIATION_DEG**2:
                errors.append((float(error_deg), float(variance)))
    return min(errors, default=None)
