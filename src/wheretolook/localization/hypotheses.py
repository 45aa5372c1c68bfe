"""Pose hypotheses of a rig: sampled by RANSAC, refined on all their inliers, and matched again under their guidance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import poselib
from numpy.typing import NDArray

from wheretolook.geometry.pose_information import N_NUMBERS, bearing_numbers, information_matrices
from wheretolook.geometry.poses import Float, camera_centers, compose_poses, invert_poses, pose_error
from wheretolook.localization.estimation import REFINEMENT, PoseEstimator, poselib_camera, squared_errors
from wheretolook.localization.guided_matching import match_under
from wheretolook.localization.joint_refinement import refine_rotations
from wheretolook.localization.rig import Look

MIN_POSE_SEPARATION = 0.5, 10.0
"""Hypotheses closer than this (m, deg) are the same pose."""

GUIDED_RADII_PX = (12.0, 6.0)
"""Radii of guided matching: the first corrects the error of a pose from few matches."""

REFINEMENT_ROUNDS = 3
"""Refinements of a pose on its inliers, which are then determined again; mostly the second gives the same."""

RIVAL_TRIALS = 1000
"""Maximum RANSAC trials on the matches that agree with no earlier pose: enough for a pose with a sixth of these."""

N_SAMPLED_POSES = 3
"""Poses that RANSAC estimates from the matches of all views, each from those that agree with none before it."""

JOINT_REFINEMENT = {"loss_type": "CAUCHY", "loss_scale": 0.5}
"""Loss for several views, in pixels. Near the right pose, 96.2 % are then within 5 cm and 0.4 degrees for two views of
validation scenes, and 93.4 % with a scale of one pixel; for a single view both scales are equally good."""

MIN_REFINED_SUPPORT_RATIO = 0.9
"""Support that a pose must retain when it is refined: accurate keypoints weigh more there than in the support, so it
may fall a little as the pose improves."""

MIN_MATCHES = 4
"""Matches of all views together needed to estimate a pose: one more than determine it."""

SingleViewPoses = tuple[tuple[Float, NDArray[np.bool_]], ...]
"""Poses (3, 4) of a view localized as a single image, in the estimator's world, with the inlier mask of each."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A pose of the rig, in the estimator's world, with the matches it is judged by, its inliers and its support.

    Attributes:
        rig: the views with their matches: those of all hypotheses, or those found under the guidance of this one.
        rig_from_world: (3, 4).
        cams_from_world: (N, 3, 4) poses of the views.
        inliers: N masks (M_k,) of the matches of each view.
        support: sum over inliers of a weight that falls from 1 to 0 as the error rises to its limit.
    """

    rig: RigMatches
    rig_from_world: Float
    cams_from_world: Float
    inliers: tuple[NDArray[np.bool_], ...]
    support: float

    @property
    def n_inliers(self) -> int:
        """Inliers of all views."""
        return int(sum(mask.sum() for mask in self.inliers))

    @property
    def inlier_rows(self) -> NDArray[np.int64]:
        """Rows of the landmarks that agree with the pose."""
        return np.concatenate([look.rows[mask] for look, mask in zip(self.rig.looks, self.inliers, strict=True)])

    @property
    def covariance(self) -> Float:
        """Covariance (6, 6) of position (m) and orientation (rad), from the inliers and their errors.

        Off the optical axis a pixel spans a smaller angle: by the cosine squared along and the cosine across. Infinite
        where the inliers do not determine the pose.
        """
        numbers = np.zeros(N_NUMBERS)
        total = 0.0
        for look, mask, cam in zip(self.rig.looks, self.inliers, self.cams_from_world, strict=True):
            points = self.rig.estimator.points[look.rows[mask]]
            offsets = points - camera_centers(cam)
            cosine = np.clip(offsets @ cam[2, :3] / np.linalg.norm(offsets, axis=1), 0.05, 1)
            numbers += (look.camera.mean_focal_px / cosine) ** 2 @ bearing_numbers(offsets)
            total += float(squared_errors(look.camera, look.pixels[mask], points, cam).sum())
        information = information_matrices(numbers)
        if self.n_inliers <= 3 or np.linalg.cond(information) > 1e14:
            return np.full((6, 6), np.inf)
        return np.linalg.inv(information) * max(total / (2 * self.n_inliers - 6), 0.01)

    def differs_from(self, other: Hypothesis) -> bool:
        """Whether this is another pose (see `MIN_POSE_SEPARATION`)."""
        return bool(np.greater(pose_error(self.rig_from_world, other.rig_from_world), MIN_POSE_SEPARATION).any())


class RigMatches:
    """Views and their matches in the form that PoseLib takes, and the pose hypotheses that they support."""

    def __init__(self, estimator: PoseEstimator, looks: Sequence[Look], turn_noise_deg: float) -> None:
        self.estimator = estimator
        self.looks = looks
        self.turn_noise_deg = turn_noise_deg
        inputs = [poselib_camera(look.camera.colmap, np.asarray(look.pixels, dtype=np.float64)) for look in looks]
        self.cameras = [camera for camera, _ in inputs]
        self.pixels = [pixels for _, pixels in inputs]
        self.points = [estimator.points[look.rows] for look in looks]
        self.cam_from_rig = np.stack([look.cam_from_rig for look in looks])
        self.poselib_rig = [_poselib_pose(pose) for pose in self.cam_from_rig]
        self.noise_rad = np.radians(turn_noise_deg) if len(looks) > 1 else 0.0
        focal_px = max(look.camera.mean_focal_px for look in looks)
        # error limit until rotations are refined
        self.loose_px = float(np.hypot(estimator.config.max_error_px, 4 * self.noise_rad * focal_px))

    def hypotheses(self, single_view_poses: Sequence[SingleViewPoses]) -> list[Hypothesis]:
        """Distinct refined poses by decreasing support, from the matches of all views and from each view's poses."""
        poses = []
        left = [np.ones(len(pixels), dtype=bool) for pixels in self.pixels]
        for trials in (None, *(N_SAMPLED_POSES - 1) * [RIVAL_TRIALS]):
            if len(self.looks) == 1:  # its poses are sampled already
                break
            sampled = self._sample(left, trials)
            if sampled is None:
                break
            poses.append(sampled)
            left = [mask & ~inlier for mask, inlier in zip(left, sampled.inliers, strict=True)]
        for k, single in enumerate(single_view_poses):
            poses += [self.refine(self.rig_pose(k, pose)) for pose, _ in single]
        return distinct(poses)

    def first_poses(self, poses: SingleViewPoses) -> list[Hypothesis]:
        """Poses of the only view as its single-image localization left them, in their order."""
        hypotheses = []
        for pose, mask in poses:
            evaluated = self._evaluate(self.rig_pose(0, pose))
            hypotheses.append(replace(evaluated, inliers=(mask,)))
        return hypotheses

    def guided(self, hypothesis: Hypothesis) -> Hypothesis:
        """Match all keypoints again under a hypothesis and refine it, with a radius that decreases."""
        for radius_px in GUIDED_RADII_PX:
            cams = hypothesis.cams_from_world
            views = zip(self.looks, self._candidates, cams, strict=True)
            looks = [match_under(look, points, pose, radius_px) for look, points, pose in views]
            rig = RigMatches(self.estimator, looks, self.turn_noise_deg)
            if sum(len(look.rows) for look in looks) < MIN_MATCHES:
                return hypothesis
            hypothesis = rig.refine(hypothesis.rig_from_world)
        return hypothesis

    @cached_property
    def _candidates(self) -> list[Float]:
        """Points (M, 3) m of each view's candidates."""
        return [self.estimator.points[look.candidates.landmarks] for look in self.looks if look.candidates]

    def rig_pose(self, k: int, cam_from_world: Float) -> Float:
        """rig_from_world (3, 4) from the pose of view k."""
        return compose_poses(invert_poses(self.cam_from_rig[k]), cam_from_world)

    def _sample(self, masks: Sequence[NDArray[np.bool_]], max_trials: int | None) -> Hypothesis | None:
        """Estimate a pose by RANSAC over masked matches of all views, and refine it."""
        if sum(mask.sum() for mask in masks) < MIN_MATCHES:
            return None
        options = {**self.estimator.ransac, "max_reproj_error": self.loose_px}
        options["max_iterations"] = max_trials or options["max_iterations"]
        pose, info = poselib.estimate_generalized_absolute_pose(
            *self._masked(masks), self.poselib_rig, self.cameras, options, REFINEMENT
        )
        if info["num_inliers"] < MIN_MATCHES or not np.isfinite(pose.Rt).all():
            return None
        return self.refine(pose.Rt)

    def _masked(self, masks: Sequence[NDArray[np.bool_]]) -> list[list[NDArray[Any]]]:
        """Pixels and points of the masked matches of each view."""
        return [
            [values[mask] for values, mask in zip(of_views, masks, strict=True)]
            for of_views in (self.pixels, self.points)
        ]

    def refine(self, rig_from_world: Float) -> Hypothesis:
        """Refine a pose on the inliers of all views until they stay the same."""
        best = self._evaluate(rig_from_world, self.loose_px)
        for _ in range(REFINEMENT_ROUNDS):
            if best.n_inliers < MIN_MATCHES:
                break
            if self.noise_rad:
                rig, cams = refine_rotations(
                    self.looks, self.points, best.inliers, best.rig_from_world, best.cams_from_world, self.noise_rad
                )
                best = self._evaluate(rig, cams=cams)
                continue
            start = _poselib_pose(best.rig_from_world)
            pose, _ = poselib.refine_generalized_absolute_pose(
                *self._masked(best.inliers), start, self.poselib_rig, self.cameras, JOINT_REFINEMENT
            )
            if not np.isfinite(pose.Rt).all():
                break
            refined = self._evaluate(pose.Rt)
            if refined.support < MIN_REFINED_SUPPORT_RATIO * best.support:
                break
            same = np.array_equal(np.concatenate(best.inliers), np.concatenate(refined.inliers))
            best = refined
            if same:
                break
        return best

    def _evaluate(self, rig_from_world: Float, limit_px: float | None = None, cams: Float | None = None) -> Hypothesis:
        """Inliers and support of a pose, given the poses of the views if rotations are refined."""
        limit_px = limit_px or self.estimator.config.max_error_px
        if cams is None:
            cams = compose_poses(self.cam_from_rig, rig_from_world)
        inliers = []
        support = 0.0
        for look, points, pose in zip(self.looks, self.points, cams, strict=True):
            squared = squared_errors(look.camera, look.pixels, points, pose) / limit_px**2
            inliers.append(squared < 1)
            support += float((1 - squared[squared < 1]).sum())
        return Hypothesis(self, rig_from_world, cams, tuple(inliers), support)


def distinct(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Hypotheses by decreasing support, without those that repeat the pose of a better one."""
    kept: list[Hypothesis] = []
    for hypothesis in sorted(hypotheses, key=lambda pose: -pose.support):
        if all(hypothesis.differs_from(other) for other in kept):
            kept.append(hypothesis)
    return kept


def _poselib_pose(pose: Float) -> poselib.CameraPose:
    result = poselib.CameraPose()
    result.R = pose[:, :3]
    result.t = pose[:, 3]
    return result
