"""Nodes that are started for one test: the service, folders of another version, the gaze, signals."""

import json
import os
import shutil
import signal
import subprocess
import sys
from itertools import product

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed: pip install '.[ros]'")

import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, Pose, PoseStamped, PoseWithCovarianceStamped, TransformStamped, Vector3Stamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path as PathMessage
from rcl_interfaces.msg import Log
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from wheretolook_ros.conversions import pose_matrix, pose_message
from wheretolook_ros.head import Head, Timeline

from ros.processes import CAMERA, HEAD, JOINTS, Robot, base_at, environment, image_of, info_of, running
from ros.room import room_mesh
from wheretolook.geometry.poses import compose_poses, invert_poses, pan_tilt_angles
from wheretolook.planning.nav2 import write_mask
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.robot.wheretolook_robot import RobotScorer

BASE = base_at(3.2, 2.4, 30.0)
LOCALIZER = "wheretolook_ros.localizer"
GAZE = "wheretolook_ros.gaze"


@pytest.fixture
def node(context):
    robot = Robot(WarpRenderer(room_mesh()))
    yield robot
    robot.destroy_node()


def test_localizing_on_request(node, folder):
    with running(LOCALIZER, {"folder": folder, "enable_continuous_localization": "false"}, signal.SIGINT):
        node.connected("image", "camera_info", "joint_states")
        client = node.create_client(Trigger, "visual_localization/trigger_localization")
        assert client.wait_for_service(30)

        def trigger():
            future = client.call_async(Trigger.Request())
            return node.wait(lambda: future.done() and future.result(), "an answer")

        assert trigger() == Trigger.Response(success=False, message="no image received yet")
        node.send("camera_info", info_of(CAMERA))
        node.send("joint_states", JointState(name=JOINTS, position=[0.0, 0.0]))
        node.send("image", image_of(node.rgb(BASE)))
        for _ in range(20):
            rclpy.spin_once(node, timeout_sec=0.05)
        assert node.last("visual_localization/pose") is None
        answer = trigger()
        assert answer.success and answer.message == "localized"
        node.localized(BASE)


@pytest.mark.parametrize("damage", ["format", "no scorer", "missing"])
def test_a_folder_of_another_version(node, folder, tmp_path, damage):
    old = tmp_path / "old"
    if damage != "missing":
        shutil.copytree(folder, old)
        about = json.loads((old / "robot.json").read_text())
        if damage == "format":
            (old / "robot.json").write_text(json.dumps(about | {"format_version": 9}))
        else:
            (old / "scorer.onnx").unlink()
    with running(LOCALIZER, {"folder": old}), running(GAZE, {"folder": old}, signal.SIGINT):
        for name in ("visual_localization", "gaze"):
            node.wait(lambda name=name: node.status(name), f"diagnostics of {name}")
        node.received.clear()
        status = node.wait(node.status, "diagnostics every second")
        assert (
            status.level == DiagnosticStatus.ERROR and "a folder of `wheretolook export --localize`" in status.message
        )
        assert "Export" in status.message or "No such file" in status.message, status.message


@pytest.mark.parametrize(
    ("node_name", "setting", "message"),
    [
        ("localizer", "confidence:=abc", "'confidence' to 'abc' of type 'STRING', expecting type 'DOUBLE'"),
        ("gaze", "mount:=[1]", "'mount'"),
        ("gaze", "mount:=[1.0]", "mount is [1.]; it must be six finite numbers"),
        ("gaze", "mount:=[]", "mount is None; it must be six finite numbers"),
        ("localizer", "mount:=[0, 0, 1.2, 0, 0, 0]", "mount:=[0, 0, 1.2, 0, 0, 0]'. Error: Sequence"),
        ("localizer", "image_qos:=foo", "image_qos is foo; it must be sensor_data or system_default"),
        ("gaze", "pan_limits_deg:=[60.0, -60.0]", "pan_limits_deg is [ 60. -60.]; it must be [lowest, highest]"),
        ("gaze", "tilt_limits_deg:=[30.0]", "tilt_limits_deg is [30.]; it must be [lowest, highest] in degrees"),
        ("localizer", "confidence:=0.0", "confidence is 0.0; it must be above 0 and at most 1"),
        ("localizer", "max_views:=0", "max_views is 0; it must be positive and finite"),
        ("localizer", "accuracy_m:=-0.1", "accuracy_m is -0.1; it must be positive and finite"),
        ("gaze", "use_sim_time:=maybe", "'use_sim_time'"),
    ],
)
def test_a_parameter_that_is_not_allowed_ends_the_node(node_name, setting, message):
    command = [sys.executable, "-m", f"wheretolook_ros.{node_name}", "--ros-args", "-p", setting]
    ended = subprocess.run(command, env=os.environ | environment(), capture_output=True, text=True, timeout=30)
    assert ended.returncode == 1 and "Traceback" not in ended.stderr, ended.stderr
    lines = [line for line in ended.stderr.splitlines() if "[rcl]" not in line]
    assert len(lines) == 1 and message in lines[0], ended.stderr


