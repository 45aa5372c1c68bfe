"""Points a camera on a pan-tilt head: to the best view at the robot's pose or along its path, or to the next view if lost.

Topics and parameters: docs/robots.md.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Vector3, Vector3Stamped
from nav_msgs.msg import Path
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from wheretolook_ros.conversions import Array, compose, pose_matrix, pose_message
from wheretolook_ros.node import ERROR, OK, WARN, RobotNode, run

PARAMETERS: dict[str, Any] = {
    "directions": 200,
    "spacing_m": 0.5,
    "max_turn_deg": 60.0,
    "min_score": 0.5,
    "turn_duration_s": 0.5,
}
MODULES = (
    "wheretolook_robot",
    "wheretolook_localization.planning.view_sequence",
    "wheretolook_localization.geometry.poses",
)
REUSED = 0.3, 15.0  # metres and degrees of the base within which the best view is not searched again


class GazeNode(RobotNode):
    """Publishes where the head looks."""

    def __init__(self) -> None:
        super().__init__("gaze", PARAMETERS)
        self._scorer: Any = None
        self._best: tuple[Array, Array] | None = None  # pose of the base, and direction in the map
        self._path = np.zeros((0, 3, 4))  # of the base
        self._directions = np.zeros((0, 3))  # along the path, in the map
        modules = self.load(*MODULES)
        if modules is not None:
            try:
                self._scorer = modules[0].RobotScorer(self.settings["folder"])
                self._axes = modules[0].fibonacci_sphere(self.settings["directions"])
                self._limit = modules[1].TurnLimit.of(self._axes, self.settings["max_turn_deg"], pan_tilt=True)
                self._best_sequence = modules[1].best_sequence
                self._looking_along = modules[2].rotation_looking_along
            except (OSError, ValueError, AttributeError, TypeError) as error:
                self.report(ERROR, f"the robot's folder cannot be used: {error}")
        self._joints = self.create_publisher(JointTrajectory, "joint_trajectory", 10)
        self._gaze = self.create_publisher(Vector3Stamped, "gaze/direction", 10)
        self._views = self.create_publisher(Path, "gaze/views", 10)
        self.create_subscription(PoseWithCovarianceStamped, "visual_localization/pose", self._on_pose, 10)
        self.create_subscription(Vector3Stamped, "visual_localization/next_look", self._on_next_look, 10)
        self.create_subscription(Path, "plan", self._on_path, 10)

    def _on_next_look(self, message: Vector3Stamped) -> None:
        """Look where the localizer asks, in the base."""
        if message.header.frame_id != self.settings["base_frame"]:
            self.report(WARN, f"a next view in the frame {message.header.frame_id!r} cannot be used")
            return
        self._look(np.array([message.vector.x, message.vector.y, message.vector.z]), "looking to be localized")

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Look along the nearest view of the path, or else along the best view here."""
        base = self._usable(message)
        if base is None:
            return
        direction = self._of_path(base)
        if direction is None:
            direction = self._of_place(base)
        if direction is not None:
            self._look(direction @ base[:, :3], "looking along the best view")

    def _of_path(self, base: Array) -> Array | None:
        if len(self._path) == 0:
            return None
        distance = np.linalg.norm(self._path[:, :, 3] - base[:, 3], axis=1)
        nearest = int(distance.argmin())
        return self._directions[nearest] if distance[nearest] <= self.settings["spacing_m"] else None

    def _of_place(self, base: Array) -> Array | None:
        if self._best is not None:
            then, direction = self._best
            cosine = (np.trace(then[:, :3].T @ base[:, :3]) - 1) / 2
            turned = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
            if np.linalg.norm(then[:, 3] - base[:, 3]) <= REUSED[0] and turned <= REUSED[1]:
                return direction
        scores = self._scores(base)
        if np.isneginf(scores).all():
            self.report(WARN, "no direction is within the limits of the head")
            return None
        best = int(scores.argmax())
        if scores[best] < self.settings["min_score"]:
            self.report(WARN, f"no view here is likely to localize: {scores[best]:.2f}")
        self._best = base, self._axes[best]
        return np.asarray(self._axes[best])

    def _scores(self, base: Array) -> Array:
        """Scores (D,) of directions in the map; -inf outside of the head's limits."""
        allowed = self.head.allows(self._axes @ base[:, :3])
        scores = np.full(len(self._axes), -np.inf)
        if allowed.any():
            camera = compose(base, self.head.base_from_camera(0.0, 0.0))
            scores[allowed] = self._scorer.score_directions(camera[None, :, 3], self._axes[allowed])[0]
        return scores

    def _on_path(self, message: Path) -> None:
        """Choose a view for each waypoint of a path, `spacing_m` apart, with limited turns between them."""
        if message.header.frame_id != self.settings["map_frame"] or self._scorer is None:
            self.report(WARN, f"a path in the frame {message.header.frame_id!r} cannot be used")
            return
        try:
            points = np.array([pose_matrix(pose.pose)[:, 3] for pose in message.poses]).reshape(-1, 3)
            self._path = _waypoints(points, self.settings["spacing_m"])
            if len(self._path):
                scores = np.stack([self._scores(base) for base in self._path])
                chosen = self._best_sequence(scores, self._limit)
                self._directions = self._axes[chosen.direction_ids]
        except Exception as error:  # a path without views: the best view at each pose remains
            self._path = self._path[:0]
            self.report(WARN, f"no views along the path: {error}")
            return
        views = Path(header=message.header)
        for base, direction in zip(self._path, self._directions, strict=True):
            camera = compose(base, self.head.base_from_camera(0.0, 0.0))
            camera[:, :3] = self._looking_along(direction).T
            views.poses.append(PoseStamped(header=message.header, pose=pose_message(camera)))
        self._views.publish(views)

    def _usable(self, message: PoseWithCovarianceStamped) -> Array | None:
        if self._scorer is None:
            self.report(*self._reported)
            return None
        try:
            if message.header.frame_id != self.settings["map_frame"]:
                raise ValueError(f"its frame is {message.header.frame_id!r}")
            return pose_matrix(message.pose.pose)
        except ValueError as error:
            self.report(WARN, f"a pose cannot be used: {error}")
            return None

    def _look(self, direction: Array, why: str) -> None:
        """Publish a direction (3,) of the base, and the joints that look along it."""
        joints = self.head.joints(direction)
        now = self.get_clock().now().to_msg()
        axis = self.head.base_from_camera(*joints)[:, 2]
        gaze = Vector3Stamped(vector=Vector3(**dict(zip("xyz", axis.tolist(), strict=True))))
        gaze.header.stamp = now
        gaze.header.frame_id = self.settings["base_frame"]
        self._gaze.publish(gaze)
        seconds = self.settings["turn_duration_s"]
        reached = Duration(sec=int(seconds), nanosec=int(seconds % 1 * 1e9))
        point = JointTrajectoryPoint(positions=list(joints), time_from_start=reached)
        trajectory = JointTrajectory(
            joint_names=[self.settings["pan_joint"], self.settings["tilt_joint"]], points=[point]
        )
        self._joints.publish(trajectory)
        self.report(OK, why, pan_deg=f"{np.degrees(joints[0]):.1f}", tilt_deg=f"{np.degrees(joints[1]):.1f}")


def _waypoints(points: Array, spacing: float) -> Array:
    """Poses (W, 3, 4) of the base at points of a path (N, 3) at least `spacing` apart, with x along the path."""
    kept: list[int] = []
    for row, point in enumerate(points):
        if not kept or np.linalg.norm(point - points[kept[-1]]) >= spacing:
            kept.append(row)
    poses = np.zeros((len(kept), 3, 4))
    for pose, row in zip(poses, kept, strict=True):
        ahead = (
            points[min(row + 1, len(points) - 1)] - points[min(row, len(points) - 2)] if len(points) > 1 else (1, 0, 0)
        )
        yaw = np.arctan2(ahead[1], ahead[0])
        pose[:] = np.column_stack(
            [[[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]], points[row]]
        )
    return poses


def main() -> None:
    """Run the node."""
    run(GazeNode)


if __name__ == "__main__":
    main()
