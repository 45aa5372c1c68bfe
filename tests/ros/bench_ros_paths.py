"""Localization along planned paths: the views that the gaze node selects, against a camera that looks ahead.

    python tests/ros/bench_ros_paths.py --mesh scene.glb --folder robot --paths 20 --out paths.csv

Shortest paths between random free places. Every half metre the camera of each policy is rendered and localized by itself
with the folder of `wheretolook export --localize`, as by the localizer node; views are those of the gaze node's path
planning (`wheretolook_robot.RobotScorer`, `best_sequence`). Prints the share of waypoints with a confident pose, of these
the right ones.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "benchmarks"), str(ROOT / "src" / "wheretolook_ros")]

from common import options as parse_options, write_csv

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import pan_tilt_angles, pose_error, poses_looking_along
from wheretolook.planning.config import PathConfig
from wheretolook.planning.rrt import plan_path
from wheretolook.planning.view_sequence import TurnLimit, best_sequence
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.robot.localizer import RobotLocalizer
from wheretolook.robot.wheretolook_robot import RobotScorer, fibonacci_sphere
from wheretolook.scenes.loading import load_mesh
from wheretolook.space.free_space import FreeSpace
from wheretolook.utils.errors import PlanningError

CONFIDENCE = 0.95
LIMITS = (0.05, 0.4)
SPACING_M = 0.5
MAX_TILT_DEG = 45.0
MAX_TURN_DEG = 60.0


def waypoints_of(places, space, min_length_m, rng):
    """Plan a shortest path between two random places (L, 3) m apart, and return points (W, 3) every `SPACING_M`."""
    bounds = np.stack([places.min(0), places.max(0)])
    while True:
        start, goal = places[rng.choice(len(places), 2, replace=False)]
        if np.linalg.norm(start - goal) < min_length_m:
            continue
        try:
            path = plan_path(start, goal, space, bounds, config=PathConfig(time_s=2.0), progress=False)
        except PlanningError:
            continue
        steps = np.linalg.norm(np.diff(path.positions, axis=0), axis=1)
        along = np.append(0, steps.cumsum())
        at = np.arange(0, along[-1], SPACING_M)
        return np.stack([np.interp(at, along, values) for values in path.positions.T], axis=1)


def main():
    args = parse_options(__doc__, mesh=..., folder=..., paths=20, min_length=3.0, seed=0, out=Path("paths.csv"))
    mesh = load_mesh(args.mesh)
    space = FreeSpace(mesh)
    renderer = WarpRenderer(mesh)
    localizer = RobotLocalizer(args.folder)
    scorer = RobotScorer(args.folder)
    axes = fibonacci_sphere(200)
    level = np.abs(np.degrees(pan_tilt_angles(axes)[1])) <= MAX_TILT_DEG
    limit = TurnLimit.of(axes, MAX_TURN_DEG, pan_tilt=True)
    camera = PinholeCamera()
    rng = np.random.default_rng(args.seed)
    rows = []
    for number in range(args.paths):
        points = waypoints_of(scorer.places, space, args.min_length, rng)
        scores = np.where(level, scorer.score_directions(points, axes), -np.inf)
        ahead = np.gradient(points, axis=0) * (1, 1, 0)
        looks = {"gaze": axes[best_sequence(scores, limit).direction_ids], "ahead": ahead}
        for policy, directions in looks.items():
            poses = poses_looking_along(points, directions)
            for k, pose in enumerate(poses):
                rgb = renderer.render(camera, pose[None]).rgb[0]
                grey = np.round(rgb @ (0.2126, 0.7152, 0.0722)).astype(np.uint8)
                found = localizer.localize([localizer.match(*localizer.extract(grey))]).poses
                error = pose_error(found[0].cam_from_world if found else np.full((3, 4), np.nan), pose)
                probability = found[0].probability if found else 0.0
                rows.append((number, policy, k, probability, float(error[0]), float(error[1])))
        print(f"path {number + 1}: {len(points)} waypoints", flush=True)
    table = pd.DataFrame(rows, columns=["path", "policy", "waypoint", "probability", "error_m", "error_deg"])
    write_csv(table, args.out)
    table["confident"] = table["probability"] >= CONFIDENCE
    table["right"] = (table["error_m"] <= LIMITS[0]) & (table["error_deg"] <= LIMITS[1])
    for policy, part in table.groupby("policy"):
        confident = part.groupby("path")["confident"].mean()
        right = part.loc[part["confident"], "right"].mean()
        spread = f"[{confident.quantile(0.25):.2f}, {confident.quantile(0.75):.2f}]"
        print(f"{policy}: confident {part['confident'].mean():.3f} (paths {spread}), right of these {right:.4f}, "
              f"right of all {part['right'].mean():.3f}")  # fmt: skip


if __name__ == "__main__":
    main()
