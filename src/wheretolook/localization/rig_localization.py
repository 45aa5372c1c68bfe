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
from wheretolook.geometry.poses import Float, camera_centers, rotation_angle_deg
from wheretolook.localization.estimation import REFINEMENT, PoseEstimator, poselib_camera
from wheretolook.localization.joint_refinement import refine_rotations
from wheretolook.localization.pose_ambiguity import PoseAmbiguity, most_likely, strongest_rival
from wheretolook.localization.rig import Look, check_looks
from wheretolook.utils.errors import ConfigError, PoseError

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
        if not 0 <= turn_noise_deg < 90:
            raise ConfigError("the noise of rotations is 0 to 90 degrees", value=turn_noise_deg)
        self.estimator = estimator
        self.turn_noise_deg = turn_noise_deg

    def localize_together(self, looks: Sequence[Look]) -> JointLocalization:
        """Localize two views or more. Raises PoseError for fewer, and as `localize`."""
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
        """Localize one view or more, given each view's `single_view_poses` if known.

        Raises PoseError if there is no view, a pose in the rig is no rigid transform, or pixels and rows do not match.
        """
        check_looks(looks)
        n_matches = sum(len(look.rows) for look in looks)
        no_inliers = tuple(np.zeros(len(look.rows), dtype=bool) for look in looks)
        if n_matches < MIN_MATCHES:
            return JointLocalization(TOO_FEW_MATCHES, None, None, no_inliers, n_matches)
        if single_view_poses is None:
            single_view_poses = [self.single_view_poses(look) for look in looks]
        rig = _Rig(self.estimator, looks, self.turn_noise_deg, single_view_poses)
        hypotheses = rig.hypotheses()
        if not hypotheses:
            return JointLocalization(NO_POSE, None, None, no_inliers, n_matches)
        unique = self._unique_support(rig, hypotheses)
        support = [pose.support for pose in hypotheses]
        chosen = most_likely(unique, support) if len(looks) > 1 else 0
        best = hypotheses[chosen]
        rivals = [k for k in range(len(hypotheses)) if k != chosen]
        unique_support = (self.ambiguity.count_voxels(rig.inlier_rows(best)), 0)
        if rivals:
            rival = strongest_rival(unique, support, chosen)
            unique_support = int(unique[chosen, rival]), int(unique[rival, chosen])
        n_inliers = sum(mask.sum() for mask in best.inliers)
        return JointLocalization(
            status=LOCALIZED if n_inliers >= self.estimator.config.min_inliers else NO_POSE,
            rig_from_world=poses_from(best.rig_from_world, -self.estimator.origin),
            cams_from_world=poses_from(best.cams_from_world, -self.estimator.origin),
            inliers=best.inliers,
            n_matches=n_matches,
            support=best.support,
            rival_support=max((support[k] for k in rivals), default=0.0),
            unique_support=unique_support,
            deviation=rig.deviation(best),
        )

    @cached_property
    def ambiguity(self) -> PoseAmbiguity:
        """Ambiguity of the map."""
        return PoseAmbiguity(self.estimator.points)

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
        distance_m = np.linalg.norm(camera_centers(self.rig_from_world) - camera_centers(other.rig_from_world))
        angle_deg = rotation_angle_deg(self.rig_from_world[:, :3], other.rig_from_world[:, :3])
        return bool(distance_m > MIN_POSE_SEPARATION[0] or angle_deg > MIN_POSE_SEPARATION[1])


