"""A robot with a camera on a pan-tilt head in a scene that is rendered on the CPU; its odometry drifts.

    python simulated_robot.py --ros-args -p mesh:=scene.glb -p pan_joint:=pan -p tilt_joint:=tilt

It takes `place` (PoseStamped: where the base is), `joint_trajectory` and `plan` (which it drives along), and publishes
`image`, `camera_info`, `odom`, `joint_states`, and `ground_truth`, the true pose of the camera for each image.
"""

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry, Path
from rclpy.clock import Clock, ClockType
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import CameraInfo, Image, JointState
from trajectory_msgs.msg import JointTrajectory
from wheretolook_ros.conversions import pose_matrix, pose_message
from wheretolook_ros.node import RobotNode, run

from ros.processes import info_of
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import compose_poses, invert_poses
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh

PARAMETERS = {
    "mesh": "scene.glb",
    "rate_hz": 4.0,  # of images, while the head is at rest
    "images_while_turning": False,
    "turn_rate_deg": 180.0,  # of the head
    "speed": 0.5,  # m/s along a path
    "drift": [0.01, 0.01],  # of odometry: share of the distance, and of the rotation
    "simulated_clock": False,
    "seed": 0,
}
TICK_S = 1 / 30


class SimulatedRobot(RobotNode):
    """Renders, moves and measures itself thirty times a second."""

    def __init__(self):
        super().__init__("simulated_robot")
        for known in self.declare_parameters("", list(PARAMETERS.items())):
            setattr(self.settings, known.name, known.value)
        self.camera = PinholeCamera()
        self._renderer = WarpRenderer(load_mesh(self.settings.mesh))
        self._rng = np.random.default_rng(self.settings.seed)
        self._base = None  # in the map
        self._odometry = np.eye(3, 4)
        self._joints = np.zeros(2)
        self._target = np.zeros(2)
        self._route = np.zeros((0, 2))
        self._last_image = -np.inf
        self._time = 1000.0
        self._images = self.create_publisher(Image, "image", 2)
        self._infos = self.create_publisher(CameraInfo, "camera_info", 2)
        self._odometries = self.create_publisher(Odometry, "odom", 100)
        self._states = self.create_publisher(JointState, "joint_states", 100)
        self._truths = self.create_publisher(PoseStamped, "ground_truth", 10)
        self._clocks = self.create_publisher(ClockMessage, "/clock", 10)
        self.create_subscription(PoseStamped, "place", self._on_place, 10)
        self.create_subscription(JointTrajectory, "joint_trajectory", self._on_trajectory, 10)
        self.create_subscription(Path, "plan", self._on_plan, 10)
        self.create_timer(TICK_S, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _on_place(self, message):
        base = pose_matrix(message.pose)
        self._odometry = compose_poses(
            self._odometry, compose_poses(invert_poses(self._base), base) if self._base is not None else base
        )
        self._base = base
        self._route = self._route[:0]
        self._joints = np.zeros(2)
        self._target = np.zeros(2)
        self._last_image = -np.inf

    def _on_trajectory(self, message):
        self._target = np.array(message.points[-1].positions)

    def _on_plan(self, message):
        self._route = np.array([pose_matrix(pose.pose)[:2, 3] for pose in message.poses])

    def _tick(self):
        if self._base is None:
            return
        self._time += TICK_S
        if self.settings.simulated_clock:
            now = Time(seconds=self._time).to_msg()
            self._clocks.publish(ClockMessage(clock=now))
        else:
            now = self.get_clock().now().to_msg()
        step = np.radians(self.settings.turn_rate_deg) * TICK_S
        turning = np.abs(self._target - self._joints).max() > 1e-6
        self._joints += np.clip(self._target - self._joints, -step, step)
        self._drive()
        state = JointState(name=[self.settings.pan_joint, self.settings.tilt_joint], position=self._joints.tolist())
        state.header.stamp = now
        self._states.publish(state)
        odometry = Odometry(child_frame_id=self.settings.base_frame)
        odometry.header.frame_id = "odom"
        odometry.header.stamp = now
        odometry.pose.pose = pose_message(self._odometry)
        self._odometries.publish(odometry)
        due = self._time - self._last_image >= 1 / self.settings.rate_hz - 1e-6
        if due and (not turning or self.settings.images_while_turning):
            self._last_image = self._time
            self._see(now)

    def _drive(self):
        """Move along the route; odometry measures the step with its drift."""
        if len(self._route) == 0 or self._base is None:
            return
        left = self.settings.speed * TICK_S
        at = self._base[:2, 3].copy()
        while len(self._route) and left > 0:
            ahead = self._route[0] - at
            length = float(np.linalg.norm(ahead))
            moved = min(left, length)
            if length > 1e-6:
                heading = np.arctan2(ahead[1], ahead[0])
                at += ahead / length * moved
            left -= moved
            if moved >= length:
                self._route = self._route[1:]
        base = self._base.copy()
        base[:2, 3] = at
        if np.linalg.norm(at - self._base[:2, 3]) > 1e-6:
            cosine = np.cos(heading)
            sine = np.sin(heading)
            base[:2, :2] = [[cosine, -sine], [sine, cosine]]
        step = compose_poses(invert_poses(self._base), base)
        distance_drift, turn_drift = self.settings.drift
        turn = np.arctan2(step[1, 0], step[0, 0]) * turn_drift + self._rng.normal(0, distance_drift) * step[0, 3]
        cosine = np.cos(turn)
        sine = np.sin(turn)
        error = np.array([[cosine, -sine, 0, 0], [sine, cosine, 0, 0], [0, 0, 1, 0]])
        measured = compose_poses(step, error)
        measured[:, 3] *= 1 + distance_drift
        self._odometry = compose_poses(self._odometry, measured)
        self._base = base

    def _see(self, now):
        assert self._base is not None
        map_from_camera = compose_poses(self._base, self.head.base_from_camera(*self._joints))
        rgb = self._renderer.render(self.camera, invert_poses(map_from_camera)[None]).rgb[0]
        info = info_of(self.camera)
        image = Image(height=rgb.shape[0], width=rgb.shape[1], encoding="rgb8", step=3 * rgb.shape[1])
        image.data = np.ascontiguousarray(rgb, dtype=np.uint8).tobytes()
        truth = PoseStamped(pose=pose_message(map_from_camera))
        for message, frame in ((info, "camera"), (truth, self.settings.map_frame), (image, "camera")):
            message.header.stamp = now
            message.header.frame_id = frame
        self._truths.publish(truth)
        self._infos.publish(info)
        self._images.publish(image)


if __name__ == "__main__":
    run(SimulatedRobot)
