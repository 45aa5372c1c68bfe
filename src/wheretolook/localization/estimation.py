"""Estimate poses from 2D-3D matches: RANSAC, refinement, further hypotheses, and errors of given rotations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, product
from typing import Any

import numpy as np
import poselib
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from wheretolook.geometry.camera import Camera, ColmapCamera, PinholeCamera
from wheretolook.geometry.pose_information import N_NUMBERS, bearing_numbers, information_matrices
from wheretolook.geometry.poses import Float, camera_centers, compose_poses, invert_poses, pose_error, transform
from wheretolook.geometry.similarity import local_origin, poses_from
from wheretolook.localization.confidence import ERRORS_ON_PHOTOGRAPHS, log_ratio
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.rig import Look

REFINEMENT = {"loss_type": "CAUCHY", "loss_scale": 1.0}
"""Keypoints are accurate to a fraction of a pixel. PoseLib's default scale, half of RANSAC's limit, weighs outliers just
within the limit as accurate ones, which makes poses worse."""


class PoseEstimator:
    """Estimates the pose of an image from matches with points (N, 3) m by P3P in PoseLib's LO-RANSAC and refinement.

    It computes in metres from `origin`, so that coordinates of a national grid lose no precision. On a map of photographs
    the deviations of its poses are those of the inliers times `ERRORS_ON_PHOTOGRAPHS`.
    """

    def __init__(self, points: Float, config: LocalizerConfig = LocalizerConfig(), photographs: bool = False) -> None:
        self.config = config
        self.error_factor = ERRORS_ON_PHOTOGRAPHS if photographs else 1.0
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


def poselib_camera(camera: ColmapCamera, pixels: Float) -> tuple[dict[str, Any], Float]:
    """Convert a camera and pixels (M, 2) of its image to what PoseLib takes.

    For a model that PoseLib does not support, pixels become those of a pinhole camera with the same focal length. Those
    more than 84 degrees off the axis are moved far outside the image, where they are never inliers.
    """
    supported = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")
    if camera.model in supported:
        return camera.record(), pixels
    pinhole = PinholeCamera(camera.width, camera.height, camera.mean_focal_px)
    rays = camera.unproject(pixels)
    ahead = rays[:, 2:] > 0.1
    return pinhole.colmap.record(), np.where(ahead, pinhole.project(np.where(ahead, rays, (0, 0, 1))), 1e6)


def match_under(look: Look, points: Float, cam_from_world: Float, radius_px: float) -> Look:
    """Return a view with the matches of all its keypoints that agree with a pose up to a radius in pixels.

    A keypoint matches the first of its candidates that the pose projects within the radius; a landmark keeps its first
    keypoint. `points` (M, 3) m are those of the candidates.
    """
    candidates = look.candidates
    assert candidates is not None
    squared = squared_errors(look.camera, candidates.pixels, points, cam_from_world)
    order = np.flatnonzero(squared < radius_px**2)
    for values in (candidates.keypoints, candidates.landmarks):  # each keypoint once, then each landmark once
        order = order[np.sort(np.unique(values[order], return_index=True)[1])]
    return replace(look, pixels=candidates.pixels[order], rows=candidates.landmarks[order])


def refine_jointly(
    looks: Sequence[Look],
    points: Sequence[Float],
    inliers: Sequence[NDArray[np.bool_]],
    rig_from_world: Float,
    cams_from_world: Float,
    noise_rad: float,
    with_focal: bool = False,
) -> tuple[list[Look], Float, Float, Float]:
    """Refine the rig's pose (3, 4), its views' poses (N, 3, 4) and, `with_focal`, assumed focal lengths on the inliers.

    Gauss-Newton on the rig's pose, the log of a factor of all assumed focal lengths, and one small rotation of each view
    about its centre, with Cauchy weights (one pixel) on the keypoints and a quadratic prior on the rotations, whose
    standard deviation about each axis is `noise_rad`; 0 for exact ones. Rotations start as in `cams_from_world`; points
    (M, 3) m and masks (M,) are given for each view. Returns the views with the refined focal lengths, both poses, and
    the normal matrix (7 + 3 N, 7 + 3 N), for keypoints with a noise of one pixel.
    """
    looks = list(looks)
    cam_from_rig = np.stack([look.cam_from_rig for look in looks])
    rig = rig_from_world
    turns = cams_from_world[:, :, :3] @ rig[:, :3].T @ cam_from_rig[:, :, :3].swapaxes(1, 2)
    for _ in range(20):
        normal, right = _normal_equations(looks, points, inliers, rig, turns, noise_rad, with_focal)
        step = np.linalg.lstsq(normal, right, rcond=None)[0]
        step[6] = np.clip(step[6], -0.2, 0.2)
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        rig = compose_poses(np.column_stack([turn, step[3:6]]), rig)
        turns = Rotation.from_rotvec(step[7:].reshape(-1, 3)).as_matrix() @ turns
        if with_focal:
            looks = [look.scaled(float(np.exp(step[6]))) for look in looks]
        if np.abs(step).max() < (1e-4 if with_focal else 1e-9):  # metres and radians
            break
    return looks, rig, turns @ compose_poses(cam_from_rig, rig), normal


def _normal_equations(
    looks: Sequence[Look],
    points: Sequence[Float],
    inliers: Sequence[NDArray[np.bool_]],
    rig: Float,
    turns: Float,
    noise_rad: float,
    with_focal: bool,
) -> tuple[Float, Float]:
    """Normal matrix and right side of a Gauss-Newton step (7 + 3 N,).

    The step has left perturbations of rig_from_world (rotation, translation), of the log of the focal length, and of the
    views' rotations. Those that are not refined have the identity and 0.
    """
    normal = np.eye(7 + 3 * len(looks))
    normal[:6, :6] = 0
    normal[6, 6] = not with_focal
    right = np.zeros(len(normal))
    for k, look in enumerate(looks):
        columns_of_turn = slice(7 + 3 * k, 10 + 3 * k)
        if noise_rad:
            normal[columns_of_turn, columns_of_turn] = np.eye(3) / noise_rad**2
            right[columns_of_turn] -= Rotation.from_matrix(turns[k]).as_rotvec() / noise_rad**2
        if not inliers[k].any():
            continue
        in_rig = transform(rig, points[k][inliers[k]])
        in_camera = transform(look.cam_from_rig, in_rig) @ turns[k].T
        projected = look.camera.project(in_camera)
        error = projected - look.pixels[inliers[k]]
        by_point = _projection_jacobian(look, in_camera)
        by_rig = by_point @ turns[k] @ look.cam_from_rig[:, :3]
        # the derivative of a rotated point is the cross product with it
        derivatives = [np.cross(in_rig[:, None], by_rig), by_rig]
        columns = np.arange(6)
        if with_focal and look.focal is not None:
            derivatives.append((projected - look.camera.principal_point)[:, :, None])
            columns = np.append(columns, 6)
        if noise_rad:
            derivatives.append(np.cross(in_camera[:, None], by_point))
            columns = np.r_[columns, columns_of_turn]
        jacobian = np.concatenate(derivatives, axis=2)
        weight = 1 / (1 + (error**2).sum(1))
        usable = np.isfinite(jacobian).all(axis=(1, 2)) & np.isfinite(error).all(axis=1)
        jacobian, error, weight = jacobian[usable], error[usable], weight[usable]
        normal[np.ix_(columns, columns)] += np.einsum("m,mij,mik->jk", weight, jacobian, jacobian)
        right[columns] -= np.einsum("m,mij,mi->j", weight, jacobian, error)
    return normal, right


def _projection_jacobian(look: Look, points_cam: Float) -> Float:
    """Derivative (M, 2, 3) of pixels by points (M, 3) in the camera's frame: central differences, for any camera."""
    size = 1e-6 * np.maximum(1.0, np.linalg.norm(points_cam, axis=1))[:, None]
    columns = []
    for axis in np.eye(3):
        ahead = look.camera.project(points_cam + size * axis)
        behind = look.camera.project(points_cam - size * axis)
        columns.append((ahead - behind) / (2 * size))
    return np.stack(columns, axis=2)


