"""Measure the exported robot scorer on one core: one pose, and all directions at one location.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_robot.py [--landmarks 25000] [--weights FILE]

Landmarks are on the walls of a room and none is occluded; each pose is at another location. Prints the times of
loading and scoring, and the same for PyTorch's scorer with the largest difference
between their scores.
"""

import itertools
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import ROOM_M, options, room_map, timed, use_one_thread

from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.robot.export import export_robot
from wheretolook.robot.wheretolook_robot import RobotScorer
from wheretolook.scorers.weights import load_scorer
from wheretolook.visibility.occlusion import NoOcclusion


def main():
    args = options(
        __doc__, weights=Path("data/release/weights/set.safetensors"), landmarks=25_000, directions=500, repeats=500
    )
    use_one_thread()
    warnings.simplefilter("ignore")
    localization_map = replace(room_map(args.landmarks, np.zeros((1, 3)), "cpu"), occlusion=NoOcclusion())
    rng = np.random.default_rng(1)
    low, high = np.array(ROOM_M)
    at = rng.uniform(low + 0.5, high - 0.5, (args.repeats, 3))
    axes = fibonacci_sphere(args.directions)
    poses = poses_looking_along(at, rng.normal(size=(args.repeats, 3)))
    next_pose = itertools.cycle(poses)
    next_place = itertools.cycle(at)
    few = min(15, args.repeats)
    with tempfile.TemporaryDirectory() as folder:
        export_robot(localization_map, args.weights, folder)
        robot = RobotScorer(folder)
        scorer = load_scorer(localization_map, args.weights)
        views = robot.views(poses)
        off = np.abs(views.score - scorer.score(poses)).max()
        seen = f"{np.median(views.n_visible):.0f} in view (up to {views.n_visible.max()})"
        print(f"{args.landmarks:,} landmarks, {seen}; largest difference of scores {off:.1e}")
        timed("robot: loading the folder", lambda: RobotScorer(folder), few)
        timed("robot: one pose", lambda: robot.score(next(next_pose)), args.repeats)
        timed("PyTorch: one pose", lambda: scorer.score(next(next_pose)[None]), args.repeats)
        timed(f"robot: best of {len(axes)} directions", lambda: robot.best(next(next_place), axes), few)
        timed(f"PyTorch: {len(axes)} directions", lambda: scorer.score_directions(next(next_place)[None], axes), few)


if __name__ == "__main__":
    main()
