"""Closed loop under ROS: a simulated robot at random poses looks until the localizer is confident.

    python tests/ros/bench_ros.py --mesh scene.glb --folder robot --places 30 --policy gain --out gain.csv

Processes: simulated robot, localizer and, with the policy gain, gaze node. With the policy even, this one turns the head
by quarters. Prints the share of places with a confident pose, how many of these are right, the mean number of views, and
how many of the first images' poses are right.
"""

import os
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pandas as pd

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "benchmarks"), str(ROOT / "src" / "wheretolook_ros")]

import rclpy
from common import options as parse_options
from geometry_msgs.msg import PoseStamped
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from wheretolook_ros.conversions import pose_matrix, pose_message, seconds

from ros.processes import CAMERA, HEAD, JOINTS, Robot, environment, running
from wheretolook.geometry.poses import compose_poses, invert_poses, pose_error
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.robot.localizer import RobotLocalizer
from wheretolook.scenes.loading import load_mesh
from wheretolook.space.free_space import FreeSpace

EVEN_PAN_DEG = (0, 90, 180, -90, 45, 135, -135, -45)
LIMITS = (0.05, 0.4), (0.25, 2.0)
DISTINCT_DEG = 5.0
PATIENCE_S = 150.0
REC_709 = (0.2126, 0.7152, 0.0722)


def random_bases(mesh, folder, n, seed):
    """Poses of the base whose camera is at a random free location, in a random direction."""
    rng = np.random.default_rng(seed)
    space = FreeSpace(load_mesh(mesh))
    with np.load(folder / "landmarks.npz") as stored:
        places = stored["places"]
    bases = []
    while len(bases) < n:
        at = places[rng.integers(len(places))] + rng.uniform(-0.2, 0.2, 3)
        if space.is_free(at[None])[0] and 0.9 < at[2] - space.floor_below(at[None])[0] < 1.7:
            yaw = rng.uniform(-np.pi, np.pi)
            turned = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])
            bases.append(np.column_stack([turned, at - turned @ HEAD.base_from_camera(0, 0)[:, 3]]))
    return bases


class Trial:
    """What happens at one place."""

    def __init__(self, node, base, policy, max_views):
        self.node = node
        self.base = base
        self.policy = policy
        self.max_views = max_views
        self.axes = []  # of distinct views
        self.places = node.place
        node.received.clear()
        message = PoseStamped(pose=pose_message(base))
        message.header.frame_id = "map"
        self.places.publish(message)

    def row(self):
        """Look until confident or out of views; returns the outcome."""
        end = time.monotonic() + PATIENCE_S
        begin = time.monotonic()
        done = 0
        while time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=0.05)
            truths = {
                round(seconds(message.header.stamp), 4): pose_matrix(message.pose)
                for name, message in self.node.received
                if name == "ground_truth"
            }
            while done < len(self.node.received):
                name, message = self.node.received[done]
                done += 1
                if name == "visual_localization/pose" and self._here(truths, seconds(message.header.stamp)):
                    self._count(truths[round(seconds(message.header.stamp), 4)])
                    return self._outcome(pose_matrix(message.pose.pose), time.monotonic() - begin)
                if name == "/diagnostics" and message.status[0].name.startswith("visual_localization"):
                    values = {pair.key: pair.value for pair in message.status[0].values}
                    stamp = float(values.get("image", -1))
                    if self._here(truths, stamp) and "lost" in message.status[0].message:
                        self._lost(truths[round(stamp, 4)])
            if len(self.axes) > self.max_views:
                break
        return self._outcome(None, time.monotonic() - begin)

    def _here(self, truths, stamp):
        truth = truths.get(round(stamp, 4))
        camera = compose_poses(self.base, HEAD.base_from_camera(0, 0))[:, 3]
        return truth is not None and np.linalg.norm(truth[:, 3] - camera) < 1e-3

    def _count(self, truth):
        axis = truth[:, 2]
        if all(axis @ other < np.cos(np.radians(DISTINCT_DEG)) for other in self.axes):
            self.axes.append(axis)

    def _lost(self, truth):
        self._count(truth)
        if self.policy == "even" and len(self.axes) <= self.max_views:
            pan = np.radians(EVEN_PAN_DEG[len(self.axes)])
            point = JointTrajectoryPoint(positions=[float(pan), 0.0])
            self.node.head.publish(JointTrajectory(joint_names=JOINTS, points=[point]))

    def _outcome(self, found, elapsed):
        error_m, error_deg = (
            (np.nan, np.nan) if found is None else pose_error(invert_poses(found), invert_poses(self.base))
        )
        outcome = {"confident": found is not None, "views": min(len(self.axes), self.max_views)}
        return {**outcome, "error_m": error_m, "error_deg": error_deg, "s": elapsed}