RIVAL_TRIALS = 1000
"""Maximum RANSAC trials on the matches that agree with no earlier pose: enough for a pose with a sixth of these."""

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
        of_focal: (6, 6) covariance that an assumed focal length adds.
    """

    rig: RigMatches
    rig_from_world: Float
    cams_from_world: Float
    inliers: tuple[NDArray[np.bool_], ...]
    support: float
    of_focal: Float | float = 0.0

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
        """Covariance (6, 6) of position (m) and orientation (rad), from the inliers, their errors and `of_focal`.

        Off the optical axis a pixel spans a smaller angle: by the cosine squared along and the cosine across. Infinite
        where the inliers do not determine the pose.
        """
        numbers = np.zeros(N_NUMBERS)
        for look, mask, cam in zip(self.rig.looks, self.inliers, self.cams_from_world, strict=True):
            offsets = self.rig.estimator.points[look.rows[mask]] - camera_centers(cam)
            cosine = np.clip(offsets @ cam[2, :3] / np.linalg.norm(offsets, axis=1), 0.05, 1)
            numbers += (look.camera.mean_focal_px / cosine) ** 2 @ bearing_numbers(offsets)
        information = information_matrices(numbers)
        if self.n_inliers <= 3 or np.linalg.cond(information) > 1e14:
            return np.full((6, 6), np.inf)
        scale = self.variance * self.rig.estimator.error_factor**2
        return np.linalg.inv(information) * scale + self.of_focal

    @property
    def variance(self) -> float:
        """Variance of a coordinate of keypoints in square pixels, from the errors of four inliers or more."""
        total = 0.0
        for look, mask, cam in zip(self.rig.looks, self.inliers, self.cams_from_world, strict=True):
            points = self.rig.estimator.points[look.rows[mask]]
            total += float(squared_errors(look.camera, look.pixels[mask], points, cam).sum())
        return max(total / (2 * self.n_inliers - 6), 0.01)

    def with_focal(self) -> Hypothesis:
        """Refine assumed focal lengths with the pose, and add what stays uncertain of them to the covariance.

        The pose is that of the focal length by `FocalPrior.posterior`, so an assumed one that the inliers agree with is
        kept.
        """
        prior = next((look.focal for look in self.rig.looks if look.focal is not None), None)
        if prior is None:
            return self
        rig = self.rig
        best = self
        for _ in range(3):
            if best.n_inliers < MIN_MATCHES:
                return replace(best, of_focal=np.inf)
            looks, pose, cams, normal = refine_jointly(
                best.rig.looks,
                best.rig.points,
                best.inliers,
                best.rig_from_world,
                best.cams_from_world,
                rig.noise_rad,
                True,
            )
            if not (np.isfinite(pose).all() and all(prior.allows(look.camera) for look in looks if look.focal)):
                return replace(best, of_focal=np.inf)
            refined = RigMatches(rig.estimator, looks, rig.turn_noise_deg).evaluate(pose, cams=cams)
            same = np.array_equal(np.concatenate(best.inliers), np.concatenate(refined.inliers))
            best = refined
            if same:
                break
        normal[6, 6] += 0.01  # a wall that the camera faces does not determine it
        covariance = np.linalg.pinv(normal, hermitian=True)
        by_focal = covariance[:6, 6] / covariance[6, 6]
        look = next(look for look in best.rig.looks if look.focal is not None)
        log_focal = float(np.log(look.camera.mean_focal_px))
        mean, variance = prior.posterior(log_focal, best.variance * covariance[6, 6])
        scaled = [look.scaled(float(np.exp(mean - log_focal))) for look in best.rig.looks]
        kept = RigMatches(rig.estimator, scaled, rig.turn_noise_deg).refine(best.rig_from_world)
        world_from_rig = kept.rig_from_world[:, :3].T
        shift = np.concatenate([-world_from_rig @ by_focal[3:], world_from_rig @ by_focal[:3]])
        return replace(kept, of_focal=variance * np.outer(shift, shift))

    def differs_from(self, other: Hypothesis) -> bool:
        """Whether this is another pose: more than 0.5 m or 10 degrees away."""
        return bool(np.greater(pose_error(self.rig_from_world, other.rig_from_world), (0.5, 10.0)).any())


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
        # RANSAC estimates three poses from the matches of all views, each from those that agree with none before it; those
        # of a single view are sampled already
        for trials in (None, RIVAL_TRIALS, RIVAL_TRIALS) if len(self.looks) > 1 else ():
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
            evaluated = self.evaluate(self.rig_pose(0, pose))
            hypotheses.append(replace(evaluated, inliers=(mask,)))
        return hypotheses

    def guided(self, hypothesis: Hypothesis) -> Hypothesis:
        """Match all keypoints again under a hypothesis and refine it, with a radius that decreases."""
        for radius_px in (12.0, 6.0):  # the first corrects the error of a pose from few matches
            cams = hypothesis.cams_from_world
            views = zip(hypothesis.rig.looks, self._candidates, cams, strict=True)
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
        """Refine a pose on the inliers of all views until they stay the same.

        The loss of several views has a scale of half a pixel. Near the right pose, 96.2 % are then within 5 cm and 0.4
        degrees for two views of validation scenes, and 93.4 % with a scale of one pixel; for a single view both scales are
        equally good.
        """
        best = self.evaluate(rig_from_world, self.loose_px)
        loss = {"loss_type": "CAUCHY", "loss_scale": 0.5}
        for _ in range(3):  # mostly the second gives the same inliers
            if best.n_inliers < MIN_MATCHES:
                break
            if self.noise_rad:
                _, rig, cams, _ = refine_jointly(
                    self.looks, self.points, best.inliers, best.rig_from_world, best.cams_from_world, self.noise_rad
                )
                best = self.evaluate(rig, cams=cams)
                continue
            start = _poselib_pose(best.rig_from_world)
            pose, _ = poselib.refine_generalized_absolute_pose(
                *self._masked(best.inliers), start, self.poselib_rig, self.cameras, loss
            )
            if not np.isfinite(pose.Rt).all():
                break
            refined = self.evaluate(pose.Rt)
            # accurate keypoints weigh more than in the support, which may fall a little as the pose improves
            if refined.support < 0.9 * best.support:
                break
            same = np.array_equal(np.concatenate(best.inliers), np.concatenate(refined.inliers))
            best = refined
            if same:
                break
        return best

    def evaluate(self, rig_from_world: Float, limit_px: float | None = None, cams: Float | None = None) -> Hypothesis:
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


class PoseAmbiguity:
    """Compares pose hypotheses in a map with landmarks (N, 3) m, by the inliers that only one of them explains."""

    def __init__(self, points: Float) -> None:
        self.points = points
        self._tree = cKDTree(points[np.isfinite(points).all(axis=1)])

    def unique_supports(self, rows: Sequence[NDArray[np.int64]], poses: Float | Sequence[Float]) -> NDArray[np.int64]:
        """Count voxels (K, K) with landmarks, rows (M_k,), that agree with each pose and that each other cannot explain.

        K poses (3, 4) are from the world into the same frame of camera or rig. A landmark within 0.4 m of a moved one is
        its counterpart: different points are triangulated on two copies of an object. On validation scenes 0.25 to 0.6 m
        work equally.
        """
        unique = []
        for of_pose, pose in zip(rows, poses, strict=True):
            moved = transform(compose_poses(invert_poses(poses), pose), self.points[of_pose])
            near = self.are_near(moved.reshape(-1, 3), 0.4).reshape(moved.shape[:2])
            unique.append([self.count_voxels(of_pose[~explained]) for explained in near])
        return np.array(unique)

    def are_near(self, points: Float, radius_m: float) -> NDArray[np.bool_]:
        """Return which points (M, 3) m have a landmark within a radius."""
        return np.isfinite(self._tree.query(points, distance_upper_bound=radius_m)[0])

    def count_voxels(self, rows: NDArray[np.int64]) -> int:
        """Count voxels, cubes of 25 cm, with landmarks, rows (M,): those on one object are matched or mismatched jointly."""
        cells = np.floor(self.points[rows] / 0.25).astype(np.int64)
        # one number for each, for 260 km in each direction: unique rows take ten times as long
        return len(np.unique(cells @ np.array([1, 2**21, 2**42])))


def preferences(unique: NDArray[np.int64], support: ArrayLike) -> Float:
    """Log odds (..., K, K) for each pose against each other, from unique support and, less so, support (..., K)."""
    smoothed = np.asarray(support, dtype=np.float64) + 1
    ratio = smoothed[..., :, None] / smoothed[..., None, :]
    return log_ratio(unique, unique.swapaxes(-1, -2)) + 0.2 * np.log(ratio)


def strongest_rival(unique: NDArray[np.int64], support: Sequence[float], k: int) -> int:
    """Index of the pose that is the strongest evidence against pose `k`; `unique` (K, K) as by `unique_supports`."""
    preference = preferences(unique, support)[k]
    preference[k] = np.inf
    return int(np.argmin(preference))


def most_likely(unique: NDArray[np.int64], support: Sequence[float]) -> int:
    """Index of the pose with the strongest evidence against its strongest rival; poses by decreasing support.

    Pairwise preferences may be cyclic, so poses are not eliminated one after the other.
    """
    candidates = np.flatnonzero(np.asarray(support) >= 0.1 * support[0])
    preference = preferences(unique, support)[np.ix_(candidates, candidates)]
    np.fill_diagonal(preference, np.inf)
    return int(candidates[np.argmax(preference.min(axis=1))])


MAX_DEVIATIONS = 4.0
"""Errors of so many standard deviations contradict the assumed noise: at most 0.1 % of those of three Gaussian angles do."""


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
        limit_m = MAX_DEVIATIONS * deviation_m + 0.02 + moved_m  # a camera that turns about its base moves 2 cm
        if error_m < limit_m and deviation_m < 0.25:
            # with larger ones, poses from a small part of the image have errors beyond their covariance
            variance = np.degrees(1) ** 2 * np.linalg.eigvalsh(covariance[3:, 3:])[-1]
            if variance < 1.0:
                errors.append((float(error_deg), float(variance)))
    return min(errors, default=None)
