"""Nodes that are started for one test: the service, folders of another version, the gaze, signals."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed: pip install '.[ros]'")

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Vector3Stamped
from nav_msgs.msg import Path as PathMessage
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from wheretolook_ros.conversions import Array, compose, inverse, pose_matrix, pose_message
from wheretolook_ros.head import Timeline

from ros.processes import CAMERA, HEAD, JOINTS, Robot, base_at, environment, image_of, info_of, running
from ros.room import room_mesh, write_folder
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.robot.wheretolook_robot import RobotScorer

BASE = base_at(3.2, 2.4, 30.0)
LOCALIZER = "wheretolook_ros.localizer"
GAZE = "wheretolook_ros.gaze"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(room_mesh(), tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="module", autouse=True)
def context() -> Iterator[None]:
    os.environ.update(environment())
    rclpy.init()
    yield
    rclpy.try_shutdown()


@pytest.fixture
def node() -> Iterator[Robot]:
    robot = Robot(WarpRenderer(room_mesh()))
    yield robot
    robot.destroy_node()


def within_limits(axes: Array) -> Array:
    """Which directions a base along x allows within 60 and 20 degrees."""
    pan = np.degrees(np.arctan2(axes[:, 1], axes[:, 0]))
    tilt = np.degrees(np.arcsin(axes[:, 2]))
    return (np.abs(pan) <= 60) & (np.abs(tilt) <= 20)


def test_localizing_on_request(node: Robot, folder: Path) -> None:
    with running(LOCALIZER, {"folder": folder, "enable_continuous_localization": "false"}, signal.SIGINT):
        node.connected("image", "camera_info", "joint_states")
        client = node.create_client(Trigger, "visual_localization/trigger_localization")
        assert client.wait_for_service(30)

        def trigger() -> Trigger.Response:
            future = client.call_async(Trigger.Request())
            return node.wait(lambda: future.done() and future.result(), "an answer")

        assert trigger() == Trigger.Response(success=False, message="no image has arrived")
        node.send("camera_info", info_of(CAMERA))
        node.send("joint_states", JointState(name=JOINTS, position=[0.0, 0.0]))
        node.send("image", image_of(node.rgb(BASE)))
        for _ in range(20):
            rclpy.spin_once(node, timeout_sec=0.05)
        assert node.last("visual_localization/pose") is None
        answer = trigger()
        assert answer.success and answer.message == "localized"
        found = node.wait(lambda: node.last("visual_localization/pose"), "a pose")
        np.testing.assert_allclose(pose_matrix(found.pose.pose), BASE, atol=0.02)


@pytest.mark.parametrize("damage", ["format", "no scores", "missing"])
def test_a_folder_of_another_version(node: Robot, folder: Path, tmp_path: Path, damage: str) -> None:
    old = tmp_path / "old"
    if damage != "missing":
        shutil.copytree(folder, old)
        about = json.loads((old / "robot.json").read_text())
        if damage == "format":
            (old / "robot.json").write_text(json.dumps(about | {"format_version": 9}))
        else:
            shutil.rmtree(old / "wheretolook_localization" / "looks")
    with running(LOCALIZER, {"folder": old}), running(GAZE, {"folder": old}, signal.SIGINT):
        node.connected("image", "plan")
        for name in ("visual_localization", "gaze"):
            node.send("image", image_of(np.zeros((4, 4, 3), np.uint8)))
            node.send("plan", PathMessage(poses=[PoseStamped()]))
            status = node.wait(lambda name=name: node.status(name), f"diagnostics of {name}")
            assert status.level in (DiagnosticStatus.ERROR, DiagnosticStatus.WARN)
            said = str(status.message)
            if name == "visual_localization":
                assert "the robot's folder" in said and ("Export" in said or "No module" in said), said


@pytest.mark.parametrize("setting", ["confidence:=abc", "mount:=[1]"])
def test_a_parameter_of_another_type_ends_the_node_with_its_name(setting: str) -> None:
    command = [sys.executable, "-m", GAZE, "--ros-args", "-p", setting]
    if "confidence" in setting:
        command[2] = LOCALIZER
    ended = subprocess.run(command, env=os.environ | environment(), capture_output=True, text=True, timeout=30)
    assert ended.returncode == 1 and "Traceback" not in ended.stderr
    assert setting.split(":")[0] in ended.stderr and "expecting type" in ended.stderr


@pytest.mark.parametrize(("setting", "value"), [("confidence", 0.0), ("confidence", 2.0), ("max_views", 0)])
def test_a_setting_that_makes_no_sense_is_reported(node: Robot, folder: Path, setting: str, value: float) -> None:
    with running(LOCALIZER, {"folder": folder, setting: value}):
        status = node.wait(node.status, "diagnostics")
        assert status.level == DiagnosticStatus.ERROR and str(value) in status.message


def test_values_are_interpolated_and_never_extrapolated() -> None:
    """A head that turned since its last state would turn the base."""
    line = Timeline()
    assert line.at(0.0) is None
    for time, value in ((0.0, 0.0), (0.1, 1.0), (0.4, 2.0)):
        assert line.add(time, np.array([value]))
    np.testing.assert_allclose(line.at(0.05), [0.5])
    np.testing.assert_allclose(line.at(0.404), [2.0])
    assert line.at(0.45) is None and line.at(0.2) is None and line.at(-0.2) is None
    assert not line.add(0.3, np.array([0.0])) and line.times == [0.3]


def test_the_gaze(node: Robot, folder: Path) -> None:
    scorer = RobotScorer(folder)
    limits = {"pan_limits_deg": "[-60.0, 60.0]", "tilt_limits_deg": "[-20.0, 20.0]"}
    with running(GAZE, {"folder": folder, "directions": 400} | limits):
        node.connected("plan")
        poses = node.create_publisher(PoseWithCovarianceStamped, "visual_localization/pose", 10)
        looks = node.create_publisher(Vector3Stamped, "visual_localization/next_look", 10)
        node.senders |= {"pose": poses, "look": looks}
        for publisher in (poses, looks):
            node.wait(lambda publisher=publisher: publisher.get_subscription_count() > 0, "the gaze node")
        for base in (BASE, base_at(2.0, 3.0, -100.0)):
            message = PoseWithCovarianceStamped()
            message.header.frame_id = "map"
            message.pose.pose = pose_message(base)
            node.received.clear()
            node.send("pose", message)
            trajectory = node.wait(lambda: node.last("joint_trajectory"), "a trajectory")
            assert trajectory.joint_names == ["pan", "tilt"]
            pan, tilt = trajectory.points[0].positions
            assert abs(pan) <= np.radians(60) + 1e-9 and abs(tilt) <= np.radians(20) + 1e-9
            camera = compose(base, HEAD.base_from_camera(pan, tilt))
            chosen = scorer.score(inverse(camera))[0]
            grid = [(a, b) for a in np.linspace(-1, 1, 9) for b in np.linspace(-0.3, 0.3, 5)]
            others = [scorer.score(inverse(compose(base, HEAD.base_from_camera(*joints))))[0] for joints in grid]
            assert chosen >= np.max(others) - 0.02
        look = Vector3Stamped()
        look.header.frame_id = "base_link"
        look.vector.x = np.cos(0.5)
        look.vector.y = np.sin(0.5)
        node.received.clear()
        node.send("look", look)
        found = node.wait(lambda: node.last("joint_trajectory"), "a trajectory")
        np.testing.assert_allclose(found.points[0].positions, (0.5, 0.0), atol=1e-9)
        look.header.frame_id = "elsewhere"
        node.send("look", look)
        node.wait(
            lambda: "its frame is 'elsewhere', not 'base_link'" in getattr(node.status("gaze"), "message", ""),
            "a warning",
        )

        path = PathMessage()
        path.header.frame_id = "map"
        stops = np.column_stack([np.linspace(1.5, 4.5, 31), np.full(31, 2.5)])
        for x, y in stops:
            path.poses.append(PoseStamped(pose=pose_message(base_at(x, y, 0.0))))
        node.received.clear()
        node.send("plan", path)
        views = node.wait(lambda: node.last("gaze/views"), "views along the path")
        cameras = np.array([pose_matrix(view.pose) for view in views.poses])
        assert views.header.frame_id == "map" and len(cameras) == 7
        np.testing.assert_allclose(
            cameras[:, :, 3], [(x + 0.1, 2.5, 1.2) for x in np.arange(1.5, 4.51, 0.5)], atol=1e-6
        )
        axes = cameras[:, :, 2]
        assert within_limits(axes).all()
        assert np.degrees(np.arccos(np.clip((axes[1:] * axes[:-1]).sum(1), -1, 1))).max() <= 60
