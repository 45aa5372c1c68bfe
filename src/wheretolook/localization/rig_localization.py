"""Several looks localized together: one pose for a rig of views whose poses to one another are known.

A camera that turns knows how far it turned. So N looks from a place are one camera with N parts (a generalized camera,
Pless 2003), and all their matches must agree on one pose: where a map resembles itself, a single look may find a wrong
pose with a hundred inliers, on which the others do not agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import poselib
from numpy.typing import NDArray

from wheretolook.dataset.viewpoint_table import LOCALIZED, NO_POSE, TOO_FEW_MATCHES
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.local_origin import poses_from
from wheretolook.geometry.poses import Float, camera_centers, rotation_angle_deg
from wheretolook.localization.estimation import REFINEMENT, PoseEstimator, known_to_poselib
from wheretolook.localization.joint_refinement import refine_with_turns
from wheretolook.localization.pose_ambiguity import Likeness, most_likely, strongest_rival
from wheretolook.localization.rig import Look, check_looks
from wheretolook.utils.errors import ConfigError, PoseError

ELSEWHERE = 0.5, 10.0
"""Metres and degrees by which a pose differs at least from the best to count as one elsewhere."""

ROUNDS = 3
"""Times that a pose is refined on its inliers, which are then found anew; mostly the second finds the same."""

TRIALS_ELSEWHERE = 1000
"""Trials of RANSAC at most on what does not agree with poses found before: with them it finds a pose that a sixth of
these agree on."""

POSES_OF_ALL = 3
"""Poses that are sought in the matches of all looks, each among those that agree with none before it."""

JOINT_REFINEMENT = {"loss_type": "CAUCHY", "loss_scale": 0.5}
"""Of several looks together, in pixels. Of poses near the right one, 96.2 % are then within 5 cm and 0.4 degrees by two
looks of validation scenes, and 93.4 % with a scale of one pixel; a single look's are as good with either."""

Alone = tuple[tuple[Float, NDArray[np.bool_]], ...]
"""Poses (3, 4) that a look finds alone, in the estimator's world, and which of its matches agree with each."""

LOSES = 0.9
"""Share of its support that a pose keeps at least when it is refined: keypoints that are accurate count for more there
than in the support, so it may fall a little as the pose gets better."""

LEAST = 4
"""Matches, of all looks together, without which no pose is sought: one more than determine it."""


@dataclass(frozen=True, eq=False)
class JointLocalization:
    """The pose that the matches of several looks agree on best, and how well they agree on it.

    Attributes:
        status: "localized", "too_few_matches" or "no_pose", as of a single image.
        rig_from_world: (3, 4); None if there is none. With too few inliers it is kept, but the status is "no_pose".
        cams_from_world: (N, 3, 4) the poses of the looks; beyond the rig's they hold the turns as they were found, if
            these were not known exactly.
        inliers: N masks (M_k,) of each look's matches, which agree with the pose.
        n_matches: matches of all looks.
        support: of the pose, a sum over inliers that falls from 1 to 0 as the error rises to its limit.
        elsewhere: the greatest support of a pose that lies `ELSEWHERE`; 0 if there is none.
        own: places with inliers that the strongest rival elsewhere cannot explain by likeness, and places with inliers
            of that rival that this pose cannot explain (`likeness.Likeness`); all places and 0 if there is no rival.
        deviation: one standard deviation of the position (m) and of the orientation (degrees) that the inliers leave;
            infinite where they do not determine the pose.
    """

    status: str
    rig_from_world: Float | None
    cams_from_world: Float | None
    inliers: tuple[NDArray[np.bool_], ...]
    n_matches: int
    support: float = 0.0
    elsewhere: float = 0.0
    own: tuple[int, int] = (0, 0)
    deviation: tuple[float, float] = (np.inf, np.inf)

    @property
    def n_inliers(self) -> int:
        """Inliers of all looks."""
        return int(sum(mask.sum() for mask in self.inliers))


