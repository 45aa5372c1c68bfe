"""A simulated robot, the localizer and the gaze node, by a simulated clock: it looks until it is localized, then drives."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed: pip install '.[ros]'")

import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMessage
from wheretolook_ros.conversions import pose_matrix, pose_message, seconds

from ros.processes import HEAD, ROOT, Robot, base_at, environment, running
from ros.room import room_mesh, write_folder
from wheretolook.geometry.poses import compose_poses, invert_poses, pose_error
from wheretolook.scenes.loading import save_glb

SIMULATOR = str(ROOT / "tests" / "ros" / "simulated_robot.py")


@pytest.mark.slow  # four processes, half a minute
def test_a_robot_that_faces_a_wall_turns_and_drives(tmp_path):
    mesh = room_mesh()
    save_glb(mesh, tmp_path / "room.glb")
    folder = write_folder(mesh, tmp_path / "robot")
    os.environ.update(environment())
    rclpy.init()
    node = Robot()
    truths = {}
    place = node.create_publisher(PoseStamped, "place", 10)

    def keep(message):
        truths[round(seconds(message.header.stamp), 4)] = pose_matrix(message.pose)

    node.create_subscription(PoseStamped, "ground_truth", keep, 50)

    def errors():
        """Errors of the published poses of the base, from the true ones of the camera and the joints."""
        found = []
        for name, message in node.received:
            truth = truths.get(round(seconds(message.header.stamp), 4)) if name.endswith("localization/pose") else None
            if truth is not None:
                position = compose_poses(pose_matrix(message.pose.pose), HEAD.base_from_camera(0.0, 0.0))[:, 3]
                found.append((float(np.linalg.norm(position - truth[:, 3])), seconds(message.header.stamp)))
        return found

    clock = {"use_sim_time": "true"}
    robot = {"folder": folder, "mesh": tmp_path / "room.glb", "simulated_clock": "true", "rate_hz": 2.0}
    both = clock | {"folder": folder}
    with running(SIMULATOR, robot), running("wheretolook_ros.localizer", both), running("wheretolook_ros.gaze", both):
        node.connected("plan")
        node.wait(lambda: place.get_subscription_count(), "the simulator")
        base = base_at(5.75, 2.5, 0.0)
        place.publish(PoseStamped(pose=pose_message(base)))
        node.wait(errors, "a confident pose")
        assert errors()[0][0] < 0.05 and errors()[0][1] > 1000
        assert any(name == "visual_localization/next_look" for name, _ in node.received)
        first = pose_matrix(node.last("visual_localization/pose").pose.pose)
        position, angle = pose_error(invert_poses(first), invert_poses(base))
        assert position < 0.05 and angle < 0.4
        node.received.clear()
        path = PathMessage()
        path.header.frame_id = "map"
        for x in np.arange(5.75, 3.0, -0.1):
            path.poses.append(PoseStamped(pose=pose_message(base_at(float(x), 2.5, 180.0))))
        node.send("plan", path)
        node.wait(lambda: truths and min(t[0, 3] for t in truths.values()) < 3.2, "the end of the path")
        assert node.last("gaze/views") is not None
        node.wait(lambda: len(errors()) >= 3, "poses along the path")
        assert max(error for error, _ in errors()) < 0.05
    node.destroy_node()
    rclpy.try_shutdown()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options", "printed"),
    [
        ("ros", "--places 1 --policy even --out {out}", "confident"),
        ("ros_node", "--seconds 3 --views 2", "per second of CPU time"),
        ("ros_paths", "--paths 1 --min-length 1 --out {out}", "ahead: confident"),
        ("ros_film", "--min-length 2 --bag {bag} --film {film}", ""),
    ],
)
def test_benchmarks_run_small(name, options, printed, tmp_path):
    mesh = room_mesh()
    save_glb(mesh, tmp_path / "room.glb")
    x, y = np.meshgrid(np.arange(1.0, 6.0), np.arange(1.0, 4.0))
    folder = write_folder(mesh, tmp_path / "robot", np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 1.2)]))
    command = [sys.executable, str(Path(__file__).with_name(f"bench_{name}.py"))]
    command += ["--mesh", str(tmp_path / "room.glb"), "--folder", str(folder)]
    film = tmp_path / "film.webp"
    command += options.format(out=tmp_path / "out.csv", bag=tmp_path / "bag", film=film).split()
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | environment())
    assert done.returncode == 0 and printed in done.stdout, done.stdout + done.stderr
    assert film.is_file() == (name == "ros_film")
