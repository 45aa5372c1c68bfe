"""Localizes the images of a moving camera one after another; by odometry, those of one location jointly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wheretolook.dataset.thresholds import ACCURACY, Accuracy
from wheretolook.geometry.poses import (
    Float,
    camera_centers,
    compose_poses,
    invert_poses,
    pose_error,
    rotation_angle_deg,
)
from wheretolook.robot.localizer import RobotLocalization, RobotLocalizer, RobotView
from wheretolook.utils.errors import ConfigError

MIN_TURN_DEG = 20.0  # between views that are localized jointly
DRIFT = 0.25, 5.0  # m and degrees by which odometry may disagree with two confident poses,
DRIFT_RATE = 0.1  # plus this share of the distance between them


@dataclass(frozen=True, eq=False)
class SequenceResult:
    """The pose of the last image."""

    localization: RobotLocalization  # its rig has the axes of the last image's camera
    n_views: int  # localized jointly
    contradiction: str = ""  # between the odometry and the images

    @property
    def reason(self) -> str:
        """Say why the pose is not more probable."""
        joint = self.localization.joint
        if not self.localization.poses:
            return f"lost: no pose from {joint.n_matches} matches with the map"
        support = f"{joint.n_inliers} of {joint.n_matches} matches are inliers, {len(joint.rivals)} rival poses"
        return f"lost: probability {self.localization.probability:.3f}, {support}"


class ImageSequence:
    """Keeps the last views from about one location, until an image is localized by itself.

    Args:
        localizer: of the map.
        confidence: probability from which on an image needs no other views.
        accuracy: limits in metres and degrees that probabilities refer to.
        max_views: localized jointly.
        max_move_m: distance between the locations of views that are localized jointly.

    Raises ConfigError unless 0 < confidence <= 1 and at least one view is localized.
    """

    def __init__(
        self,
        localizer: RobotLocalizer,
        confidence: float = 0.95,
        accuracy: Accuracy = ACCURACY,
        max_views: int = 4,
        max_move_m: float = 0.3,
    ) -> None:
        if not 0 < confidence <= 1:
            raise ConfigError("a confidence is a probability", value=confidence, fix="Give one above 0, such as 0.95.")
        if max_views < 1:
            raise ConfigError("at least one view is localized", value=max_views, fix="Give max_views from 1 on.")
        self.localizer = localizer
        self.confidence = confidence
        self.accuracy = accuracy
        self.max_views = max_views
        self.max_move_m = max_move_m
        self.reset()

    def reset(self) -> None:
        """Forget all earlier images."""
        self._kept: list[tuple[RobotView, Float]] = []
        self._confident: tuple[Float, Float] | None = None

    def add(self, view: RobotView, cam_from_odom: Float | None = None) -> SequenceResult:
        """Localize the next image, given the pose (3, 4) of its camera by odometry, in metres, if known."""
        alone = self.localizer.localize([view], accuracy=self.accuracy)
        if cam_from_odom is None:
            self.reset()
            return SequenceResult(alone, 1)
        others = [kept for kept in self._kept if self._joins(kept[1], cam_from_odom)]
        best = alone
        n_views = 1
        contradiction = ""
        if others and alone.probability < self.confidence:
            turns = np.stack([compose_poses(pose, invert_poses(cam_from_odom)) for _, pose in others])
            views = [view, *(kept for kept, _ in others)]
            joint = self.localizer.localize(views, np.concatenate([np.eye(3, 4)[None], turns]), self.accuracy)
            if joint.probability >= alone.probability:
                best = joint
                n_views = len(views)
                if joint.joint.turn_error_deg:
                    contradiction = f"odometry contradicts the images by {joint.joint.turn_error_deg:.1f} degrees"
        kept = [*others, (view, cam_from_odom)]
        self._kept = kept[max(len(kept) + 1 - self.max_views, 0) :]
        if best.probability >= self.confidence:
            pose = best.joint.rig_from_world
            assert pose is not None
            if self._confident is not None:
                contradiction = _contradiction(*self._confident, pose, cam_from_odom) or contradiction
            if contradiction:
                self._kept = self._kept[-1:]
            self._confident = pose, cam_from_odom
        return SequenceResult(best, n_views, contradiction)

    def _joins(self, earlier: Float, now: Float) -> bool:
        """Whether a camera pose is near enough to another, and looks elsewhere."""
        moved = np.linalg.norm(camera_centers(earlier) - camera_centers(now))
        return bool(moved <= self.max_move_m and rotation_angle_deg(earlier[:, :3], now[:, :3]) >= MIN_TURN_DEG)


def _contradiction(map_before: Float, odom_before: Float, map_now: Float, odom_now: Float) -> str:
    """Describe by how much odometry and localization disagree on a motion, empty if within `DRIFT`."""
    now_from_before = compose_poses(odom_now, invert_poses(odom_before))
    error_m, error_deg = pose_error(compose_poses(now_from_before, map_before), map_now)
    distance = np.linalg.norm(camera_centers(odom_now) - camera_centers(odom_before))
    if error_m <= DRIFT[0] + DRIFT_RATE * distance and error_deg <= DRIFT[1]:
        return ""
    return f"odometry contradicts the images by {error_m:.2f} m and {error_deg:.1f} degrees"