class _Rig:
    """Views in the form that PoseLib takes, and the pose hypotheses that they support."""

    def __init__(
        self,
        estimator: PoseEstimator,
        looks: Sequence[Look],
        turn_noise_deg: float,
        single_view_poses: Sequence[SingleViewPoses],
    ) -> None:
        self.estimator = estimator
        self.looks = looks
        self.single_view_poses = single_view_poses
        inputs = [poselib_camera(look.camera.colmap, np.asarray(look.pixels, dtype=np.float64)) for look in looks]
        self.cameras = [camera for camera, _ in inputs]
        self.pixels = [pixels for _, pixels in inputs]
        self.points = [estimator.points[look.rows] for look in looks]
        self.cam_from_rig = np.stack([np.asarray(look.cam_from_rig, dtype=np.float64) for look in looks])
        self.noise_rad = np.radians(turn_noise_deg) if len(looks) > 1 else 0.0
        focal_px = max(look.camera.mean_focal_px for look in looks)
        # error limit until rotations are refined
        self.loose_px = float(np.hypot(estimator.config.max_error_px, 4 * self.noise_rad * focal_px))

    def hypotheses(self) -> list[_Hypothesis]:
        """Distinct refined poses by decreasing support; for a single view, its single-image pose is the first."""
        if len(self.looks) == 1:
            return _distinct(self._single_image_hypotheses())
        left = [np.ones(len(pixels), dtype=bool) for pixels in self.pixels]
        poses = []
        for k in range(N_SAMPLED_POSES):
            sampled = self._sample(left, RIVAL_TRIALS if k else None)
            if sampled is None:
                break
            poses.append(sampled)
            left = [mask & ~inlier for mask, inlier in zip(left, sampled.inliers, strict=True)]
        for cam_from_rig, found in zip(self.cam_from_rig, self.single_view_poses, strict=True):
            poses += [self._refine(_rig_pose(cam_from_rig, pose)) for pose, _ in found]
        return _distinct(sorted(poses, key=lambda pose: -pose.support))  # stable: of equals the first

    def inlier_rows(self, pose: _Hypothesis) -> NDArray[np.int64]:
        """Rows of the landmarks that agree with a pose."""
        return np.concatenate([look.rows[mask] for look, mask in zip(self.looks, pose.inliers, strict=True)])

    def _single_image_hypotheses(self) -> list[_Hypothesis]:
        return [
            replace(self._evaluate(_rig_pose(self.cam_from_rig[0], pose)), cams_from_world=pose[None], inliers=(mask,))
            for pose, mask in self.single_view_poses[0]
        ]

    def _sample(self, masks: Sequence[NDArray[np.bool_]], trials: int | None) -> _Hypothesis | None:
        """Estimate a pose by RANSAC over masked matches of all views, and refine it."""
        if sum(mask.sum() for mask in masks) < MIN_MATCHES:
            return None
        options = {**self.estimator.ransac, "max_reproj_error": self.loose_px}
        options["max_iterations"] = trials or options["max_iterations"]
        pixels, points = self._masked(masks)
        pose, info = poselib.estimate_generalized_absolute_pose(
            pixels, points, [_poselib_pose(pose) for pose in self.cam_from_rig], self.cameras, options, REFINEMENT
        )
        if info["num_inliers"] < MIN_MATCHES or not np.isfinite(pose.Rt).all():
            return None
        return self._refine(pose.Rt)

    def _masked(self, masks: Sequence[NDArray[np.bool_]]) -> tuple[list[NDArray[Any]], list[NDArray[Any]]]:
        pixels: list[NDArray[Any]] = [pixels[mask] for pixels, mask in zip(self.pixels, masks, strict=True)]
        points: list[NDArray[Any]] = [points[mask] for points, mask in zip(self.points, masks, strict=True)]
        return pixels, points

    def _refine(self, rig_from_world: Float) -> _Hypothesis:
        """Refine a pose on the inliers of all views until they stay the same."""
        if self.noise_rad:
            return self._refine_with_rotations(rig_from_world)
        best = self._evaluate(rig_from_world)
        cam_from_rig = [_poselib_pose(pose) for pose in self.cam_from_rig]
        for _ in range(REFINEMENT_ROUNDS):
            if best.n_inliers < MIN_MATCHES:
                break
            start = _poselib_pose(best.rig_from_world)
            pose, _ = poselib.refine_generalized_absolute_pose(
                *self._masked(best.inliers), start, cam_from_rig, self.cameras, JOINT_REFINEMENT
            )
            if not np.isfinite(pose.Rt).all():
                break
            refined = self._evaluate(pose.Rt)
            if refined.support < MIN_REFINED_SUPPORT_RATIO * best.support:
                break
            same = all(np.array_equal(*masks) for masks in zip(best.inliers, refined.inliers, strict=True))
            best = refined
            if same:
                break
        return best

    def _refine_with_rotations(self, rig_from_world: Float) -> _Hypothesis:
        best = self._evaluate(rig_from_world, self.loose_px)
        cams = best.cams_from_world
        for _ in range(REFINEMENT_ROUNDS):
            if best.n_inliers < MIN_MATCHES:
                break
            rig_from_world, cams = refine_rotations(
                self.looks, self.points, best.inliers, best.rig_from_world, cams, self.noise_rad
            )
            best = self._evaluate(rig_from_world, cams=cams)
        return best

    def _evaluate(self, rig_from_world: Float, limit_px: float | None = None, cams: Float | None = None) -> _Hypothesis:
        """Inliers and support of a pose, given the poses of the views if rotations are refined."""
        limit_px = self.estimator.config.max_error_px if limit_px is None else limit_px
        if cams is None:
            rotations = self.cam_from_rig[:, :, :3] @ rig_from_world[:, :3]
            translations = self.cam_from_rig[:, :, :3] @ rig_from_world[:, 3] + self.cam_from_rig[:, :, 3]
            cams = np.concatenate([rotations, translations[..., None]], axis=2)
        inliers = []
        support = 0.0
        for look, points, pose in zip(self.looks, self.points, cams, strict=True):
            squared = squared_errors(look.camera, look.pixels, points, pose) / limit_px**2
            inliers.append(squared < 1)
            support += float((1 - squared[squared < 1]).sum())
        return _Hypothesis(rig_from_world, np.asarray(cams), tuple(inliers), support)

    def deviation(self, pose: _Hypothesis) -> tuple[float, float]:
        """One standard deviation of position (m) and orientation (degrees), from the inliers and their errors."""
        information = np.zeros((6, 6))
        total = 0.0
        n = 0
        for look, points, mask, cam in zip(self.looks, self.points, pose.inliers, pose.cams_from_world, strict=True):
            if not mask.any():
                continue
            jacobian = _bearing_jacobian(points[mask] - camera_centers(cam), cam[2, :3], look.camera.mean_focal_px)
            information += np.einsum("nij,nik->jk", jacobian, jacobian)
            squared = squared_errors(look.camera, look.pixels[mask], points[mask], cam)
            total += float(squared.sum())
            n += int(mask.sum())
        if n <= 3 or np.linalg.cond(information) > 1e14:
            return np.inf, np.inf
        covariance = np.linalg.inv(information) * max(total / (2 * n - 6), 0.01)
        return float(np.sqrt(np.trace(covariance[:3, :3]))), float(np.degrees(np.sqrt(np.trace(covariance[3:, 3:]))))


