"""What a robot runs: one pose, and all directions at one place, by the exported scorer on one core.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_robot.py [--landmarks 25000] [--weights FILE]

A map of landmarks on the walls of a room, none of which are hidden, so that each view chooses among all of them; every
pose is at another place. Prints medians of the repeats and their range, beside PyTorch's scorer of the same weights and
the largest difference of their scores. Also the time that this process has computed for, which other work on the
machine makes no longer, and what loading takes.
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
from bench_fisher import ROOM_M
from bench_scorers import room_map

from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import Float, poses_looking_along
from wheretolook.robot.export import export_robot
from wheretolook.robot.wheretolook_robot import RobotScorer
from wheretolook.visibility.occlusion import NoOcclusion
from wheretolook.weights.resolve import load_scorer


def timed(label: str, work: Callable[[int], object], repeats: int) -> None:
    """Print median, quartiles and range of the repeats in ms, and the median of the processor's time."""
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
    print(f"{label:36} {middle:9.2f} ms  ({spread}; processor {np.median(used) * 1e3:.2f})", flush=True)


def main() -> None:
    """Print a table."""
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
    at = rng.uniform(low + 0.5, high - 0.5, (args.repeats, 3))
    axes = fibonacci_sphere(args.directions)
    poses = poses_looking_along(at, rng.normal(size=(args.repeats, 3)))

    def around(place: Float) -> Float:
        return poses_looking_along(np.tile(place, (len(axes), 1)), axes)

    with tempfile.TemporaryDirectory() as folder:
        export_robot(localization_map, args.weights, folder)
        robot = RobotScorer(folder)
        scorer = load_scorer(args.weights, localization_map)
        views = robot.views(poses)
        off = np.abs(views.score - scorer.score(poses)).max()
        seen = f"{np.median(views.n_visible):.0f} in view (up to {views.n_visible.max()})"
        print(f"{args.landmarks:,} landmarks, {seen}; largest difference of scores {off:.1e}")
        timed("robot: loading the folder", lambda _: RobotScorer(folder), 20)
        timed("robot: one pose", lambda number: robot.score(poses[number]), args.repeats)
        timed("PyTorch: one pose", lambda number: scorer.score(poses[number : number + 1]), args.repeats)
        timed(f"robot: best of {len(axes)} directions", lambda number: robot.best(at[number], axes), 15)
        timed(f"PyTorch: {len(axes)} directions", lambda number: scorer.score(around(at[number])), 15)


if __name__ == "__main__":
    main()
