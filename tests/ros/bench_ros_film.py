"""Record a simulated robot that localizes itself and drives, as a rosbag, and draw a film from the bag.

    python tests/ros/bench_ros_film.py --mesh scene.glb --folder robot --bag drive --film drive.webp

Needs rosbags. The robot is placed at the start of a planned path in a random direction, looks until it is localized, and
then drives while the gaze node points the camera. The bag has what the nodes and the robot publish.
"""

import os
import sys
import time
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "src" / "wheretolook_ros")]

import rclpy
from bench_ros_paths import waypoints_of
from common import options as parse_options
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Path as PathMessage
from rclpy.serialization import serialize_message
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import Image
from wheretolook_ros.conversions import pose_matrix, pose_message

from ros.processes import HEAD, Robot, base_at, environment, running
from wheretolook.scenes.loading import load_mesh
from wheretolook.space.free_space import FreeSpace
from wheretolook_paper.figures.animation import save_moving

STORE = get_typestore(Stores.ROS2_KILTED)
TOPICS = {
    "image": Image,
    "ground_truth": PoseStamped,
    "plan": PathMessage,
    "visual_localization/pose": PoseWithCovarianceStamped,
    "/diagnostics": DiagnosticArray,
}
LOOK_S = 60.0
DRIVE_S = 120.0
FRAME_MS = 350


def record(mesh, folder, bag, min_length_m, seed):
    """Run robot, localizer and gaze node along a path, and write the bag."""
    with np.load(folder / "landmarks.npz") as stored:
        places = stored["places"]
    route = waypoints_of(places, FreeSpace(load_mesh(mesh)), min_length_m, np.random.default_rng(seed))
    route = route - (0, 0, HEAD.base_from_camera(0, 0)[2, 3])
    os.environ.update(environment())
    rclpy.init()
    node = Robot()
    place = node.create_publisher(PoseStamped, "place", 10)
    settings = {"folder": folder}
    robot = settings | {"mesh": mesh, "rate_hz": 2.0, "speed": 0.4, "images_while_turning": "true"}
    with ExitStack() as stack:
        writer = stack.enter_context(Writer(bag, version=9))
        for topic, kind in TOPICS.items():
            name = f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"
            connection = writer.add_connection("/" + topic.strip("/"), name, typestore=STORE)

            def keep(message, connection=connection, topic=topic):
                writer.write(connection, time.time_ns(), serialize_message(message))
                node.received.append((f"kept {topic}", message if topic != "image" else None))

            node.create_subscription(kind, topic, keep, 20)
        stack.enter_context(running(str(ROOT / "tests" / "ros" / "simulated_robot.py"), robot))
        stack.enter_context(running("wheretolook_ros.localizer", settings))
        stack.enter_context(running("wheretolook_ros.gaze", settings))
        node.connected("plan")
        _spin(node, lambda: place.get_subscription_count() and node.status() is not None, LOOK_S)
        base = base_at(route[0, 0], route[0, 1], float(np.random.default_rng(seed).uniform(-180, 180)))
        base[2, 3] = route[0, 2]
        place.publish(PoseStamped(pose=pose_message(base)))
        _spin(node, lambda: any(name == "kept visual_localization/pose" for name, _ in node.received), LOOK_S)
        path = PathMessage()
        path.header.frame_id = "map"
        for at in np.concatenate([np.linspace(a, b, 5, endpoint=False) for a, b in pairwise(route)]):
            pose = np.column_stack([np.eye(3), at])
            path.poses.append(PoseStamped(pose=pose_message(pose)))
        node.send("plan", path, time.time())
        goal = route[-2, :2]

        def arrived():
            truths = [message for name, message in node.received if name == "kept ground_truth"]
            return bool(truths) and np.linalg.norm(pose_matrix(truths[-1].pose)[:2, 3] - goal) < 0.3

        _spin(node, arrived, DRIVE_S)
    rclpy.try_shutdown()


def _spin(node, done, seconds):
    end = time.monotonic() + seconds
    while time.monotonic() < end and not done():
        rclpy.spin_once(node, timeout_sec=0.05)


def frames_of(bag, folder):
    """Draw a frame for each image of a bag: the image, and the plan with true and published poses."""
    import matplotlib.pyplot as plt

    with np.load(folder / "landmarks.npz") as stored:
        points = stored["points"]
    low, high = np.quantile(points, (0.005, 0.995), axis=0)
    points = points[((points >= low) & (points <= high)).all(axis=1)]
    route = np.zeros((0, 2))
    published = []
    travelled = []
    truth = np.eye(3, 4)
    status = ""
    with AnyReader([bag], default_typestore=STORE) as reader:
        for connection, stamp, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "/plan":
                route = np.array([(pose.pose.position.x, pose.pose.position.y) for pose in message.poses])
            elif connection.topic == "/visual_localization/pose":
                published.append((pose_matrix(message.pose.pose), stamp))
            elif connection.topic == "/diagnostics" and message.status[0].name.startswith("visual_localization"):
                status = message.status[0].message
            elif connection.topic == "/ground_truth":
                truth = pose_matrix(message.pose)
                travelled.append(truth[:2, 3])
            elif connection.topic == "/image":
                rgb = np.asarray(message.data).reshape(message.height, message.width, 3)
                figure, (left, right) = plt.subplots(1, 2, figsize=(6.4, 2.5), layout="constrained", dpi=100)
                left.imshow(rgb[::2, ::2])
                left.set_axis_off()
                localized = bool(published) and stamp - published[-1][1] < 1.5e9
                left.set_title("localized" if localized else status.split(",")[0] or "no image yet", fontsize=8,
                               color="#2a7f3f" if localized else "#b3432f")  # fmt: skip
                right.plot(points[::3, 0], points[::3, 1], ".", color="#c4c4c4", ms=0.7)
                right.plot(*route.T, "--", color="#8c8c8c", lw=1)
                right.plot(*np.array(travelled).T, color="#4c72b0", lw=1.2)
                for base, _ in published:
                    right.plot(base[0, 3], base[1, 3], ".", color="#2a7f3f", ms=5)
                axis = truth[:2, 2] / max(np.linalg.norm(truth[:2, 2]), 1e-6)
                right.annotate("", truth[:2, 3] + 1.2 * axis, truth[:2, 3],
                               arrowprops={"arrowstyle": "-|>", "color": "#4c72b0"})  # fmt: skip
                right.set_aspect("equal")
                right.set_axis_off()
                figure.canvas.draw()
                yield np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()
                plt.close(figure)


def main():
    options = parse_options(__doc__, mesh=..., folder=..., bag=..., film=..., min_length=5.0, seed=0)
    if not options.bag.exists():
        record(options.mesh, options.folder, options.bag, options.min_length, options.seed)
    save_moving(frames_of(options.bag, options.folder), FRAME_MS, options.film, 2000)


if __name__ == "__main__":
    main()
