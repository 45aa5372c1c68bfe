"""Measure learned scorers: viewpoints per second from landmarks to scores, and the time of one inference step.

    python tests/benchmarks/bench_scorers.py [--device cuda] [--weights data/release/weights/set.safetensors ...]
    python tests/benchmarks/bench_scorers.py --step --out step.json
    python tests/benchmarks/bench_visibility.py --draw data/release/results/runtimes.csv step.json --figures FOLDER

The map has 25,000 landmarks on the walls of a room; a random half is occluded from each location. A batch holds every
direction at many locations. The time runs from poses and unoccluded landmarks to scores in host memory.
"""

import itertools
import json
from pathlib import Path

import numpy as np
import torch
from bench_visibility import machine
from common import ROOM_M, options, room_map, seconds_of, show, timed

from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.scorers.registry import make_scorer
from wheretolook.scorers.weights import load_scorer
from wheretolook.utils.errors import WhereToLookError
from wheretolook.utils.package import WEIGHTS, shipped


def main():
    """Parse the options, measure and print a table."""
    weights = sorted(shipped(WEIGHTS).glob("*.safetensors"))
    args = options(
        __doc__, device="cpu", weights=weights, landmarks=25_000, locations=200, directions=500, repeats=5, poses=200,
        step=False, out=Path,
    )  # fmt: skip
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
    scorers = {"bins": make_scorer("bins", localization_map)}
    for path in args.weights:
        try:
            scorers[path.stem] = load_scorer(localization_map, path)
        except WhereToLookError as error:  # matchability is no scorer by itself
            print(f"{path.stem}: {error}")
    if args.step:
        rows = inference_steps(scorers, views.reshape(len(locations), len(axes), 3, 4), args.landmarks, args.poses)
        if args.out:
            args.out.write_text(json.dumps({"machine": machine(args.device), "paper_size": rows}, indent=1))
        return
    for name, scorer in scorers.items():
        median = timed(f"{name}: all views", lambda s=scorer: s.score(views), args.repeats)
        print(f"{'':62} {len(views) / median:,.0f} views a second")


def inference_steps(scorers, views, landmarks, repeats):
    """Return rows of `runtimes.csv`: the time to score all directions of one location, and one pose.

    `views` (L, D, 3, 4) are poses by location; each repeat is at the next location.
    """
    rows = []
    for name, scorer in scorers.items():
        for what, directions, times_each in (("one location", views.shape[1], 1), ("one pose", 1, 20)):
            steps = itertools.cycle(views[:, :directions])
            # Single poses are so short that few of them measure what else the machine does at that moment.
            times = seconds_of(lambda s=scorer, p=steps: s.score(next(p)), times_each * repeats)
            size = {"locations": 1, "directions": directions, "landmarks": landmarks}
            rows.append({"what": f"{name}, {what}", "threads": torch.get_num_threads(), **size, **times})
            show(f"{name}, {what}", times)
    return rows


if __name__ == "__main__":
    main()