class JointLocalizer:
    """Localizes looks together against points (N, 3) m; a single one exactly as `PoseEstimator` does.

    Hypotheses come from PoseLib's LO-RANSAC (generalized P3P) over all matches and over what agrees with none before,
    and from each look alone. Each is refined on what all looks have that agrees with it. Taken is the one with most
    evidence of its own (`likeness`): where the map resembles itself, a wrong pose may have more inliers, but mostly
    such as the likeness explains. Errors are measured in pixels of the looks' own images: by angles, as of one
    spherical camera, keypoints near the border of an image, where a pixel spans a smaller angle, would count for less
    than they tell, and RANSAC would be twice as lenient there.

    `turn_noise_deg` is one standard deviation of the angle, about each axis, to which the looks' turns are known.
    """

    def __init__(self, estimator: PoseEstimator, turn_noise_deg: float = 0.0) -> None:
        if not 0 <= turn_noise_deg < 90:
            fix = "Give one standard deviation in degrees, 0 if turns are known exactly."
            raise ConfigError("the noise of turns is an angle of 0 to 90 degrees", value=turn_noise_deg, fix=fix)
        self.estimator = estimator
        self.turn_noise_deg = turn_noise_deg

    def localize_together(self, looks: Sequence[Look]) -> JointLocalization:
        """The joint pose of two looks or more. Raises a PoseError for fewer, and as `localize`."""
        if len(looks) < 2:
            fix = "Localize it as a single image."
            raise PoseError("a single look cannot be localized together with others", value=len(looks), fix=fix)
        return self.localize(looks)

    def alone(self, look: Look) -> Alone:
        """What a look finds alone, which `localize` may be told where many sets share their looks.

        Its pose as of a single image, and the one that most of what does not agree with that agrees on.
        """
        if len(look.rows) < self.estimator.config.min_matches:
            return ()
        points = self.estimator.points[look.rows]
        first = self.estimator.estimate_here(look.pixels, points, look.camera)
        if first is None:
            return ()
        left = np.flatnonzero(~first[1])
        if len(left) < LEAST:
            return (first,)
        second = self.estimator.estimate_here(look.pixels[left], points[left], look.camera, TRIALS_ELSEWHERE)
        if second is None:
            return (first,)
        return first, (second[0], np.isin(np.arange(len(points)), left[second[1]]))

    def localize(self, looks: Sequence[Look], alone: Sequence[Alone] | None = None) -> JointLocalization:
        """The joint pose of one look or more. What each finds alone may be known already.

        Raises a PoseError if there is none, a look's pose in the rig is no rigid transform, or its pixels and rows do
        not fit together.
        """
        check_looks(looks)
        config = self.estimator.config
        n_matches = sum(len(look.rows) for look in looks)
        none = tuple(np.zeros(len(look.rows), dtype=bool) for look in looks)
        if n_matches < LEAST:
            return JointLocalization(TOO_FEW_MATCHES, None, None, none, n_matches)
        known = [self.alone(look) for look in looks] if alone is None else list(alone)
        rig = _Rig(self.estimator, looks, self.turn_noise_deg, known)
        found = rig.hypotheses()
        if not found:
            return JointLocalization(NO_POSE, None, None, none, n_matches)
        own = self._own(rig, found)
        support = [pose.support for pose in found]
        number = most_likely(own, support) if len(looks) > 1 else 0
        best = found[number]
        rivals = [k for k in range(len(found)) if k != number]
        own_of = (self.likeness.places(rig.inlier_rows(best)), 0)
        if rivals:
            worst = strongest_rival(own, support, number)
            own_of = int(own[number, worst]), int(own[worst, number])
        status = LOCALIZED if sum(mask.sum() for mask in best.inliers) >= config.min_inliers else NO_POSE
        origin = -self.estimator.origin
        poses = poses_from(best.cams_from_world, origin)
        return JointLocalization(
            status, poses_from(best.rig_from_world, origin), poses, best.inliers, n_matches, best.support,
            max((support[k] for k in rivals), default=0.0), own_of, rig.deviation(best),
        )  # fmt: skip

    @cached_property
    def likeness(self) -> Likeness:
        """Of the map, made when it is first asked for."""
        return Likeness(self.estimator.points)

    def _own(self, rig: _Rig, found: Sequence[_Hypothesis]) -> NDArray[np.int64]:
        """Places (K, K) that each of K poses explains and each other does not."""
        own = np.zeros((len(found), len(found)), dtype=np.int64)
        for k, one in enumerate(found):
            rows = rig.inlier_rows(one)
            for n, other in enumerate(found):
                if n != k:
                    own[k, n] = self.likeness.own_places(rows, one.rig_from_world, other.rig_from_world)
        return own


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """A pose of the rig, in the estimator's world, and how well the looks agree with it."""

    rig_from_world: Float
    cams_from_world: Float
    inliers: tuple[NDArray[np.bool_], ...]
    support: float

    def elsewhere(self, other: _Hypothesis) -> bool:
        """Whether another pose is of another place or orientation."""
        apart = np.linalg.norm(camera_centers(self.rig_from_world) - camera_centers(other.rig_from_world))
        turned = rotation_angle_deg(self.rig_from_world[:, :3], other.rig_from_world[:, :3])
        return bool(apart > ELSEWHERE[0] or turned > ELSEWHERE[1])