def stamp_of(time):
    return Time(sec=int(time), nanosec=round(time % 1 * 1e9))


@pytest.mark.parametrize(
    ("limits", "asked", "pan", "within"),
    [((-90, 180), -170, 180, False), ((180, 180), -179, 180, True), ((-180, -170), 100, -180, False)],
)
def test_a_head_turns_to_the_nearer_of_its_limits(limits, asked, pan, within):
    """Also across 180 degrees: -170 is 10 degrees from 180, and 80 from -90."""
    head = Head([0.0] * 6, limits)
    direction = np.array([np.cos(np.radians(asked)), np.sin(np.radians(asked)), 0])
    np.testing.assert_allclose(np.degrees(head.joints(direction)), (pan, 0), atol=1e-9)
    assert head.nearest(direction)[1] == within


def test_values_are_interpolated_and_never_extrapolated():
    """A head that turned since its last state would turn the base."""
    line = Timeline()
    assert line.at(0.0) is None
    for time, value in ((0.0, 0.0), (0.1, 1.0), (0.4, 2.0)):
        line.add(stamp_of(time), np.array([value]))
    np.testing.assert_allclose(line.at(0.05), [0.5])
    np.testing.assert_allclose(line.at(0.404), [2.0])
    assert line.at(0.45) is None and line.at(0.2) is None and line.at(-0.2) is None
    with pytest.raises(ValueError, match=r"time jumped back by 0\.10 s; earlier values are discarded"):
        line.add(stamp_of(0.3), np.array([0.0]))
    with pytest.raises(ValueError, match="a number is not finite"):
        line.add(stamp_of(0.3), np.array([np.nan]))
    assert line.end() == pytest.approx(0.3) and len(line.rows) == 1


class Gaze:
    """Talks to a gaze node."""

    def __init__(self, node, folder):
        self.node = node
        self.scorer = RobotScorer(folder)
        node.senders["pose"] = node.create_publisher(PoseWithCovarianceStamped, "visual_localization/pose", 10)
        node.senders["look"] = node.create_publisher(Vector3Stamped, "visual_localization/next_look", 10)
        node.connected("plan", "pose", "look")

    def joints(self, base):
        """Return names and positions of the joints that the node answers a pose of the base with, and its direction."""
        message = PoseWithCovarianceStamped()
        message.header.frame_id = "map"
        message.pose.pose = pose_message(base)
        trajectory, looked = self.node.ask("pose", message, "joint_trajectory", "gaze/direction")
        direction = (looked.vector.x, looked.vector.y, looked.vector.z)
        return trajectory.joint_names, trajectory.points[0].positions, direction

    def score(self, base, joints):
        """Return the score of the camera at the joints' (pan, tilt)."""
        return self.scorer.score(invert_poses(compose_poses(base, HEAD.base_from_camera(*joints))))[0]

    def views(self):
        """Return the views (V, 3, 4) of a plan along x from 1.5 to 4.5 m, one in 0.5 m."""
        path = PathMessage()
        path.header.frame_id = "map"
        for x in np.linspace(1.5, 4.5, 31):
            path.poses.append(PoseStamped(pose=pose_message(base_at(x, 2.5, 0.0))))
        (views,) = self.node.ask("plan", path, "gaze/views")
        assert views.header.frame_id == "map" and len(views.poses) == 7
        return np.array([pose_matrix(view.pose) for view in views.poses])


