"""Learned scorers: viewpoints a second from landmarks to scores, and the time that one pose takes.

    python tests/benchmarks/bench_scorers.py [--device cuda] [--weights data/release/weights/set.safetensors ...]

A map of 25,000 landmarks on the walls of a room, of which half, at random, are hidden from each location. A batch is
every direction at many locations; what is measured begins with the poses and the landmarks free of occlusion, and ends
with scores in memory of the host. One pose is asked for at another location every time. Prints medians of the repeats
and their range.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from bench_fisher import ROOM_M, room_landmarks, timed

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import Float, poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.registry import make_scorer
from wheretolook.visibility.occlusion import StoredOcclusion
from wheretolook.weights.resolve import load_scorer


def room_map(n_landmarks: int, locations: Float, device: str) -> LocalizationMap:
    """Landmarks with attributes at random, mapped from the middle of the room."""
    rng = np.random.default_rng(0)
    points = room_landmarks(n_landmarks)
    offsets = points - np.mean(ROOM_M, axis=0)

    def some(low: float, high: float) -> np.ndarray:
        return rng.uniform(low, high, n_landmarks).astype(np.float32)

    distance = np.linalg.norm(offsets, axis=1)
    landmarks = Landmarks(
        np.arange(n_landmarks), points, rng.integers(2, 9, n_landmarks).astype(np.int32), some(0, 0.5), some(2, 40),
        (offsets / distance[:, None]).astype(np.float32), some(0, 1), distance.astype(np.float32), some(0, 0.5), None,
        some(0.5, 1),
    )  # fmt: skip
    occlusion = StoredOcclusion.from_mask(locations, rng.random((len(locations), n_landmarks)) < 0.5)
    return LocalizationMap(landmarks, PinholeCamera(), occlusion, device)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument(
        "--weights", type=Path, nargs="*", default=sorted(Path("data/release/weights").glob("*.safetensors"))
    )
    parser.add_argument("--landmarks", type=int, default=25_000)
    parser.add_argument("--locations", type=int, default=200)
    parser.add_argument("--directions", type=int, default=500)
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    rng = np.random.default_rng(1)
    low, high = np.array(ROOM_M)
    locations = rng.uniform(low + 0.5, high - 0.5, (args.locations, 3))
    localization_map = room_map(args.landmarks, locations, args.device)
    axes = fibonacci_sphere(args.directions)
    views = poses_looking_along(np.repeat(locations, len(axes), axis=0), np.tile(axes, (len(locations), 1)))
    seen = np.diff(localization_map.landmarks_in_view(views[:: max(1, len(views) // 1000)]).starts)
    cores = torch.get_num_threads()
    print(f"{len(views):,} views of {args.landmarks:,} landmarks, {np.median(seen):.0f} in view (up to {seen.max()})")
    print(f"on {args.device}, {cores} threads")
    scorers: dict[str, Scorer] = {"bins": make_scorer("bins", localization_map)}
    for path in args.weights:
        try:
            scorers[path.stem] = load_scorer(path, localization_map)
        except Exception as error:  # matchability is no scorer by itself
            print(f"{path.stem}: {error}")
    for name, scorer in scorers.items():
        median = timed(f"{name}: all views", lambda s=scorer: s.score(views), args.repeats)
        print(f"{'':62} {len(views) / median:,.0f} views a second")
        poses = iter(np.tile(views[rng.permutation(len(views))[:400]], (3, 1, 1)))
        timed(f"{name}: one pose", lambda s=scorer, p=poses: s.score(next(p)[None]), 200, 1e3, "ms")


if __name__ == "__main__":
    main()