class _Rig:
    """Looks as PoseLib takes them, and the poses they are consistent with."""

    def __init__(
        self, estimator: PoseEstimator, looks: Sequence[Look], turn_noise_deg: float, alone: Sequence[Alone]
    ) -> None:
        self.estimator = estimator
        self.looks = looks
        self.alone = alone
        known = [known_to_poselib(look.camera.colmap, np.asarray(look.pixels, dtype=np.float64)) for look in looks]
        self.cameras = [camera for camera, _ in known]
        self.pixels = [pixels for _, pixels in known]
        self.points = [estimator.points[look.rows] for look in looks]
        self.mounts = [np.asarray(look.cam_from_rig, dtype=np.float64) for look in looks]
        self.noise = np.radians(turn_noise_deg) if len(looks) > 1 else 0.0
        limit = estimator.config.max_error_px
        focal = max(look.camera.mean_focal_px for look in looks)
        # until the turns are refined, a match of a look that turned otherwise is off by as much
        self.loose = float(np.hypot(limit, 4 * self.noise * focal))

    def hypotheses(self) -> list[_Hypothesis]:
        """Poses worth comparing, elsewhere than one another, by falling support; of a single look its own is the first.

        They are refined on all looks' inliers.
        """
        if len(self.looks) == 1:
            return _elsewhere(self._alone(0))
        left = [np.ones(len(pixels), dtype=bool) for pixels in self.pixels]
        found = []
        for k in range(POSES_OF_ALL):
            sampled = self._sampled(left, TRIALS_ELSEWHERE if k else None)
            if not sampled:
                break
            found += sampled
            left = [mask & ~taken for mask, taken in zip(left, sampled[0].inliers, strict=True)]
        found += [pose for k in range(len(self.looks)) for pose in self._alone(k)]
        return _elsewhere(sorted(found, key=lambda pose: -pose.support))  # stable: of equals the first

    def inlier_rows(self, pose: _Hypothesis) -> NDArray[np.int64]:
        """Rows of the landmarks that agree with a pose."""
        return np.concatenate([look.rows[mask] for look, mask in zip(self.looks, pose.inliers, strict=True)])

    def _alone(self, k: int) -> list[_Hypothesis]:
        """The poses of one look alone; the first of the only one exactly as of a single image."""
        poses = [_in_rig(self.mounts[k], pose) for pose, _ in self.alone[k]]
        if len(self.looks) > 1:
            return [self._refined(pose) for pose in poses]
        made = [self._supported(pose) for pose in poses]
        return [
            replace(one, cams_from_world=pose[None], inliers=(mask,))
            for one, (pose, mask) in zip(made, self.alone[k], strict=True)
        ]

    def _sampled(self, taken: Sequence[NDArray[np.bool_]], trials: int | None = None) -> list[_Hypothesis]:
        """The pose that RANSAC finds over some of all looks' matches, if any."""
        if sum(mask.sum() for mask in taken) < LEAST:
            return []
        options = {**self.estimator.ransac, "max_reproj_error": self.loose}
        options["max_iterations"] = trials or options["max_iterations"]
        pixels = [of[mask] for of, mask in zip(self.pixels, taken, strict=True)]
        points = [of[mask] for of, mask in zip(self.points, taken, strict=True)]
        pose, found = poselib.estimate_generalized_absolute_pose(
            pixels, points, [_poselib(mount) for mount in self.mounts], self.cameras, options, REFINEMENT
        )
        if found["num_inliers"] < LEAST or not np.isfinite(pose.Rt).all():
            return []
        return [self._refined(pose.Rt)]

    def _refined(self, rig_from_world: Float) -> _Hypothesis:
        """A pose refined on the inliers of all looks, until they stay the same."""
        if self.noise:
            return self._refined_with_turns(rig_from_world)
        best = self._supported(rig_from_world)
        mounts = [_poselib(mount) for mount in self.mounts]
        for _ in range(ROUNDS):
            if sum(mask.sum() for mask in best.inliers) < LEAST:
                break
            pixels = [of[mask] for of, mask in zip(self.pixels, best.inliers, strict=True)]
            points = [of[mask] for of, mask in zip(self.points, best.inliers, strict=True)]
            start = _poselib(best.rig_from_world)
            pose, _ = poselib.refine_generalized_absolute_pose(
                pixels, points, start, mounts, self.cameras, JOINT_REFINEMENT
            )
            if not np.isfinite(pose.Rt).all():
                break
            again = self._supported(pose.Rt)
            if again.support < LOSES * best.support:
                break
            same = all(np.array_equal(*masks) for masks in zip(best.inliers, again.inliers, strict=True))
            best = again
            if same:
                break
        return best

    def _refined_with_turns(self, rig_from_world: Float) -> _Hypothesis:
        best = self._supported(rig_from_world, self.loose)
        cams = _of_looks(self.mounts, rig_from_world)
        for _ in range(ROUNDS):
            if sum(mask.sum() for mask in best.inliers) < LEAST:
                break
            rig_from_world, cams = refine_with_turns(
                self.looks, self.points, best.inliers, best.rig_from_world, cams, self.noise
            )
            best = self._supported(rig_from_world, cams=cams)
        return best

    def _supported(self, rig_from_world: Float, limit: float | None = None, cams: Float | None = None) -> _Hypothesis:
        """A pose with its inliers, within a limit in pixels, and its support."""
        limit = self.estimator.config.max_error_px if limit is None else limit
        cams = _of_looks(self.mounts, rig_from_world) if cams is None else cams
        inliers = []
        support = 0.0
        for look, points, pose in zip(self.looks, self.points, cams, strict=True):
            squared = squared_errors(look.camera, look.pixels, points, pose) / limit**2
            inliers.append(squared < 1)
            support += float((1 - squared[squared < 1]).sum())
        return _Hypothesis(rig_from_world, np.asarray(cams), tuple(inliers), support)

    def deviation(self, pose: _Hypothesis) -> tuple[float, float]:
        """One standard deviation of position (m) and orientation (degrees), by the inliers' errors and their spread."""
        information = np.zeros((6, 6))
        total = 0.0
        n = 0
        for look, points, mask, cam in zip(self.looks, self.points, pose.inliers, pose.cams_from_world, strict=True):
            if not mask.any():
                continue
            offsets = points[mask] - camera_centers(cam)
            distance = np.linalg.norm(offsets, axis=1)
            bearing = offsets / np.maximum(distance, 1e-9)[:, None]
            # a pixel off the axis spans less of an angle: by the cosine squared along, by the cosine across
            cosine = np.clip((offsets @ cam[2, :3]) / np.maximum(distance, 1e-9), 0.05, 1)
            weight = look.camera.mean_focal_px / cosine
            across = np.eye(3) - bearing[:, :, None] * bearing[:, None, :]
            skew = np.zeros((len(bearing), 3, 3))
            skew[:, [0, 0, 1], [1, 2, 2]] = np.stack([-bearing[:, 2], bearing[:, 1], -bearing[:, 0]], 1)
            skew -= skew.transpose(0, 2, 1)
            jacobian = np.concatenate([across / distance[:, None, None], skew], axis=2) * weight[:, None, None]
            information += np.einsum("nij,nik->jk", jacobian, jacobian)
            squared = squared_errors(look.camera, look.pixels[mask], points[mask], cam)
            total = total + float(squared.sum())
            n = n + int(mask.sum())
        if n <= 3 or np.linalg.cond(information) > 1e14:
            return np.inf, np.inf
        covariance = np.linalg.inv(information) * max(total / (2 * n - 6), 0.01)
        return float(np.sqrt(np.trace(covariance[:3, :3]))), float(np.degrees(np.sqrt(np.trace(covariance[3:, 3:]))))


