"""Localizes a camera in a map of `wheretolook export --localize`; publishes poses that are probable enough, else why not.

Topics and parameters: docs/robots.md.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, Vector3Stamped
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.qos import QoSPresetProfiles, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState
from std_srvs.srv import Trigger

from wheretolook_ros.conversions import (
    Array,
    compose,
    direction_message,
    grey_image,
    inverse,
    moved_covariance,
    pinhole_of,
    pose_matrix,
    pose_message,
    pose_numbers,
    pose_of_numbers,
    seconds,
)
from wheretolook_ros.head import Timeline
from wheretolook_ros.node import ERROR, OK, WARN, RobotNode, run

WAIT_S = 0.5  # for odometry and joint states that are not older than the image


class LocalizerNode(RobotNode):
    """Localizes the newest image; by odometry jointly with those before it from the same location."""

    def __init__(self) -> None:
        super().__init__("visual_localization")
        self._image: Image | CompressedImage | None = None
        self._pending = False
        self._waiting: Image | CompressedImage | None = None
        self._arrived = time.monotonic()
        self._info: CameraInfo | None = None
        self._prior: list[float] | None = None
        self._odometry = Timeline()
        self._joints = Timeline()
        self._last_stamp = -np.inf
        self._scorer: Any = None
        package = "wheretolook_localization"
        self._usable = self.open_folder(self._open, package, f"{package}.geometry.camera", "wheretolook_robot")
        self._poses = self.create_publisher(PoseWithCovarianceStamped, "visual_localization/pose", 10)
        self._looks = self.create_publisher(Vector3Stamped, "visual_localization/next_look", 10)
        sensor = QoSPresetProfiles.get_from_short_key(self.settings["image_qos"])
        self.create_subscription(Image, "image", self._on_image, sensor)
        self.create_subscription(CompressedImage, "image/compressed", self._on_image, sensor)
        self.create_subscription(CameraInfo, "camera_info", self._on_info, sensor)
        every = QoSProfile(depth=500, reliability=ReliabilityPolicy.BEST_EFFORT)  # while an image is localized
        self.create_subscription(Odometry, "odom", self._on_odometry, every)
        self.create_subscription(JointState, "joint_states", self._on_joints, every)
        self.create_subscription(PoseWithCovarianceStamped, "initialpose", self._on_prior, 10)
        self.create_service(Trigger, "visual_localization/trigger_localization", self._on_trigger)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # a simulated clock may stand still
        self.create_timer(0.01, self._poll, clock=steady)
        self.create_timer(1.0, self._watch, clock=steady)

    def _open(self, package: Any, camera: Any, robot: Any) -> None:
        folder = self.settings["folder"]
        localizer = package.RobotLocalizer(folder, self.settings["turn_noise_deg"], in_world=True)
        accuracy = self.settings["accuracy_m"], self.settings["accuracy_deg"]
        views = self.settings["max_views"], self.settings["max_move_m"]
        self._sequence = package.ImageSequence(localizer, self.settings["confidence"], accuracy, *views)
        self._pinhole = camera.PinholeCamera
        if self.settings["next_look"]:
            self._scorer = robot.RobotScorer(folder)

    def _on_image(self, message: Image | CompressedImage) -> None:
        self._image = message
        self._pending = self.settings["enable_continuous_localization"]
        self._arrived = time.monotonic()

    def _on_info(self, message: CameraInfo) -> None:
        self._info = message

    def _on_odometry(self, message: Odometry) -> None:
        self._add(self._odometry, message, pose_numbers(message.pose.pose), "odometry")

    def _on_joints(self, message: JointState) -> None:
        known = dict(zip(message.name, message.position, strict=False))
        if known.keys() >= {*self.joint_names}:
            self._add(self._joints, message, np.array([known[name] for name in self.joint_names]), "joint states")

    def _add(self, timeline: Timeline, message: Odometry | JointState, values: Array, name: str) -> None:
        if not np.isfinite(values).all():
            self.report(WARN, f"{name} are not finite, or a quaternion is 0")
        elif not timeline.add(seconds(message.header.stamp), values):
            self._restart(f"the time of {name} jumped back")

    def _restart(self, reason: str) -> None:
        """Forget earlier images and positions."""
        self.report(WARN, f"{reason}: earlier images are forgotten")
        self._last_stamp = -np.inf
        if self._usable:
            self._sequence.reset()

    def _on_prior(self, message: PoseWithCovarianceStamped) -> None:
        try:
            self.check_frame(message, "map_frame")
            camera = compose(pose_matrix(message.pose.pose), self.head.base_from_camera(0.0, 0.0))
        except ValueError as error:
            self.report(WARN, f"an initial pose cannot be used: {error}")
            return
        self._prior = camera[:, 3].tolist()  # where the head looks is known from an image at the earliest
        if self._usable:
            self._sequence.reset()

    def _on_trigger(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._image is None:
            response.message = "no image has arrived"
        else:
            self._pending = False
            response.success, response.message = self._localize(self._image)
        return response

    def _poll(self) -> None:
        """Localize the newest image, once odometry and joint states up to its time have arrived.

        Newer images wait meanwhile: each could be newer than the odometry.
        """
        if self._waiting is None and self._pending:
            self._waiting = self._image
            self._pending = False
            self._since = time.monotonic()
        if self._waiting is None:
            return
        stamp = seconds(self._waiting.header.stamp)
        late = [line for line in (self._odometry, self._joints) if line.times and line.times[-1] < stamp]
        if not late or time.monotonic() - self._since > WAIT_S:
            self._localize(self._waiting)

    def _watch(self) -> None:
        """Report that no image arrives."""
        silence = time.monotonic() - self._arrived
        if not self._usable:
            self.report(*self.reported)
        elif silence > self.settings["image_timeout_s"]:
            self.report(ERROR, "no image arrives", seconds=round(silence))

    def _localize(self, message: Image | CompressedImage) -> tuple[bool, str]:
        """Localize an image, publish the pose or report why there is none; returns whether it is confident."""
        self._waiting = None
        if not self._usable:
            return False, self.reported[1]
        stamp = seconds(message.header.stamp)
        if stamp < self._last_stamp:
            self._restart(f"the time of images jumped back by {self._last_stamp - stamp:.2f} s")
        self._last_stamp = stamp
        started = time.monotonic()
        try:
            view, problem = self._matched(message)
            base_from_camera, camera_from_odom = self._camera_at(stamp)
            result = self._sequence.add(view, camera_from_odom)
            best = result.localization
            confident = best.probability >= self.settings["confidence"]
            if confident:
                self._prior = None
                self._publish(best.poses[0], base_from_camera, message)
            else:
                problem = result.reason + self._ask(best, base_from_camera, message)
        except Exception as error:  # whatever one image holds, the next one is localized
            self.report(ERROR, f"an image cannot be localized: {error}")
            return False, str(error)
        finally:
            self._arrived = time.monotonic()
        problem = "; ".join(filter(None, (problem, result.contradiction)))
        self.report(
            WARN if problem else OK,
            problem or "localized",
            image=f"{stamp:.6f}",
            probabilities=[round(pose.probability, 4) for pose in best.poses],
            n_matches=best.joint.n_matches,
            n_inliers=best.joint.n_inliers,
            n_views=result.n_views,
            odometry=camera_from_odom is not None,
            seconds=f"{self._arrived - started:.3f}",
        )
        return confident, problem or "localized"

    def _matched(self, message: Image | CompressedImage) -> tuple[Any, str]:
        """Match an image with the map; also returns what is unusual about its camera. Raises ValueError."""
        if self._info is None:
            raise ValueError("no CameraInfo has arrived")
        grey = grey_image(message)
        if grey.shape != (self._info.height, self._info.width):
            size = f"{self._info.width} x {self._info.height}"
            raise ValueError(f"the image has {grey.shape[1]} x {grey.shape[0]} px, its CameraInfo {size}")
        matrix, to_pinhole = pinhole_of(self._info, self.settings["rectified"])
        (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
        camera = self._pinhole(*grey.shape[::-1], fx, fy, (cx, cy))
        localizer = self._sequence.localizer
        pixels, descriptors = localizer.extract(grey)
        view = localizer.match(to_pinhole(pixels), descriptors, camera, self._prior)
        return view, localizer.difference(camera)

    def _camera_at(self, stamp: float) -> tuple[Array, Array | None]:
        """Poses (3, 4) of the camera in the base and of odometry in the camera, None if that is unknown then."""
        joints: Any = self._joints.at(stamp) if any(self.joint_names) else (0.0, 0.0)
        if joints is None:
            raise ValueError(f"no joint states of {self.joint_names} at the time of the image")
        base_from_camera = self.head.base_from_camera(*joints)
        base = self._odometry.at(stamp)
        if base is None:
            return base_from_camera, None
        return base_from_camera, inverse(compose(pose_of_numbers(base), base_from_camera))

    def _publish(self, pose: Any, base_from_camera: Array, image: Image | CompressedImage) -> None:
        """Publish the pose of the base in the map."""
        map_from_camera = inverse(pose.cam_from_world)
        map_from_base = compose(map_from_camera, inverse(base_from_camera))
        lever = map_from_base[:, 3] - map_from_camera[:, 3]
        message = PoseWithCovarianceStamped()
        message.header.stamp = image.header.stamp
        message.header.frame_id = self.settings["map_frame"]
        message.pose.pose = pose_message(map_from_base)
        message.pose.covariance = moved_covariance(pose.covariance, lever).ravel().tolist()
        self._poses.publish(message)

    def _ask(self, best: Any, base_from_camera: Array, image: Image | CompressedImage) -> str:
        """Publish the next view, as a direction in the base; returns what prevents it."""
        if self._scorer is None:
            return ""
        pitch = np.negative(self.head.tilt_deg[::-1])
        pan = np.degrees(self.head.joints(base_from_camera[:, 2])[0])
        limits = np.subtract(self.head.pan_deg, pan)
        try:
            chosen = self._sequence.localizer.next_look(best, self._scorer, pitch, limits, base_from_camera[2, :3])
        except Exception as error:  # such as limits that leave no further view
            return f"; no next view: {error}"
        axis = base_from_camera[:, :3] @ chosen.cam_from_rig[2]
        self._looks.publish(direction_message(axis, self.settings["base_frame"], image.header.stamp))
        return ""


def main() -> None:
    """Run the node."""
    run(LocalizerNode)


if __name__ == "__main__":
    main()
