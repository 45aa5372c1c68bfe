"""Selects the next view of a camera that turns in place until its pose is known.

The first view of a robot that does not know its pose is arbitrary. Its matches support several pose hypotheses; each
predicts how well every further view would localize.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.lattices import direction_lattice
from wheretolook.geometry.poses import Float, camera_centers, pan_tilt_angles, rotation_looking_along, within
from wheretolook.localization.confidence import RIGHT_PLACE
from wheretolook.utils.errors import PlanningError

if TYPE_CHECKING:
    from wheretolook.localization.rig_localization import JointLocalization
    from wheretolook.scorers.base import Scorer


class DirectionScorer(Protocol):
    """A scorer of the map, here or on a robot."""

    def score_directions(self, locations: Float, directions: Float) -> Float:
        """Score cameras without roll at locations (L, 3) m along each of directions (D, 3). Returns (L, D)."""
        ...


N_DIRECTIONS = 300

MIN_ANGLE_DEG = 30.0
"""Minimum angle to all earlier views."""


@dataclass(frozen=True, eq=False)
class NextLook:
    """The next view of a camera that turns in place.

    Attributes:
        cam_from_rig: rotation (3, 3), without roll, as `turns` of the localization with this view.
        pan_deg: by which the camera turns to the left from its last view.
        pitch_deg: of the view, upwards.
        gain: expected probability that the view localizes.
    """

    cam_from_rig: Float
    pan_deg: float
    pitch_deg: float
    gain: float


def mean_scores_by_pitch(scorer: Scorer, locations: ArrayLike | None = None) -> Float:
    """Determine mean scores (N_DIRECTIONS,) of views at locations (L, 3) m, from the lowest pitch of the lattice up.

    Locations are by default those of 40 mapping cameras at most. Raises PlanningError if neither are known.
    """
    if locations is None:
        poses = scorer.localization_map.mapping_poses
        if poses is None:
            raise PlanningError("the map has no mapping cameras", fix="Give locations.")
        locations = camera_centers(poses)
    at: Float = np.asarray(locations, dtype=np.float64)
    at = at[np.linspace(0, len(at) - 1, min(len(at), 40)).astype(int)]
    axes = direction_lattice(N_DIRECTIONS)
    window = np.ones(N_DIRECTIONS // 10)
    mean = np.convolve(scorer.score_directions(at, axes).mean(axis=0)[np.argsort(axes[:, 2])], window, mode="same")
    return mean / np.convolve(np.ones(N_DIRECTIONS), window, mode="same")


class NextLookSelector:
    """Selects next views by expected gain, with any scorer of the map.

    The gain of a view is the sum over hypotheses of the probability of each times the view's score if it is right. With
    the probability that all are wrong, the gain is the mean score over the map of views at this pitch, times the angle to
    the nearest earlier view as a fraction of 90 degrees.
    """

    def __init__(self, scorer: DirectionScorer, mean_scores: Float) -> None:
        """Keep a scorer and the map's mean scores by pitch, of `mean_scores_by_pitch`."""
        self.scorer = scorer
        self._mean_scores = mean_scores
        self._axes = direction_lattice(N_DIRECTIONS)
        self._heights = np.sort(self._axes[:, 2])

    def gains(self, localization: JointLocalization, axes: Float, heights: Float) -> Float:
        """Expected gains (D,) of views along axes (D, 3) in the rig, whose sine of the pitch is heights (D,)."""
        found, scores = self.scores_under(localization, axes)
        return found @ scores + (1 - found.sum()) * self.scores_if_lost(localization, axes, heights)

    def scores_under(self, localization: JointLocalization, axes: Float) -> tuple[Float, Float]:
        """Probabilities (H,), at least 0.02, of the best 6 hypotheses at most, and under each the scores (H, D) of axes (D, 3) in the rig."""
        poses = (localization, *localization.rivals)
        found = localization.probabilities(RIGHT_PLACE)
        best = np.argsort(-found, kind="stable")[:6]
        best = best[found[best] >= 0.02]
        scores = np.zeros((len(best), len(axes)))
        for row, k in enumerate(best):
            pose = np.asarray(poses[k].rig_from_world)
            scores[row] = self.scorer.score_directions(camera_centers(pose)[None], axes @ pose[:, :3])[0]
        return found[best], scores

    def scores_if_lost(self, localization: JointLocalization, axes: Float, heights: Float) -> Float:
        """Scores (D,) of views as of `gains` if no hypothesis is right."""
        # from 90 degrees on, a view sees nothing that earlier ones have seen
        spread = np.minimum(angles_to_views(localization, axes) / 90.0, 1)
        return np.interp(heights, self._heights, self._mean_scores) * spread

    def select(
        self,
        localization: JointLocalization,
        up: ArrayLike | None = None,
        pitch_deg: tuple[float, float] = (-45.0, 45.0),
        pan_deg: tuple[float, float] | None = None,
    ) -> NextLook:
        """Select the next view, given the localization of all earlier ones.

        Args:
            localization: of one view or several from one location.
            up: direction up (3,) in the rig; by default as estimated, with the first view's own, as if it were level,
                where that is uncertain.
            pitch_deg: lowest and highest pitch.
            pan_deg: lowest and highest pan, to the left from the first view; None for any.

        Raises PlanningError if the limits leave no view that differs from the earlier ones.
        """
        level = _level_from_rig(localization, up)
        axes = self._axes @ level
        yaw, pitch = (np.degrees(angles) for angles in pan_tilt_angles(self._axes))
        allowed = (pitch >= pitch_deg[0]) & (pitch <= pitch_deg[1])
        if pan_deg is not None:
            allowed &= within((yaw - pan_deg[0]) % 360, pan_deg[1] - pan_deg[0])
        allowed &= angles_to_views(localization, axes) >= MIN_ANGLE_DEG
        rows = np.flatnonzero(allowed)
        if len(rows) == 0:
            problem = f"no view within the limits is {MIN_ANGLE_DEG:g} degrees from the earlier ones"
            raise PlanningError(problem, value=(pitch_deg, pan_deg), fix="Widen the limits.")
        gains = self.gains(localization, axes[rows], self._axes[rows, 2])
        best = rows[np.argmax(gains)]
        last_yaw = np.degrees(pan_tilt_angles(level @ localization.looks[-1].cam_from_rig[2, :3])[0])
        turn = (yaw[best] - last_yaw + 180) % 360 - 180
        rotation = rotation_looking_along(self._axes[best]) @ level
        return NextLook(rotation, float(turn), float(pitch[best]), float(gains.max()))


def angles_to_views(localization: JointLocalization, axes: Float) -> Float:
    """Angles (D,) in degrees between axes (D, 3) in the rig and the nearest localized view."""
    views = np.stack([look.cam_from_rig[2, :3] for look in localization.looks])
    return np.asarray(np.degrees(np.arccos(np.clip(axes @ views.T, -1, 1))).min(axis=1))


def _level_from_rig(localization: JointLocalization, up: ArrayLike | None) -> Float:
    """Rotation (3, 3) from the rig to axes with z up, and x in the vertical plane of the first view."""
    first = localization.looks[0].cam_from_rig
    if up is None:
        found = localization.probabilities(RIGHT_PLACE)
        up = -(1 - found.sum()) * first[1, :3]
        for probability, pose in zip(found, (localization, *localization.rivals), strict=True):
            if pose.rig_from_world is not None:
                up = up + probability * pose.rig_from_world[:, 2]
    z = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    ahead = first[2, :3] if abs(first[2, :3] @ z) < 0.99 else first[1, :3]
    x = ahead - (ahead @ z) * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
