"""Measure the exported robot scorer on one core: one pose, and all directions at one location.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_robot.py [--landmarks 25000] [--weights FILE]

Landmarks are on the walls of a room and none is occluded; each pose is at another location. Prints the median, quartiles
and range over repeats, the CPU time, the loading time, and the same for PyTorch's scorer with the largest difference
between their scores.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from common import ROOM_M, room_map

from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import Float, poses_looking_along
from wheretolook.robot.export import export_robot
from wheretolook.robot.wheretolook_robot import RobotScorer
from wheretolook.scorers.weights import load_scorer
from wheretolook.visibility.occlusion import NoOcclusion


def timed(label: str, work: Callable[[int], object], repeats: int) -> None:
    """Print median, quartiles and range of the wall time in ms over repeats, and the median CPU time."""
    work(0)
    walls = []
    used = []
    for number in range(repeats):
        start = time.perf_counter()
        computed = time.process_time()
        work(number)
        walls.append(time.perf_counter() - start)
        used.append(time.process_time() - computed)
    low, first, middle, third, high = np.quantile(walls, (0, 0.25, 0.5, 0.75, 1)) * 1e3
    spread = f"quartiles {first:.2f} to {third:.2f}, range {low:.2f} to {high:.2f}"
    print(f"{label:36} {middle:9.2f} ms  ({spread}; CPU {np.median(used) * 1e3:.2f})", flush=True)


def main() -> None:
    """Parse the options, measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=Path, default=Path("data/release/weights/set.safetensors"))
    parser.add_argument("--landmarks", type=int, default=25_000)
    parser.add_argument("--directions", type=int, default=500)
    parser.add_argument("--repeats", type=int, default=500)
    args = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    localization_map = replace(room_map(args.landmarks, np.zeros((1, 3)), "cpu"), occlusion=NoOcclusion())
    rng = np.random.default_rng(1)
    low, high = np.array(ROOM_M)
    n_best = min(15, args.repeats)
    at = rng.uniform(low + 0.5, high - 0.5, (args.repeats, 3))
    axes = fibonacci_sphere(args.directions)
    poses = poses_looking_along(at, rng.normal(size=(args.repeats, 3)))

    def candidates(location: Float) -> Float:
        return poses_looking_along(np.tile(location, (len(axes), 1)), axes)

    with tempfile.TemporaryDirectory() as folder:
        export_robot(localization_map, args.weights, folder)
        robot = RobotScorer(folder)
        scorer = load_scorer(localization_map, args.weights)
        views = robot.views(poses)
        off = np.abs(views.score - scorer.score(poses)).max()
        seen = f"{np.median(views.n_visible):.0f} in view (up to {views.n_visible.max()})"
        print(f"{args.landmarks:,} landmarks, {seen}; largest difference of scores {off:.1e}")
        timed("robot: loading the folder", lambda _: RobotScorer(folder), min(20, args.repeats))
        timed("robot: one pose", lambda number: robot.score(poses[number]), args.repeats)
        timed("PyTorch: one pose", lambda number: scorer.score(poses[number : number + 1]), args.repeats)
        timed(f"robot: best of {len(axes)} directions", lambda number: robot.best(at[number], axes), n_best)
        timed(f"PyTorch: {len(axes)} directions", lambda number: scorer.score(candidates(at[number])), n_best)


if __name__ == "__main__":
    main()
