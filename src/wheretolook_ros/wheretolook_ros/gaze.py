"""Points a camera on a pan-tilt head: to the best view at the robot's pose or along its path, or to the next view if lost.

Topics and parameters: docs/robots.md.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Vector3Stamped
from nav_msgs.msg import Path
from rclpy.duration import Duration
from scipy.spatial.transform import Rotation
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from wheretolook_ros.conversions import Array, compose, direction_message, pose_matrix, pose_message
from wheretolook_ros.node import OK, WARN, RobotNode, run

REUSED_M = 0.3  # within which the best view is not searched again


class GazeNode(RobotNode):
    """Publishes where the head looks."""

    def __init__(self) -> None:
        super().__init__("gaze")
        self._location = np.full(3, np.inf)  # of the base, where the best direction was searched last
        self._path = np.zeros((0, 3, 4))  # poses of the base
        package = "wheretolook_localization"
        modules = "wheretolook_robot", f"{package}.planning.view_sequence", f"{package}.geometry.poses"
        self._usable = self.open_folder(self._open, *modules)
        self._joints = self.create_publisher(JointTrajectory, "joint_trajectory", 10)
        self._gaze = self.create_publisher(Vector3Stamped, "gaze/direction", 10)
        self._views = self.create_publisher(Path, "gaze/views", 10)
        self.create_subscription(PoseWithCovarianceStamped, "visual_localization/pose", self._on_pose, 10)
        self.create_subscription(Vector3Stamped, "visual_localization/next_look", self._on_next_look, 10)
        self.create_subscription(Path, "plan", self._on_path, 10)

    def _open(self, robot: Any, view_sequence: Any, poses: Any) -> None:
        self._scorer = robot.RobotScorer(self.settings["folder"])
        self._axes = robot.fibonacci_sphere(self.settings["directions"])
        self._limit = view_sequence.TurnLimit.of(self._axes, self.settings["max_turn_deg"], pan_tilt=True)
        self._best_sequence = view_sequence.best_sequence
        self._looking_along = poses.rotation_looking_along

    def _on_next_look(self, message: Vector3Stamped) -> None:
        """Look where the localizer asks."""
        try:
            self.check_frame(message, "base_frame")
            vector = message.vector
            self._look(np.array([vector.x, vector.y, vector.z]), "looking to be localized")
        except ValueError as error:
            self.report(WARN, f"a next view cannot be used: {error}")

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Look along the nearest view of the path, or else along the best view here."""
        if not self._usable:
            self.report(*self.reported)
            return
        try:
            self.check_frame(message, "map_frame")
            base = pose_matrix(message.pose.pose)
            distance = np.linalg.norm(self._path[:, :, 3] - base[:, 3], axis=1)
            if distance.min(initial=np.inf) <= self.settings["spacing_m"]:
                direction = self._path_directions[distance.argmin()]
            else:
                direction = self._best(base)
            self._look(direction @ base[:, :3], "looking along the best view")
        except ValueError as error:
            self.report(WARN, f"no view at this pose: {error}")

    def _best(self, base: Array) -> Array:
        """The direction in the map that scores best here, or nearby and still within the limits."""
        near = np.linalg.norm(base[:, 3] - self._location) <= REUSED_M
        if not near or not self.head.allows(self._direction[None] @ base[:, :3])[0]:
            scores = self._scores(base)
            if scores.max() < self.settings["min_score"]:
                raise ValueError(f"the best score within the limits of the head is {scores.max():.2f}")
            self._location = base[:, 3]
            self._direction: Array = self._axes[scores.argmax()]
        return self._direction

    def _scores(self, base: Array) -> Array:
        """Scores (D,) of directions in the map; -inf outside of the head's limits."""
        allowed = self.head.allows(self._axes @ base[:, :3])
        scores = np.full(len(self._axes), -np.inf)
        if allowed.any():
            camera = compose(base, self.head.base_from_camera(0.0, 0.0))
            scores[allowed] = self._scorer.score_directions(camera[None, :, 3], self._axes[allowed])[0]
        return scores

    def _on_path(self, message: Path) -> None:
        """Choose and publish a view for each waypoint of a path, with limited turns between them."""
        views = Path(header=message.header)
        self._path = self._path[:0]
        try:
            self.check_frame(message, "map_frame")
            if not self._usable or not message.poses:
                raise ValueError("it is empty, or the robot's folder cannot be used")
            points = np.array([pose_matrix(pose.pose)[:, 3] for pose in message.poses])
            path = _waypoints(points, self.settings["spacing_m"])
            chosen = self._best_sequence(np.stack([self._scores(base) for base in path]), self._limit)
        except Exception as error:  # of the folder's modules, too
            self.report(WARN, f"no views along a path: {error}")
            return
        self._path = path
        self._path_directions = self._axes[chosen.direction_ids]
        for base, rotation in zip(path, self._looking_along(self._path_directions), strict=True):
            camera = compose(base, self.head.base_from_camera(0.0, 0.0))
            camera[:, :3] = rotation.T
            views.poses.append(PoseStamped(header=message.header, pose=pose_message(camera)))
        self._views.publish(views)

    def _look(self, direction: Array, why: str) -> None:
        """Publish a direction (3,) of the base, within the limits, and the joints that look along it."""
        joints = self.head.joints(direction)
        axis = self.head.base_from_camera(*joints)[:, 2]
        self._gaze.publish(direction_message(axis, self.settings["base_frame"], self.get_clock().now().to_msg()))
        reached = Duration(seconds=self.settings["turn_duration_s"]).to_msg()
        point = JointTrajectoryPoint(positions=joints, time_from_start=reached)
        self._joints.publish(JointTrajectory(joint_names=self.joint_names, points=[point]))
        self.report(OK, why)


def _waypoints(points: Array, spacing: float) -> Array:
    """Poses (W, 3, 4) of the base every `spacing` along a path (N, 3), with x along the path."""
    steps = np.gradient(points, axis=0) if len(points) > 1 else np.array([(1.0, 0, 0)])
    lengths = np.linalg.norm(np.diff(points, axis=0, prepend=points[:1]), axis=1).cumsum()
    rows = np.searchsorted(lengths, np.arange(0, lengths[-1] + 1e-6, spacing) - 1e-6)
    yaws = np.arctan2(steps[rows, 1], steps[rows, 0])
    return np.concatenate([Rotation.from_euler("z", yaws[:, None]).as_matrix(), points[rows, :, None]], axis=2)


def main() -> None:
    """Run the node."""
    run(GazeNode)


if __name__ == "__main__":
    main()
