"""Start-up time, rate and memory of the localizer node, on images that arrive as fast as it localizes them.

    python tests/ros/bench_ros_node.py --mesh scene.glb --folder robot --seconds 180
    python tests/ros/bench_ros_node.py --mesh scene.glb --folder robot --seconds 3600 --rate 1.5

Times are CPU times of the node's process, whatever else runs on the machine. With a rate, images come with odometry,
every tenth is black, and the node publishes next views, so that all it does can keep memory.
"""

import os
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "src" / "wheretolook_ros")]

import rclpy
from bench_ros import random_bases
from common import options as parse_options
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from wheretolook_ros.conversions import pose_message

from ros.processes import CAMERA, JOINTS, Robot, environment, image_of, info_of, running
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh

TICKS = os.sysconf("SC_CLK_TCK")


def cpu_seconds(pid):
    """CPU time of all threads of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def resident_mb(pid):
    """Resident memory of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def seconds_of_images(node):
    """Seconds that each localized image took, by the diagnostics received."""
    reports = [message.status[0].values for name, message in node.received if name == "/diagnostics"]
    return [float(pair.value) for values in reports for pair in values if pair.key == "seconds" and len(values) > 1]


def main():
    """Measure and print."""
    options = parse_options(__doc__, mesh=..., folder=..., seconds=180.0, views=40, rate=0.0)
    os.environ.update(environment())
    node_settings = {"folder": options.folder, "next_look": str(options.rate > 0).lower()}
    bases = random_bases(options.mesh, options.folder, options.views, 1)
    renderer = WarpRenderer(load_mesh(options.mesh))
    rclpy.init()
    node = Robot(renderer)
    images = [image_of(node.rgb(base)) for base in bases]
    if options.rate:
        images[::10] = [image_of(np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)) for _ in images[::10]]
    began = time.monotonic()
    with running("wheretolook_ros.localizer", node_settings) as process:
        node.connected("image", "camera_info", "joint_states")
        node.see(images[0], info_of(CAMERA))
        started = time.monotonic() - began
        print(f"first image localized {started:.1f} s after the start, {cpu_seconds(process.pid):.1f} s of CPU time")
        node.received.clear()
        times = []
        begin = time.monotonic()
        cpu = cpu_seconds(process.pid)
        number = 0
        last = begin
        while time.monotonic() - begin < options.seconds:
            number += 1
            node.stamp += 0.1
            node.send("joint_states", JointState(name=JOINTS, position=[0.0, 0.0]))
            node.send("camera_info", info_of(CAMERA))
            if options.rate:
                odometry = Odometry()
                odometry.pose.pose = pose_message(bases[number % len(bases)])
                node.send("odom", odometry)
            node.send("image", images[number % len(images)])
            times += node.wait(lambda: seconds_of_images(node), "an answer")
            node.received.clear()
            while options.rate and time.monotonic() < begin + number / options.rate:
                rclpy.spin_once(node, timeout_sec=0.05)
            if time.monotonic() - last > options.seconds / 60:
                last = time.monotonic()
                print(f"{last - begin:.0f} s: {len(times)} images, {resident_mb(process.pid):.1f} MB", flush=True)
        used = cpu_seconds(process.pid) - cpu
    rate = len(times) / used
    print(f"{len(times)} images: {rate:.2f} per second of CPU time, {np.median(times):.3f} s each in median (wall)")
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
