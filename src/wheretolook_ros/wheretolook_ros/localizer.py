"""Localizes a camera in a map of `wheretolook export --localize`; publishes poses that are probable enough, else why not.

Topics and parameters: docs/robots.md.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped, Vector3Stamped
from nav_msgs.msg import Odometry
from rclpy.qos import QoSPresetProfiles, QoSProfile, ReliabilityPolicy
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState
from std_srvs.srv import Trigger

from wheretolook.geometry.poses import compose_poses, invert_poses
from wheretolook.robot.localizer import ImageSequence, RobotLocalizer
from wheretolook.robot.wheretolook_robot import RobotScorer
from wheretolook_ros.conversions import (
    Array,
    direction_message,
    grey_image,
    moved_covariance,
    pinhole_of,
    pose_matrix,
    pose_message,
    seconds,
    transform_message,
)
from wheretolook_ros.head import Timeline
from wheretolook_ros.node import ERROR, OK, STEADY, WARN, RobotNode, run

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # no wheel of ROS has it
    TFMessage = None

AnyImage: TypeAlias = Image | CompressedImage
WAIT_S = 0.5  # for odometry and joint states that are not older than the image


class LocalizerNode(RobotNode):
    """Localizes the newest image; by odometry jointly with those before it from the same location."""

    def __init__(self) -> None:
        super().__init__("visual_localization")
        self._image: AnyImage | None = None  # the newest
        self._pending: AnyImage | None = None  # the newest, until it is its turn
        self._waiting: AnyImage | None = None  # for odometry and joint states
        self._arrived = time.monotonic()
        self._info: CameraInfo | None = None
        self._prior: list[float] | None = None
        self._odometry = Timeline()
        self._joints = Timeline()
        self._last_stamp = -np.inf
        self._scorer: RobotScorer | None = None
        self._map_from_odom: TransformStamped | None = None
        if not self.open_folder(self._open):
            return
        self._poses = self.create_publisher(PoseWithCovarianceStamped, "visual_localization/pose", 10)
        self._looks = self.create_publisher(Vector3Stamped, "visual_localization/next_look", 10)
        sensor = QoSPresetProfiles.get_from_short_key(self.settings.image_qos)
        self.listen(Image, "image", self._on_image, sensor)
        self.listen(CompressedImage, "image/compressed", self._on_image, sensor)
        self.listen(CameraInfo, "camera_info", self._on_info, sensor)
        every = QoSProfile(depth=500, reliability=ReliabilityPolicy.BEST_EFFORT)  # while an image is localized
        self.listen(Odometry, "odom", self._on_odometry, every)
        if any(self.joint_names):
            self.listen(JointState, "joint_states", self._on_joints, every)
        self.listen(PoseWithCovarianceStamped, "initialpose", self._on_prior)
        self.create_service(Trigger, "visual_localization/trigger_localization", self._on_trigger)
        self.create_timer(0.01, self._poll, clock=STEADY)
        self.create_timer(1.0, self._watch, clock=STEADY)
        if self.settings.publish_tf:
            topic = "visual_localization/map_from_odom" if TFMessage is None else "/tf"
            self._transforms = self.create_publisher(TFMessage or TransformStamped, topic, 10)
            self.create_timer(0.05, self._send_transform, clock=STEADY)

    def _open(self, folder: Path) -> None:
        given = self.settings
        localizer = RobotLocalizer(folder, given.turn_noise_deg, in_world=True)
        accuracy = given.accuracy_m, given.accuracy_deg
        limits = given.confidence, accuracy, given.max_views, given.max_move_m
        self._sequence = ImageSequence(localizer, *limits)
        if given.next_look:
            self._scorer = RobotScorer(folder)

    def _on_image(self, message: AnyImage) -> None:
        self._image = message
        if self.settings.enable_continuous_localization:
            self._pending = message
        self._arrived = time.monotonic()

    def _on_info(self, message: CameraInfo) -> None:
        self._info = message

    def _on_odometry(self, message: Odometry) -> None:
        if self.settings.publish_tf:  # else the transform would be of other frames
            self.check_frame(message, "odom_frame")
            child, expected = message.child_frame_id, self.settings.base_frame
            if child != expected:
                raise ValueError(f"child frame is {child!r}, expected {expected!r}")
        self._odometry.add(message.header.stamp, pose_matrix(message.pose.pose).ravel())

    def _on_joints(self, message: JointState) -> None:
        positions = dict(zip(message.name, message.position, strict=False))
        if positions.keys() >= {*filter(None, self.joint_names)}:
            joints = zip(self.joint_names, self.head.rest, strict=True)
            self._joints.add(message.header.stamp, np.array([positions.get(name, rest) for name, rest in joints]))

    def _on_prior(self, message: PoseWithCovarianceStamped) -> None:
        self.check_frame(message, "map_frame")
        # where the head looks is known from an image at the earliest
        self._prior = (pose_matrix(message.pose.pose) @ self.head.location).tolist()
        self._sequence.reset()

    def _on_trigger(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._image is None:
            response.message = "no image received yet"
        else:
            self._pending = None
            response.success, response.message = self._localize(self._image)
        return response

    def _poll(self) -> None:
        """Localize the newest image, once odometry and joint states up to its time have arrived.

        Newer images wait meanwhile: each could be newer than the odometry.
        """
        if self._waiting is None:
            self._waiting, self._pending = self._pending, None
            self._since = time.monotonic()
        if self._waiting is None:
            return
        stamp = seconds(self._waiting.header.stamp)
        late = any(-np.inf < line.end() < stamp for line in (self._odometry, self._joints))
        if not late or time.monotonic() - self._since > WAIT_S:
            self._localize(self._waiting)

    def _watch(self) -> None:
        """Report that no image arrives."""
        longest = self.settings.image_timeout_s
        if time.monotonic() - self._arrived > longest:
            self.report(ERROR, f"no images received for {longest:g} s")

    def _localize(self, message: AnyImage) -> tuple[bool, str]:
        """Localize an image, publish the pose or report why there is none; returns whether it is confident."""
        self._waiting = None
        stamp = seconds(message.header.stamp)
        if stamp < self._last_stamp:
            self.report(
                WARN, f"image: time jumped back by {self._last_stamp - stamp:.2f} s; earlier images are discarded"
            )
            self._sequence.reset()
            self._map_from_odom = None
        self._last_stamp = stamp
        started = time.monotonic()
        try:
            view, problem = self._matched(message)
            base_from_camera, camera_from_odom = self._camera_at(stamp)
            result = self._sequence.add(view, camera_from_odom)
            best = result.localization
            confident = best.probability >= self.settings.confidence
            if confident:
                self._prior = None
                self._publish(best.poses[0], base_from_camera, camera_from_odom, message)
            else:
                problem = result.reason + self._ask(best, base_from_camera, message)
        except Exception as error:  # whatever one image holds, the next one is localized
            self.report(ERROR, f"image not localized: {error}", image=f"{stamp:.6f}")
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

    def _matched(self, message: AnyImage) -> tuple[Any, str]:
        """Match an image with the map; also returns what is unusual about its camera. Raises ValueError."""
        if self._info is None:
            raise ValueError("no camera_info received yet")
        grey = grey_image(message, (self._info.width, self._info.height))
        pinhole, to_pinhole = pinhole_of(self._info, self.settings.rectified)
        localizer = self._sequence.localizer
        camera = type(localizer.camera)(*grey.shape[::-1], *pinhole)
        pixels, descriptors = localizer.extract(grey)
        view = localizer.match(to_pinhole(pixels), descriptors, camera, self._prior)
        return view, localizer.difference(camera)

    def _camera_at(self, stamp: float) -> tuple[Array, Array | None]:
        """Poses (3, 4) of the camera in the base and of odometry in the camera, None if that is unknown then."""
        joints: Any = self._joints.at(stamp) if any(self.joint_names) else self.head.rest
        if joints is None:
            raise ValueError(f"no joint_states of {' and '.join(filter(None, self.joint_names))} at its time")
        base_from_camera = self.head.base_from_camera(*joints)
        numbers = self._odometry.at(stamp)
        if numbers is None:
            return base_from_camera, None
        base = numbers.reshape(3, 4)
        base[:, :3] = Rotation.from_matrix(base[:, :3]).as_matrix()  # of an interpolated one the nearest rotation
        return base_from_camera, invert_poses(compose_poses(base, base_from_camera))

    def _send_transform(self) -> None:
        """Publish the last known pose of odometry in the map with the present time."""
        if self._map_from_odom is not None:
            self._map_from_odom.header.stamp = self.get_clock().now().to_msg()
            sent = self._map_from_odom if TFMessage is None else TFMessage(transforms=[self._map_from_odom])
            self._transforms.publish(sent)

    def _publish(self, pose: Any, base_from_camera: Array, camera_from_odom: Array | None, image: AnyImage) -> None:
        """Publish the pose of the base in the map, and keep that of odometry if it is known."""
        map_from_camera = invert_poses(pose.cam_from_world)
        if camera_from_odom is not None:
            transform = transform_message(compose_poses(map_from_camera, camera_from_odom))
            self._map_from_odom = TransformStamped(transform=transform, child_frame_id=self.settings.odom_frame)
            self._map_from_odom.header.frame_id = self.settings.map_frame
        map_from_base = compose_poses(map_from_camera, invert_poses(base_from_camera))
        lever = map_from_base[:, 3] - map_from_camera[:, 3]
        message = PoseWithCovarianceStamped()
        message.header.stamp = image.header.stamp
        message.header.frame_id = self.settings.map_frame
        message.pose.pose = pose_message(map_from_base)
        message.pose.covariance = moved_covariance(pose.covariance, lever).ravel().tolist()
        self._poses.publish(message)

    def _ask(self, best: Any, base_from_camera: Array, image: AnyImage) -> str:
        """Publish the next view, as a direction in the base; returns what prevents it."""
        if self._scorer is None:
            return ""
        pan, tilt = self.head.searched_deg
        turns = pan - np.degrees(self.head.joints(base_from_camera[:, 2])[0])
        try:
            chosen = self._sequence.localizer.next_look(best, self._scorer, -tilt[::-1], turns, base_from_camera[2, :3])
        except Exception as error:  # such as limits that leave no further view
            return f"; no next view: {error}"
        axis = self.head.nearest(base_from_camera[:, :3] @ chosen.cam_from_rig[2])[0]
        self._looks.publish(direction_message(axis, self.settings.base_frame, image.header.stamp))
        return ""


def main() -> None:
    """Run the node."""
    run(LocalizerNode)


if __name__ == "__main__":
    main()
