"""Localizes several views jointly: one pose for a rig of views whose poses relative to one another are known.

A camera that rotates in place knows how far it rotated. So N views from a location are one generalized camera (Pless
2003), and all their matches must agree on one pose: where a map resembles itself, a single view may be localized at a
wrong pose with a hundred inliers, on which the others do not agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from wheretolook.dataset.config import ACCURACY, CONTRADICTED, LOCALIZED, NO_POSE, TOO_FEW_MATCHES, Accuracy
from wheretolook.geometry.poses import Float
from wheretolook.geometry.similarity import poses_from
from wheretolook.localization.confidence import MIN_INLIERS, ConfidenceModel
from wheretolook.localization.estimation import (
    MIN_MATCHES,
    RIVAL_TRIALS,
    Hypothesis,
    PoseAmbiguity,
    PoseEstimator,
    RigMatches,
    SingleViewPoses,
    distinct,
    most_likely,
    strongest_rival,
    turn_errors,
)
from wheretolook.localization.missing import ExpectedLandmarks
from wheretolook.localization.rig import Look
from wheretolook.utils.errors import check_range

POSES_OF_A_VIEW = 2
"""Hypotheses from each view of a rig as a single image."""

POSES_OF_AN_IMAGE = 4
"""Hypotheses from the matches of a single image."""


@dataclass(frozen=True, eq=False)
class JointLocalization:
    """The pose that the matches of one view or several support best, how well, and the rival hypotheses.

    Attributes:
        status: "localized", "too_few_matches" or "no_pose", as for a single image; "contradicted" if there is a pose, but
            the images contradict the known rotations.
        looks: the views with the matches that the pose is judged by; under guided matching those found with it.
        rig_from_world: (3, 4); None if there is none. With too few inliers it is kept, but the status is "no_pose".
        cams_from_world: (N, 3, 4) poses of the views, including their refined rotations if these were not exact.
        inliers: N masks (M_k,) of each view's matches that agree with the pose.
        n_matches: matches of all views with the whole map.
        support: sum over inliers of a weight that falls from 1 to 0 as the error rises to its limit.
        rival_support: greatest support of a competing pose (see `Hypothesis.differs_from`); 0 if there is none.
        unique_support: numbers of locations with inliers of this pose that the strongest rival cannot explain, and with
            inliers of the rival that this pose cannot explain (`PoseAmbiguity`); all and 0 if there is no rival.
        covariance: (6, 6) of position (m) and orientation (rad) in the world given the inliers; infinite where they
            do not determine the pose.
        rivals: the other hypotheses, by decreasing evidence, without rivals of their own.
        turn_error_deg: largest error of the known rotations if the images contradict them; else 0.
        expected: the landmarks of the map, if it is known what decides whether they are detected.
        error_factor: of the estimator, in `covariance`.
    """

    status: str
    looks: tuple[Look, ...]
    n_matches: int
    rig_from_world: Float | None = None
    cams_from_world: Float | None = None
    inliers: tuple[NDArray[np.bool_], ...] = ()
    support: float = 0.0
    rival_support: float = 0.0
    unique_support: tuple[int, int] = (0, 0)
    covariance: Float = field(default_factory=lambda: np.full((6, 6), np.inf))
    rivals: tuple[JointLocalization, ...] = ()
    turn_error_deg: float = 0.0
    expected: ExpectedLandmarks | None = None
    error_factor: float = 1.0

    @property
    def n_inliers(self) -> int:
        """Inliers of all views."""
        return int(sum(mask.sum() for mask in self.inliers))

    @property
    def deviation(self) -> tuple[float, float]:
        """One standard deviation of the position (m) and of the orientation (degrees)."""
        variance = np.diagonal(self.covariance)
        return float(np.sqrt(variance[:3].sum())), float(np.degrees(np.sqrt(variance[3:].sum())))

    @cached_property
    def missing(self) -> float | None:
        """Share of the expected detections in parts of the images without inliers; None if none can be expected."""
        if self.expected is None or self.cams_from_world is None:
            return None
        return self.expected.missing(self.looks, self.cams_from_world, self.inliers)

    def probability(self, accuracy: Accuracy = ACCURACY) -> float:
        """Probability that the pose is within an accuracy, 0 if there is no pose."""
        n_inliers = self.n_inliers
        # the model is fitted on maps of renders: with errors that are larger by a factor, limits are as much smaller
        scale = 1 / self.error_factor
        return ConfidenceModel.bundled().p_within(
            n_inliers,
            self.n_matches,
            self.rival_support,
            self.unique_support,
            (scale * self.deviation[0], scale * self.deviation[1]),
            (scale * accuracy[0], scale * accuracy[1]),
            self.missing if n_inliers >= MIN_INLIERS else None,
        )

    def probabilities(self, accuracy: Accuracy = ACCURACY) -> Float:
        """Probabilities (1 + rivals,) that the pose and each of its rivals are within an accuracy, in sum at most 1."""
        found = np.array([pose.probability(accuracy) for pose in (self, *self.rivals)])
        return found / max(1.0, float(found.sum()))


class JointLocalizer:
    """Localizes views jointly against the points of a `PoseEstimator`.

    Hypotheses come from PoseLib's LO-RANSAC (generalized P3P) over all matches, over those that agree with no earlier
    hypothesis, and from each view as a single image. Each is refined on the inliers of all views; if views have
    candidates, on the matches found again under it. The one with the most unique support wins (`pose_ambiguity`): where the map resembles
    itself, a wrong pose may have more inliers, but most of them the right pose explains, too. Errors are pixels of each
    view's own image, not angles, with which RANSAC would be twice as lenient near the border of an image.

    With `LocalizerConfig.method` "first", a single view is localized exactly as by the estimator. `turn_noise_deg` is
    one standard deviation, about each axis, of the known rotations between views. With `check_turns`, the views' own
    poses are compared with these: if they contradict them, the noise that they imply replaces it (`turn_errors`).
    """

    def __init__(
        self,
        estimator: PoseEstimator,
        turn_noise_deg: float = 0.0,
        check_turns: bool = False,
        expected: ExpectedLandmarks | None = None,
    ) -> None:
        check_range("the noise of rotations in degrees", turn_noise_deg, 0, 90)
        self.estimator = estimator
        self.turn_noise_deg = turn_noise_deg
        self.check_turns = check_turns
        self.expected = expected

    @cached_property
    def ambiguity(self) -> PoseAmbiguity:
        """Ambiguity of the map."""
        return PoseAmbiguity(self.estimator.points)

    def single_view_poses(self, look: Look, count: int = POSES_OF_A_VIEW) -> SingleViewPoses:
        """Localize a view as a single image, then repeatedly the matches that agree with no earlier pose.

        `localize` accepts the result.
        """
        points = self.estimator.points[look.rows]
        left = np.arange(len(points))
        poses: list[tuple[Float, NDArray[np.bool_]]] = []
        while len(poses) < count and len(left) >= max(MIN_MATCHES, self.estimator.config.min_matches):
            trials = RIVAL_TRIALS if poses else None
            estimated = self.estimator.estimate_local(look.pixels[left], points[left], look.camera, trials)
            if estimated is None:
                break
            pose, inliers = estimated
            mask = np.zeros(len(points), dtype=bool)
            mask[left[inliers]] = True
            poses.append((pose, mask))
            left = left[~inliers]
        return tuple(poses)

    def focal_ratio(self, looks: Sequence[Look]) -> float:
        """Return the factor of assumed focal lengths with which most matches of a view agree with its pose; else 1.

        RANSAC starts from the assumed values, and if less than half of the matches agree, from others in the range.
        """
        view = max(looks, key=lambda look: len(look.rows) * (look.focal is not None))
        if view.focal is None or len(view.rows) < MIN_MATCHES:
            return 1.0
        points = self.estimator.points[view.rows]
        focal_px = view.camera.mean_focal_px
        starts = [1.0, *(value / focal_px for value in view.focal.focal_px[1:])]
        best: Hypothesis | None = None
        for n, ratio in enumerate([*starts, 0.75, 1.33]):
            if n >= len(starts) and best is not None and best.n_inliers > len(points) / 2:
                break
            start = view.scaled(ratio)
            estimated = self.estimator.estimate_local(start.pixels, points, start.camera, RIVAL_TRIALS)
            if estimated is not None:
                rig = RigMatches(self.estimator, [start], 0.0)
                found = rig.refine(rig.rig_pose(0, estimated[0]))
                best = found if best is None or found.support > best.support else best
        return 1.0 if best is None else best.with_focal().rig.looks[0].camera.mean_focal_px / focal_px

    def localize(
        self, looks: Sequence[Look], single_view_poses: Sequence[SingleViewPoses] | None = None
    ) -> JointLocalization:
        """Localize one view or more, given each view's `single_view_poses` if known."""
        n_matches = sum(len(look.rows) for look in looks)
        # a prior leads to poses by matches with the landmarks near it, where those with the whole map are too few
        others = [len(inliers) for of_view in single_view_poses or () for _, inliers in of_view]
        if n_matches < MIN_MATCHES:
            n_matches = max([n_matches, *others])
        if n_matches < MIN_MATCHES:
            return JointLocalization(TOO_FEW_MATCHES, tuple(looks), n_matches)
        if single_view_poses is None:
            count = POSES_OF_A_VIEW if len(looks) > 1 else POSES_OF_AN_IMAGE
            single_view_poses = [self.single_view_poses(look, count) for look in looks]
        noise_deg = self.turn_noise_deg
        error_deg = 0.0
        if self.check_turns and len(looks) > 1:
            noise_deg, error_deg = turn_errors(self.estimator, looks, single_view_poses, noise_deg)
        rig = RigMatches(self.estimator, looks, noise_deg)
        first = len(looks) == 1 and self.estimator.config.method == "first"
        if first:
            hypotheses = rig.first_poses(single_view_poses[0])
        else:
            hypotheses = rig.hypotheses(single_view_poses)
            if all(look.candidates is not None for look in looks):
                hypotheses = distinct([rig.guided(hypothesis) for hypothesis in hypotheses])
            # weaker ones are not chosen, and their focal length matters little
            least = 0.3 * max((pose.support for pose in hypotheses), default=0.0)
            hypotheses = distinct([pose.with_focal() if pose.support > least else pose for pose in hypotheses])
        if not hypotheses:
            return JointLocalization(NO_POSE, tuple(looks), n_matches, turn_error_deg=error_deg)
        best = self._ranked(hypotheses, n_matches, first)
        status = CONTRADICTED if error_deg and best.status == LOCALIZED else best.status
        return replace(best, status=status, turn_error_deg=error_deg)

    def _ranked(self, hypotheses: Sequence[Hypothesis], n_matches: int, first: bool) -> JointLocalization:
        """Compare hypotheses; return the best with the others as its rivals."""
        poses = [pose.rig_from_world for pose in hypotheses]
        unique = self.ambiguity.unique_supports([pose.inlier_rows for pose in hypotheses], poses)
        support = [pose.support for pose in hypotheses]
        results = []
        for k, pose in enumerate(hypotheses):
            own = (self.ambiguity.count_voxels(pose.inlier_rows), 0)
            if len(hypotheses) > 1:
                rival = strongest_rival(unique, support, k)
                own = int(unique[k, rival]), int(unique[rival, k])
            result = JointLocalization(
                status=LOCALIZED if pose.n_inliers >= self.estimator.config.min_inliers else NO_POSE,
                looks=tuple(pose.rig.looks),
                n_matches=n_matches,
                rig_from_world=poses_from(pose.rig_from_world, -self.estimator.origin),
                cams_from_world=poses_from(pose.cams_from_world, -self.estimator.origin),
                inliers=pose.inliers,
                support=pose.support,
                rival_support=max(support[:k] + support[k + 1 :], default=0.0),
                unique_support=own,
                covariance=pose.covariance,
                expected=self.expected,
                error_factor=self.estimator.error_factor,
            )
            results.append(result)
        chosen = 0 if first else most_likely(unique, support)
        best = results.pop(chosen)
        return replace(best, rivals=tuple(results))
