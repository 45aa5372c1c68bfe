"""Starts nodes in processes of their own, and talks to them from the test's."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, Vector3Stamped
from nav_msgs.msg import Odometry, Path as PathMessage
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState
from trajectory_msgs.msg import JointTrajectory
from wheretolook_ros.conversions import pose_matrix, pose_message
from wheretolook_ros.head import Head

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import compose_poses, invert_poses, pose_error

ROOT = Path(__file__).parents[2]
HEAD = Head((0.1, 0.0, 1.2, 0.0, 0.0, 0.0))
SETTINGS = {
    "image_qos": "system_default",
    "mount": "[0.1, 0.0, 1.2, 0.0, 0.0, 0.0]",
    "pan_joint": "pan",
    "tilt_joint": "tilt",
}
JOINTS = ["pan", "tilt"]
CAMERA = PinholeCamera()
TIMEOUT_S = 60.0  # of a machine that does other work
RESEND_S = 5.0


def environment():
    """Variables of all processes of a test run: a domain of their own, on this machine only."""
    path = os.pathsep.join([str(ROOT / "src"), str(ROOT / "src" / "wheretolook_ros"), str(ROOT / "tests")])
    domain = {"ROS_DOMAIN_ID": str(os.getpid() % 100 + 1), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    domain["FASTDDS_DEFAULT_PROFILES_FILE"] = str(Path(__file__).with_name("fastdds.xml"))
    return domain | {"PYTHONPATH": path}


@contextmanager
def running(module, settings, stop=signal.SIGTERM):
    """Run a module, or a file, with parameters; at the end it must stop by the signal, without an error."""
    program = [module] if module.endswith(".py") else ["-m", module]
    options = [word for name, value in (SETTINGS | settings).items() for word in ("-p", f"{name}:={value}")]
    command = [sys.executable, *program, "--ros-args", *options]
    with tempfile.TemporaryFile("w+") as errors:  # a pipe that nobody reads would stop the node when it is full
        process = subprocess.Popen(command, env=os.environ | environment(), stderr=errors, text=True)

        def said():
            errors.seek(0)
            return errors.read()

        try:
            yield process
            assert process.poll() is None, f"{module} ended: {said()}"
        except BaseException:
            process.kill()
            process.wait()
            print(said())
            raise
        process.send_signal(stop)
        process.wait(timeout=20)
        assert process.returncode == 0 and "Traceback" not in said(), (process.returncode, said())


class Robot(Node):
    """The test's side: publishes what a robot does, and keeps what the nodes answer."""

    def __init__(self, renderer=None):
        super().__init__("robot")
        self.renderer = renderer
        self.stamp = 100.0
        self.joints = JOINTS
        self.odom_frame = "odom"
        types = {"image": Image, "image/compressed": CompressedImage, "camera_info": CameraInfo}
        types |= {"odom": Odometry, "joint_states": JointState}
        self.senders = {name: self.create_publisher(kind, name, 10) for name, kind in types.items()}
        self.senders["initialpose"] = self.create_publisher(PoseWithCovarianceStamped, "initialpose", 10)
        self.senders["plan"] = self.create_publisher(PathMessage, "plan", 10)
        self.received = []
        heard = {"visual_localization/pose": PoseWithCovarianceStamped, "/diagnostics": DiagnosticArray}
        heard |= {"visual_localization/next_look": Vector3Stamped, "joint_trajectory": JointTrajectory}
        heard |= {"gaze/views": PathMessage, "gaze/direction": Vector3Stamped}
        for name, kind in heard.items():
            self.create_subscription(kind, name, lambda message, name=name: self.received.append((name, message)), 50)

    def wait(self, found, what):
        """Spin until something is found, and return it."""
        end = time.monotonic() + TIMEOUT_S
        while time.monotonic() < end:
            rclpy.spin_once(self, timeout_sec=0.05)
            value = found()
            if value:
                return value
        raise AssertionError(f"timeout: {what}; received {[(name, str(m)[:300]) for name, m in self.received[-6:]]}")

    def connected(self, *topics):
        """Wait until nodes listen to what this one publishes."""
        senders = [self.senders[topic] for topic in topics]
        self.wait(lambda: all(sender.get_subscription_count() for sender in senders), f"subscribers of {topics}")

    def last(self, topic):
        """The last message of a topic, None without."""
        return next((message for name, message in reversed(self.received) if name == topic), None)

    def published(self, topic):
        """Wait for a message of a topic, and return the last one."""
        return self.wait(lambda: self.last(topic), topic)

    def reported(self, text, node="visual_localization"):
        """Wait until the diagnostics of a node hold a text."""
        self.wait(lambda: any(text in status.message for status in self.statuses(node)), text)

    def localized(self, base, error_m=0.02, error_deg=0.3):
        """Assert that the published pose of the base is right."""
        found = pose_matrix(self.published("visual_localization/pose").pose.pose)
        position, angle = pose_error(invert_poses(found), invert_poses(base))
        assert position < error_m and angle < error_deg, (position, angle)

    def status(self, node="visual_localization"):
        """The last diagnostics of a node."""
        return next(reversed(self.statuses(node)), None)

    def statuses(self, node="visual_localization"):
        """All diagnostics of a node."""
        reports = [message.status[0] for name, message in self.received if name == "/diagnostics"]
        return [status for status in reports if status.name == node]

    def send(self, topic, message, stamp=None):
        """Publish with a stamp, by default the present one."""
        now = self.stamp if stamp is None else stamp
        message.header.stamp.sec = int(now)
        message.header.stamp.nanosec = round(now % 1 * 1e9)
        self.senders[topic].publish(message)

    def ask(self, topic, message, *answers):
        """Publish a message until a node answers on other topics; returns the last answer on each.

        The first answers can be lost: a node may discover this one's subscription after its own is discovered.
        """
        self.received.clear()
        sent = 0.0

        def answered():
            nonlocal sent
            if time.monotonic() - sent > RESEND_S:
                self.send(topic, message)
                sent = time.monotonic()
            found = [self.last(answer) for answer in answers]
            return None if None in found else found

        return self.wait(answered, f"{answers}")

    def rgb(self, base, pan=0.0, tilt=0.0, camera=CAMERA):
        """Render what the camera sees."""
        assert self.renderer is not None
        pose = invert_poses(compose_poses(base, HEAD.base_from_camera(pan, tilt)))
        return np.ascontiguousarray(self.renderer.render(camera, pose[None]).rgb[0], dtype=np.uint8)

    def see(self, message, info=None, odometry=None, joints=(0.0, 0.0), step_s=1.0):
        """Publish an image with what belongs to its time; returns the diagnostics of this image.

        All of it is sent again if some did not arrive: a node may discover this one's publishers after its own
        subscriptions are discovered, and sensor QoS may drop an image.
        """
        self.stamp += step_s
        self.received.clear()
        sent = 0.0
        stamp = f"{self.stamp:.6f}"
        lost = ("no joint_states", *(["no camera_info"] if info is not None else []))

        def send():
            nonlocal sent
            self.send("joint_states", JointState(name=self.joints, position=list(joints)))
            if odometry is not None:
                odom = Odometry(child_frame_id="base_link")
                odom.header.frame_id = self.odom_frame
                odom.pose.pose = pose_message(odometry)
                self.send("odom", odom)
            if info is not None:
                self.send("camera_info", info)
                time.sleep(0.2)
            self.send("image/compressed" if isinstance(message, CompressedImage) else "image", message)
            sent = time.monotonic()

        def answered():
            if time.monotonic() - sent > RESEND_S:
                send()
            reports = self.statuses()
            status = next((report for report in reports if KeyValue(key="image", value=stamp) in report.values), None)
            if status and any(text in status.message for text in lost):
                self.received.clear()
                send()
                return None
            return status

        return self.wait(answered, "diagnostics")