def first_poses(mesh, folder, bases):
    """The pose that the first image alone gives, whatever its probability."""
    renderer = WarpRenderer(load_mesh(mesh))
    localizer = RobotLocalizer(folder)
    rows = []
    for base in bases:
        pose = invert_poses(compose_poses(base, HEAD.base_from_camera(0, 0)))
        grey = (renderer.render(CAMERA, pose[None]).rgb[0] @ REC_709).astype(np.uint8)
        result = localizer.localize([localizer.match(*localizer.extract(grey))])
        row = {"first_m": np.nan, "first_deg": np.nan, "first_probability": result.probability}
        if result.joint.status == "localized":
            row["first_m"], row["first_deg"] = pose_error(result.poses[0].cam_from_world, pose)
        rows.append(row)
    return rows


def summary(table):
    """Describe the outcome of all places."""
    sure = table[table["confident"]]
    lines = [f"{len(table)} places, confident {100 * len(sure) / len(table):.1f} %, views {table['views'].mean():.2f}, "
             f"of the confident {sure['views'].mean():.2f}"]  # fmt: skip
    for metres, degrees in LIMITS:
        right = (sure["error_m"] < metres) & (sure["error_deg"] < degrees)
        has = table["first_m"].notna()
        first = (table["first_m"] < metres) & (table["first_deg"] < degrees)
        lines.append(f"{metres} m, {degrees} deg: {right.sum()} of {len(sure)} confident poses right; "
                     f"of the first images' {has.sum()} poses {first.sum()}")  # fmt: skip
    lines.append(f"worst confident pose {sure['error_m'].max():.3f} m, {sure['error_deg'].max():.2f} deg")
    return "\n".join(lines)


def main():
    """Run and print."""
    options = parse_options(__doc__, mesh=..., folder=..., places=30, seed=0, views=6, policy="gain", out=Path)
    os.environ.update(environment())
    bases = random_bases(options.mesh, options.folder, options.places, options.seed)
    first = first_poses(options.mesh, options.folder, bases)
    rclpy.init()
    node = Robot()
    node.place = node.create_publisher(PoseStamped, "place", 10)
    node.head = node.create_publisher(JointTrajectory, "joint_trajectory", 10)
    node.create_subscription(PoseStamped, "ground_truth", lambda m: node.received.append(("ground_truth", m)), 50)
    settings = {"folder": options.folder}
    robot = settings | {"mesh": options.mesh, "rate_hz": 2.0, "turn_rate_deg": 360.0}
    with ExitStack() as stack:
        stack.enter_context(running(str(ROOT / "tests" / "ros" / "simulated_robot.py"), robot))
        stack.enter_context(running("wheretolook_ros.localizer", settings | {"next_look": options.policy == "gain"}))
        if options.policy == "gain":
            stack.enter_context(running("wheretolook_ros.gaze", settings))
        end = time.monotonic() + 60
        while time.monotonic() < end and (node.count_publishers("ground_truth") == 0 or node.status() is None):
            rclpy.spin_once(node, timeout_sec=0.1)
        rows = []
        for base, at_first in zip(bases, first, strict=True):
            rows.append(Trial(node, base, options.policy, options.views).row() | at_first)
            print(rows[-1], flush=True)
        table = pd.DataFrame(rows)
    if options.out:
        table.to_csv(options.out, index=False)
    print(summary(table))
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
