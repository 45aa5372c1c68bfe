"""Localizes several views jointly: one pose for a rig of views whose poses relative to one another are known.

A camera that rotates in place knows how far it rotated. So N views from a location are one generalized camera (Pless
2003), and all their matches must agree on one pose: where a map resembles itself, a single view may be localized at a
wrong pose with a hundred inliers, on which the others do not agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import poselib
from numpy.typing import NDArray

from wheretolook.dataset.viewpoint_table import LOCALIZED, NO_POSE, TOO_FEW_MATCHES
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.local_origin import poses_from
from wheretolook.geometry.pose_information import N_NUMBERS, bearing_numbers, information_matrices
from wheretolook.geometry.poses import Float, camera_centers, compose_poses, invert_poses, pose_error, transform
from wheretolook.localization.estimation import REFINEMENT, PoseEstimator, poselib_camera
from wheretolook.localization.joint_refinement import refine_rotations
from wheretolook.localization.pose_ambiguity import PoseAmbiguity, most_likely, strongest_rival
from wheretolook.localization.rig import Look
from wheretolook.utils.errors import PoseError
from wheretolook.utils.validation import check_range

MIN_POSE_SEPARATION = 0.5, 10.0
"""Hypotheses closer than this (m, deg) are the same pose."""

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
class JointLocalization:
    """The pose that the matches of several views support best, and how well.

    Attributes:
        status: "localized", "too_few_matches" or "no_pose", as for a single image.
        rig_from_world: (3, 4); None if there is none. With too few inliers it is kept, but the status is "no_pose".
        cams_from_world: (N, 3, 4) poses of the views, including their refined rotations if these were not exact.
        inliers: N masks (M_k,) of each view's matches that agree with the pose.
        n_matches: matches of all views.
        support: sum over inliers of a weight that falls from 1 to 0 as the error rises to its limit.
        rival_support: greatest support of a competing pose (see `MIN_POSE_SEPARATION`); 0 if there is none.
        unique_support: numbers of locations with inliers of this pose that the strongest rival cannot explain, and with
            inliers of the rival that this pose cannot explain (`PoseAmbiguity`); all and 0 if there is no rival.
        deviation: one standard deviation of the position (m) and of the orientation (degrees) given the inliers;
            infinite where they do not determine the pose.
    """

    status: str
    rig_from_world: Float | None
    cams_from_world: Float | None
    inliers: tuple[NDArray[np.bool_], ...]
    n_matches: int
    support: float = 0.0
    rival_support: float = 0.0
    unique_support: tuple[int, int] = (0, 0)
    deviation: tuple[float, float] = (np.inf, np.inf)

    @property
    def n_inliers(self) -> int:
        """Inliers of all views."""
        return int(sum(mask.sum() for mask in self.inliers))


class JointLocalizer:
    """Localizes views jointly against the points of a `PoseEstimator`; a single one exactly as the estimator does.

    Hypotheses come from PoseLib's LO-RANSAC (generalized P3P) over all matches, over those that agree with no earlier
    hypothesis, and from each view as a single image. Each is refined on the inliers of all views. The one with the most
    unique support wins (`pose_ambiguity`): where the map resembles itself, a wrong pose may have more inliers, but most
    of them the right pose explains, too. Errors are pixels of each view's own image, not angles, with which RANSAC
    would be twice as lenient near the border of an image.

    `turn_noise_deg` is one standard deviation, about each axis, of the known rotations between views.
    """

    def __init__(self, estimator: PoseEstimator, turn_noise_deg: float = 0.0) -> None:
        check_range("the noise of rotations in degrees", turn_noise_deg, 0, 90)
        self.estimator = estimator
        self.turn_noise_deg = turn_noise_deg

    @cached_property
    def ambiguity(self) -> PoseAmbiguity:
        """Ambiguity of the map."""
        return PoseAmbiguity(self.estimator.points)

    def localize_together(self, looks: Sequence[Look]) -> JointLocalization:
        """Localize two views or more. Raises PoseError for fewer."""
        if len(looks) < 2:
            raise PoseError("joint localization needs two views or more", value=len(looks))
        return self.localize(looks)

    def single_view_poses(self, look: Look) -> SingleViewPoses:
        """Localize a view as a single image, then the matches that disagree; `localize` accepts the result."""
        if len(look.rows) < self.estimator.config.min_matches:
            return ()
        points = self.estimator.points[look.rows]
        first = self.estimator.estimate_local(look.pixels, points, look.camera)
        if first is None:
            return ()
        left = np.flatnonzero(~first[1])
        if len(left) < MIN_MATCHES:
            return (first,)
        second = self.estimator.estimate_local(look.pixels[left], points[left], look.camera, RIVAL_TRIALS)
        if second is None:
            return (first,)
        return first, (second[0], np.isin(np.arange(len(points)), left[second[1]]))

    def localize(
        self, looks: Sequence[Look], single_view_poses: Sequence[SingleViewPoses] | None = None
    ) -> JointLocalization:
        """Localize one view or more, given each view's `single_view_poses` if known."""
        n_matches = sum(len(look.rows) for look in looks)
        no_inliers = tuple(np.zeros(len(look.rows), dtype=bool) for look in looks)
        if n_matches < MIN_MATCHES:
            return JointLocalization(TOO_FEW_MATCHES, None, None, no_inliers, n_matches)
        if single_view_poses is None:
            single_view_poses = [self.single_view_poses(look) for look in looks]
        rig = _Rig(self.estimator, looks, self.turn_noise_deg)
        hypotheses = rig.hypotheses(single_view_poses)
        if not hypotheses:
            return JointLocalization(NO_POSE, None, None, no_inliers, n_matches)
        unique = self._unique_support(rig, hypotheses)
        support = [pose.support for pose in hypotheses]
        chosen = most_likely(unique, support) if len(looks) > 1 else 0
        best = hypotheses[chosen]
        rival_support = max(support[:chosen] + support[chosen + 1 :], default=0.0)
        unique_support = (self.ambiguity.count_voxels(rig.inlier_rows(best)), 0)
        if len(hypotheses) > 1:
            rival = strongest_rival(unique, support, chosen)
            unique_support = int(unique[chosen, rival]), int(unique[rival, chosen])
        return JointLocalization(
            status=LOCALIZED if best.n_inliers >= self.estimator.config.min_inliers else NO_POSE,
            rig_from_world=poses_from(best.rig_from_world, -self.estimator.origin),
            cams_from_world=poses_from(best.cams_from_world, -self.estimator.origin),
            inliers=best.inliers,
            n_matches=n_matches,
            support=best.support,
            rival_support=rival_support,
            unique_support=unique_support,
            deviation=rig.deviation(best),
        )

    def _unique_support(self, rig: _Rig, hypotheses: Sequence[_Hypothesis]) -> NDArray[np.int64]:
        """Numbers (K, K) of locations that each of K poses explains and each other does not."""
        unique = np.zeros((len(hypotheses), len(hypotheses)), dtype=np.int64)
        for k, pose in enumerate(hypotheses):
            rows = rig.inlier_rows(pose)
            for n, other in enumerate(hypotheses):
                if n != k:
                    unique[k, n] = self.ambiguity.unique_support(rows, pose.rig_from_world, other.rig_from_world)
        return unique


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """A pose of the rig, in the estimator's world, with its inliers and support."""

    rig_from_world: Float
    cams_from_world: Float
    inliers: tuple[NDArray[np.bool_], ...]
    support: float

    @property
    def n_inliers(self) -> int:
        return int(sum(mask.sum() for mask in self.inliers))

    def differs_from(self, other: _Hypothesis) -> bool:
        return bool(np.greater(pose_error(self.rig_from_world, other.rig_from_world), MIN_POSE_SEPARATION).any())