def info_of(camera):
    """The CameraInfo of a pinhole."""
    info = CameraInfo(width=camera.width, height=camera.height, distortion_model="plumb_bob", d=[0.0] * 5)
    matrix = camera.matrix
    matrix[:2, 2] -= 0.5
    info.k = matrix.ravel().tolist()
    info.p = np.column_stack([matrix, np.zeros(3)]).ravel().tolist()
    return info


def image_of(pixels, encoding="rgb8"):
    """An image (H, W) or (H, W, C) uint8 as a message, with rows padded by four bytes."""
    rows = np.pad(pixels.reshape(len(pixels), -1), ((0, 0), (0, 4)))
    image = Image(height=pixels.shape[0], width=pixels.shape[1], encoding=encoding, step=rows.shape[1])
    image.data = rows.tobytes()
    return image


def base_at(x, y, yaw_deg):
    """A base on the floor."""
    cosine = np.cos(np.radians(yaw_deg))
    sine = np.sin(np.radians(yaw_deg))
    return np.array([[cosine, -sine, 0, x], [sine, cosine, 0, y], [0, 0, 1, 0]])


def mosaic(rgb, first):
    """A Bayer image (H, W) with the pattern rggb or gbrg."""
    pattern = {"rggb": (0, 1, 1, 2), "gbrg": (1, 2, 0, 1)}[first]
    out = np.empty(rgb.shape[:2], dtype=np.uint8)
    for k, channel in enumerate(pattern):
        out[k // 2 :: 2, k % 2 :: 2] = rgb[k // 2 :: 2, k % 2 :: 2, channel]
    return out


def jpeg_of(rgb):
    """A compressed image."""
    return CompressedImage(format="rgb8; jpeg compressed bgr8", data=cv2.imencode(".jpg", rgb[:, :, ::-1])[1].tobytes())
