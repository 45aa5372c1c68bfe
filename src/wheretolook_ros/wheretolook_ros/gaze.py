"""Points a camera on a head: to the best view at the robot's pose or along its path, or to the next view if lost.

Topics and parameters: docs/robots.md.
"""

from __future__ import annotations

import pathlib

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Vector3Stamped
from nav_msgs.msg import OccupancyGrid, Path
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile
from scipy.spatial.transform import Rotation
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from wheretolook.planning.view_sequence import TurnLimit, best_sequence, between, lengths_along
from wheretolook.robot.wheretolook_robot import RobotScorer, fibonacci_sphere
from wheretolook_ros.conversions import (
    Array,
    direction_message,
    finite,
    localizability_message,
    pose_matrix,
    pose_message,
)
from wheretolook_ros.node import OK, WARN, RobotNode, run

REUSED_M = 0.3  # within which the best view is not searched again


class GazeNode(RobotNode):
    """Publishes where the head looks."""

    def __init__(self) -> None:
        super().__init__("gaze")
        self._location = np.full(3, np.inf)  # of the base, where the best direction was searched last
        self._path = np.zeros((0, 3, 4))  # poses of the base
        if not self.open_folder(self._open):
            return
        self._joints = self.create_publisher(JointTrajectory, "joint_trajectory", 10)
        self._gaze = self.create_publisher(Vector3Stamped, "gaze/direction", 10)
        self._views = self.create_publisher(Path, "gaze/views", 10)
        self._goals = self.create_publisher(PoseStamped, "gaze/goal_pose", 10)
        if self.settings.mask:
            self._publish_mask(self.settings.mask)
        self.listen(PoseWithCovarianceStamped, "visual_localization/pose", self._on_pose)
        self.listen(Vector3Stamped, "visual_localization/next_look", self._on_next_look)
        self.listen(Path, "plan", self._on_path)

    def _open(self, folder: pathlib.Path) -> None:
        self._scorer = RobotScorer(folder)
        self._axes = fibonacci_sphere(self.settings.directions)
        self._limit = TurnLimit.of(self._axes, self.settings.max_turn_deg, pan_tilt=True)

    def _publish_mask(self, folder: str) -> None:
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        grids = self.create_publisher(OccupancyGrid, "localizability", latched)
        try:
            grids.publish(localizability_message(pathlib.Path(folder), self.settings.map_frame))
        except Exception as error:  # whatever its files hold
            self.report(WARN, f"mask {folder} is not published: {error}")

    def _on_next_look(self, message: Vector3Stamped) -> None:
        """Look where the localizer asks."""
        self.check_frame(message, "base_frame")
        vector = message.vector
        direction = np.array([vector.x, vector.y, vector.z])
        self._look(direction, "not localized: looking at the next view")
        if not any(self.joint_names):  # the robot turns; without a stamp, since its latest pose counts
            pan = self.head.joints(direction)[0]
            goal = np.column_stack([Rotation.from_euler("z", pan).as_matrix(), np.zeros(3)])
            header = Header(frame_id=self.settings.base_frame)
            self._goals.publish(PoseStamped(header=header, pose=pose_message(goal)))

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Look along the nearest view of the path, or else along the best view here."""
        self.check_frame(message, "map_frame")
        base = pose_matrix(message.pose.pose)
        distance = np.linalg.norm(self._path[:, :, 3] - base[:, 3], axis=1)
        if distance.min(initial=np.inf) <= self.settings.spacing_m:
            direction = self._path_directions[distance.argmin()]
        else:
            direction = self._best(base)
        self._look(direction @ base[:, :3], "localized: looking at the best view")

    def _best(self, base: Array) -> Array:
        """The direction in the map that scores best here, or nearby and still within the limits."""
        moved = np.linalg.norm(base[:, 3] - self._location)
        if moved > REUSED_M or not self.head.nearest(self._direction @ base[:, :3])[1]:
            scores = self._scores(base)
            if scores.max() < self.settings.min_score:
                raise ValueError(f"the best score within the head's limits is {scores.max():.2f}, below min_score")
            self._location = base[:, 3]
            self._direction: Array = self._axes[scores.argmax()]
        return self._direction

    def _scores(self, base: Array) -> Array:
        """Scores (D,) of the views nearest to directions in the map; -inf outside of the head's limits."""
        looks, allowed = self.head.nearest(self._axes @ base[:, :3])
        scores = np.full(len(looks), -np.inf)
        if allowed.any():
            views = looks[allowed] @ base[:, :3].T
            scores[allowed] = self._scorer.score_directions([base @ self.head.location], views)[0]
        return scores

    def _on_path(self, message: Path) -> None:
        """Choose and publish a view for each waypoint of a path, with limited turns between them."""
        self._path = self._path[:0]
        self.check_frame(message, "map_frame")
        if not message.poses:
            raise ValueError("no poses")
        points = np.array([pose_matrix(pose.pose)[:, 3] for pose in message.poses])
        path = self._waypoints(points, self.settings.spacing_m)
        chosen = best_sequence(np.stack([self._scores(base) for base in path]), self._limit)
        self._path = path
        self._path_directions = self._axes[chosen.direction_ids]
        views = Path(header=message.header)
        for base, direction in zip(path, self._path_directions, strict=True):
            camera = base[:, :3] @ self.head.base_from_camera(*self.head.joints(direction @ base[:, :3]))
            camera[:, 3] += base[:, 3]
            views.poses.append(PoseStamped(header=message.header, pose=pose_message(camera)))
        self._views.publish(views)

    def _waypoints(self, points: Array, spacing: float) -> Array:
        """Poses (W, 3, 4) of the base every `spacing` along a path (N, 3), with x along the path."""
        lengths = lengths_along(points)
        at = np.arange(0, lengths[-1] + 1e-6, spacing)
        before, here, after = (between(lengths, points, at + shift) for shift in (-spacing / 2, 0, spacing / 2))
        x, y, _ = (after - before).T
        turned = Rotation.from_euler("z", np.arctan2(y, x)[:, None]).as_matrix()
        return np.concatenate([turned, here[:, :, None]], axis=2)

    def _look(self, direction: Array, why: str) -> None:
        """Publish a direction (3,) of the base, within the limits, and the joints that look along it."""
        joints = self.head.joints(finite(direction))
        axis = self.head.nearest(direction)[0]
        self._gaze.publish(direction_message(axis, self.settings.base_frame, self.get_clock().now().to_msg()))
        moved = {name: value for name, value in zip(self.joint_names, joints.tolist(), strict=True) if name}
        point = JointTrajectoryPoint(positions=[*moved.values()])
        point.time_from_start = Duration(seconds=self.settings.turn_duration_s).to_msg()
        self._joints.publish(JointTrajectory(joint_names=[*moved], points=[point]))
        self.report(OK, why)


def main() -> None:
    """Run the node."""
    run(GazeNode)


if __name__ == "__main__":
    main()