class _Rig:
    """Views in the form that PoseLib takes, and the pose hypotheses that they support."""

    def __init__(self, estimator: PoseEstimator, looks: Sequence[Look], turn_noise_deg: float) -> None:
        self.estimator = estimator
        self.looks = looks
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

    def hypotheses(self, single_view_poses: Sequence[SingleViewPoses]) -> list[_Hypothesis]:
        """Distinct refined poses by decreasing support; for a single view, its single-image poses in their order."""
        poses = []
        if len(self.looks) == 1:
            for pose, mask in single_view_poses[0]:
                evaluated = self._evaluate(self._rig_pose(0, pose))
                poses.append(replace(evaluated, inliers=(mask,)))
        else:
            left = [np.ones(len(pixels), dtype=bool) for pixels in self.pixels]
            for trials in (None, *(N_SAMPLED_POSES - 1) * [RIVAL_TRIALS]):
                sampled = self._sample(left, trials)
                if sampled is None:
                    break
                poses.append(sampled)
                left = [mask & ~inlier for mask, inlier in zip(left, sampled.inliers, strict=True)]
            for k, single in enumerate(single_view_poses):
                poses += [self._refine(self._rig_pose(k, pose)) for pose, _ in single]
            poses.sort(key=lambda pose: -pose.support)
        distinct: list[_Hypothesis] = []
        for hypothesis in poses:
            if all(hypothesis.differs_from(other) for other in distinct):
                distinct.append(hypothesis)
        return distinct

    def inlier_rows(self, pose: _Hypothesis) -> NDArray[np.int64]:
        """Rows of the landmarks that agree with a pose."""
        return np.concatenate([look.rows[mask] for look, mask in zip(self.looks, pose.inliers, strict=True)])

    def _rig_pose(self, k: int, cam_from_world: Float) -> Float:
        """rig_from_world (3, 4) from the pose of view k."""
        return compose_poses(invert_poses(self.cam_from_rig[k]), cam_from_world)

    def _sample(self, masks: Sequence[NDArray[np.bool_]], max_trials: int | None) -> _Hypothesis | None:
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
        return self._refine(pose.Rt)

    def _masked(self, masks: Sequence[NDArray[np.bool_]]) -> list[list[NDArray[Any]]]:
        """Pixels and points of the masked matches of each view."""
        return [
            [values[mask] for values, mask in zip(of_views, masks, strict=True)]
            for of_views in (self.pixels, self.points)
        ]

    def _refine(self, rig_from_world: Float) -> _Hypothesis:
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

    def _evaluate(self, rig_from_world: Float, limit_px: float | None = None, cams: Float | None = None) -> _Hypothesis:
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
        return _Hypothesis(rig_from_world, cams, tuple(inliers), support)

    def deviation(self, pose: _Hypothesis) -> tuple[float, float]:
        """One standard deviation of position (m) and orientation (degrees), from the inliers and their errors.

        Off the optical axis a pixel spans a smaller angle: by the cosine squared along and the cosine across.
        """
        numbers = np.zeros(N_NUMBERS)
        total = 0.0
        for look, points, mask, cam in zip(self.looks, self.points, pose.inliers, pose.cams_from_world, strict=True):
            offsets = points[mask] - camera_centers(cam)
            cosine = np.clip(offsets @ cam[2, :3] / np.linalg.norm(offsets, axis=1), 0.05, 1)
            numbers += (look.camera.mean_focal_px / cosine) ** 2 @ bearing_numbers(offsets)
            total += float(squared_errors(look.camera, look.pixels[mask], points[mask], cam).sum())
        information = information_matrices(numbers)
        if pose.n_inliers <= 3 or np.linalg.cond(information) > 1e14:
            return np.inf, np.inf
        covariance = np.linalg.inv(information) * max(total / (2 * pose.n_inliers - 6), 0.01)
        return float(np.sqrt(np.trace(covariance[:3, :3]))), float(np.degrees(np.sqrt(np.trace(covariance[3:, 3:]))))


def squared_errors(camera: Camera, pixels: Float, points: Float, cam_from_world: Float) -> Float:
    """Squared reprojection errors (M,) of points (M, 3) at pixels (M, 2) of a pose's image; infinite behind it."""
    in_camera = transform(cam_from_world, points)
    fisheye = camera.colmap.model.endswith("FISHEYE")
    ahead = np.ones(len(in_camera), dtype=bool) if fisheye else in_camera[:, 2] > 1e-6
    projected = camera.project(np.where(ahead[:, None], in_camera, (0.0, 0.0, 1.0)))
    squared = ((projected - pixels) ** 2).sum(1)
    return np.where(ahead & np.isfinite(squared), squared, np.inf)


def _poselib_pose(pose: Float) -> poselib.CameraPose:
    result = poselib.CameraPose()
    result.R = pose[:, :3]
    result.t = pose[:, 3]
    return result