BASES = (BASE, base_at(2.0, 3.0, -100.0))


def test_the_gaze(node, folder):
    limits = {"pan_limits_deg": "[-60.0, 60.0]", "tilt_limits_deg": "[-20.0, 20.0]"}
    with running(GAZE, {"folder": folder, "directions": 400} | limits):
        gaze = Gaze(node, folder)
        for base in BASES:
            names, joints, _ = gaze.joints(base)
            assert names == ["pan", "tilt"] and (np.abs(np.degrees(joints)) <= (60, 20)).all()
            others = [gaze.score(base, at) for at in product(np.linspace(-1, 1, 9), np.linspace(-0.3, 0.3, 5))]
            assert gaze.score(base, joints) >= np.max(others) - 0.02
        look = Vector3Stamped()
        look.header.frame_id = "base_link"
        look.vector.x = np.cos(0.5)
        look.vector.y = np.sin(0.5)
        (found,) = node.ask("look", look, "joint_trajectory")
        np.testing.assert_allclose(found.points[0].positions, (0.5, 0.0), atol=1e-9)
        look.vector.x = np.nan
        node.send("look", look)
        node.reported("next_look: a number is not finite", "gaze")
        look.header.frame_id = "elsewhere"
        node.send("look", look)
        node.reported("next_look: frame is 'elsewhere', expected 'base_link'", "gaze")

        cameras = gaze.views()
        np.testing.assert_allclose(
            cameras[:, :, 3], [(x + 0.1, 2.5, 1.2) for x in np.arange(1.5, 4.51, 0.5)], atol=1e-6
        )
        axes = cameras[:, :, 2]
        assert (np.abs(pan_tilt_angles(axes)) <= np.radians([[60], [20]])).all()
        assert np.degrees(np.arccos(np.clip((axes[1:] * axes[:-1]).sum(1), -1, 1))).max() <= 60


PAN_ONLY = {"tilt_joint": '""', "tilt_limits_deg": "[10.0, 40.0]"}  # the camera looks down by 10 degrees
TILT_ONLY = {"pan_joint": '""'}


def test_localizing_by_a_head_with_pan_only(node, folder):
    with running(LOCALIZER, {"folder": folder} | PAN_ONLY):
        node.connected("image", "camera_info", "joint_states")
        node.joints = ["wheel", "pan"]
        image = image_of(node.rgb(BASE, 0.4, np.radians(10)))
        assert node.see(image, info_of(CAMERA), joints=(7.0, 0.4)).message == "localized"
        node.localized(BASE)
        dark = image_of(np.zeros((480, 640, 3), np.uint8))
        assert "no next view" not in node.see(dark, info_of(CAMERA), joints=(7.0, 0.4)).message
        vector = node.published("visual_localization/next_look").vector
        assert np.degrees(np.arcsin(-vector.z)) == pytest.approx(10)
        assert abs(np.degrees(np.arctan2(vector.y, vector.x) - 0.4)) > 25


@pytest.mark.parametrize("moved", [0, 1])
def test_the_gaze_of_a_head_with_one_joint(node, folder, moved):
    fixed = np.radians([0, 10])
    angles = (np.linspace(-np.pi, np.pi, 25), np.radians(np.linspace(-45, 45, 10)))[moved]
    with running(GAZE, {"folder": folder} | (TILT_ONLY if moved else PAN_ONLY)):
        gaze = Gaze(node, folder)

        def joints(angle):
            return (0.0, angle) if moved else (angle, fixed[1])

        for base in BASES:
            names, (angle,), direction = gaze.joints(base)
            assert names == [JOINTS[moved]]
            np.testing.assert_allclose(direction, HEAD.base_from_camera(*joints(angle))[:, 2], atol=1e-9)
            others = [gaze.score(base, joints(other)) for other in angles]
            assert gaze.score(base, joints(angle)) >= np.max(others) - 0.02
        pan, tilt = pan_tilt_angles(gaze.views()[:, :, 2])
        np.testing.assert_allclose(pan if moved else -tilt, 0.0 if moved else fixed[1], atol=1e-6)