def squared_errors(camera: Camera, pixels: Float, points: Float, cam_from_world: Float) -> Float:
    """Squared reprojection errors (M,) of points (M, 3) at pixels (M, 2) of a pose's image; infinite behind it."""
    in_camera = points @ cam_from_world[:, :3].T + cam_from_world[:, 3]
    fisheye = camera.colmap.model.endswith("FISHEYE")
    ahead = np.ones(len(in_camera), dtype=bool) if fisheye else in_camera[:, 2] > 1e-6
    projected = camera.project(np.where(ahead[:, None], in_camera, (0.0, 0.0, 1.0)))
    squared = ((projected - pixels) ** 2).sum(1)
    return np.where(ahead & np.isfinite(squared), squared, np.inf)


def _bearing_jacobian(offsets: Float, axis: Float, focal_px: float) -> Float:
    """Derivative (M, 3, 6) of bearings, in pixels, by camera position and rotation.

    Offsets (M, 3) m are from the camera to points. Off the optical axis (3,) a pixel spans a smaller angle: by the
    cosine squared along and the cosine across.
    """
    distance = np.linalg.norm(offsets, axis=1)
    bearing = offsets / np.maximum(distance, 1e-9)[:, None]
    cosine = np.clip((offsets @ axis) / np.maximum(distance, 1e-9), 0.05, 1)
    weight = focal_px / cosine
    across = np.eye(3) - bearing[:, :, None] * bearing[:, None, :]
    skew = np.zeros((len(bearing), 3, 3))
    skew[:, [0, 0, 1], [1, 2, 2]] = np.stack([-bearing[:, 2], bearing[:, 1], -bearing[:, 0]], 1)
    skew -= skew.transpose(0, 2, 1)
    return np.concatenate([across / distance[:, None, None], skew], axis=2) * weight[:, None, None]


def _distinct(poses: Sequence[_Hypothesis]) -> list[_Hypothesis]:
    """Drop poses close to an earlier one."""
    distinct: list[_Hypothesis] = []
    for pose in poses:
        if all(pose.differs_from(other) for other in distinct):
            distinct.append(pose)
    return distinct


def _rig_pose(cam_from_rig: Float, cam_from_world: Float) -> Float:
    """rig_from_world (3, 4) from a view's pose."""
    rotation = cam_from_rig[:, :3].T
    return np.concatenate(
        [rotation @ cam_from_world[:, :3], (rotation @ (cam_from_world[:, 3] - cam_from_rig[:, 3]))[:, None]], axis=1
    )


def _poselib_pose(pose: Float) -> poselib.CameraPose:
    result = poselib.CameraPose()
    result.R = pose[:, :3]
    result.t = pose[:, 3]
    return result