def squared_errors(camera: Camera, pixels: Float, points: Float, cam_from_world: Float) -> Float:
    """Squared reprojection errors (M,) of points (M, 3) at pixels (M, 2) of a pose's image; infinite behind it."""
    there = points @ cam_from_world[:, :3].T + cam_from_world[:, 3]
    ahead = there[:, 2] > 1e-6 if not camera.colmap.model.endswith("FISHEYE") else np.ones(len(there), dtype=bool)
    projected = camera.project(np.where(ahead[:, None], there, (0.0, 0.0, 1.0)))
    squared = ((projected - pixels) ** 2).sum(1)
    return np.where(ahead & np.isfinite(squared), squared, np.inf)


def _elsewhere(poses: Sequence[_Hypothesis]) -> list[_Hypothesis]:
    """Without those that are near one before them."""
    kept: list[_Hypothesis] = []
    for pose in poses:
        if all(pose.elsewhere(other) for other in kept):
            kept.append(pose)
    return kept


def _of_looks(mounts: Sequence[Float], rig_from_world: Float) -> Float:
    """cam_from_world (N, 3, 4) of looks mounted in a rig by cam_from_rig."""
    stacked = np.stack(mounts)
    rotations = stacked[:, :, :3] @ rig_from_world[:, :3]
    return np.concatenate([rotations, (stacked[:, :, :3] @ rig_from_world[:, 3] + stacked[:, :, 3])[..., None]], axis=2)


def _in_rig(cam_from_rig: Float, cam_from_world: Float) -> Float:
    """rig_from_world (3, 4) of a look's pose."""
    rotation = cam_from_rig[:, :3].T
    return np.concatenate(
        [rotation @ cam_from_world[:, :3], (rotation @ (cam_from_world[:, 3] - cam_from_rig[:, 3]))[:, None]], axis=1
    )


def _poselib(pose: Float) -> poselib.CameraPose:
    made = poselib.CameraPose()
    made.R = pose[:, :3]
    made.t = pose[:, 3]
    return made