def test_odometry_is_placed_in_the_map(node, folder):
    found = []
    topic = "visual_localization/map_from_odom"  # where tf2_msgs is not installed
    node.create_subscription(TransformStamped, topic, found.append, 10)
    odometry = compose_poses(base_at(-1.0, 4.0, 50.0), BASE)  # its origin is elsewhere
    node.odom_frame = "wheels"
    with running(LOCALIZER, {"folder": folder, "publish_tf": "true", "odom_frame": "wheels"}):
        node.connected("image", "camera_info", "odom", "joint_states")
        assert node.see(image_of(node.rgb(BASE)), info_of(CAMERA), odometry).message == "localized"
        node.wait(lambda: len(found) > 3, "transforms")
        sent = found[-1]
        node.see(image_of(np.zeros((480, 640, 3), np.uint8)), info_of(CAMERA), step_s=-50.0)  # time jumps back
        for _ in range(20):
            rclpy.spin_once(node, timeout_sec=0.05)  # what was sent before
        count = len(found)
        for _ in range(20):
            rclpy.spin_once(node, timeout_sec=0.05)
        assert len(found) == count
        for frame, child, problem in (
            ("odom", "base_link", "odom: frame is 'odom', expected 'wheels'"),
            ("wheels", "wheel", "odom: child frame is 'wheel', expected 'base_link'"),
        ):
            message = Odometry(child_frame_id=child)
            message.header.frame_id = frame
            node.send("odom", message)
            node.reported(problem)
    assert (sent.header.frame_id, sent.child_frame_id) == ("map", "wheels")
    moved = sent.transform.translation
    pose = Pose(position=Point(x=moved.x, y=moved.y, z=moved.z), orientation=sent.transform.rotation)
    base = compose_poses(pose_matrix(pose), odometry)
    np.testing.assert_allclose(base, BASE, atol=0.02)
    assert len({(one.header.stamp.sec, one.header.stamp.nanosec) for one in found}) == len(found)


def test_localizability_is_latched_and_a_robot_turns_to_the_view(node, folder, tmp_path):
    places = np.array([(1.0, 2.0, 1.2), (1.5, 2.0, 1.2), (1.0, 3.0, 1.2)])
    write_mask(tmp_path / "mask", places, np.array([0.2, 0.996, 0.5]), 0.5)
    turning = {"pan_joint": '""', "tilt_joint": '""'}
    with running(GAZE, {"folder": folder, "mask": tmp_path / "mask"} | turning):
        gaze = Gaze(node, folder)
        grids, goals = [], []
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(OccupancyGrid, "localizability", grids.append, latched)
        node.create_subscription(PoseStamped, "gaze/goal_pose", goals.append, 10)
        grid = node.wait(lambda: grids and grids[0], "the latched grid")
        gaze.joints(BASE)
        assert not goals  # one would replace that of a robot that is localized
        look = Vector3Stamped()
        look.header.frame_id = "base_link"
        look.vector.y = -2.0
        goal = node.wait(lambda: (node.ask("look", look, "gaze/direction"), goals)[1], "a goal")[-1]
        gaze.joints(BASE)
        n_goals = len(goals)
        gaze.joints(BASE)
        assert len(goals) == n_goals
    assert grid.header.frame_id == "map" and (grid.info.width, grid.info.height) == (2, 3)
    origin = grid.info.origin.position
    assert (origin.x, origin.y, round(grid.info.resolution, 6)) == (0.75, 1.75, 0.5)
    assert list(grid.data) == [20, 100, -1, -1, 50, -1]
    assert goal.header.frame_id == "base_link" and (goal.header.stamp.sec, goal.pose.position.x) == (0, 0.0)
    forward = pose_matrix(goal.pose)[:, 0]
    np.testing.assert_allclose(forward, (0, -1, 0), atol=1e-6)


def test_a_mask_that_is_missing_is_reported_and_the_node_continues(node, folder, tmp_path):
    logged = []
    latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(Log, "/rosout", logged.append, latched)
    with running(GAZE, {"folder": folder, "mask": tmp_path / "none"}):
        Gaze(node, folder).joints(BASE)
        text = f"mask {tmp_path / 'none'} is not published: "
        node.wait(lambda: any(one.msg.startswith(text) for one in logged), text)
