"""How fast keypoints find their two nearest landmarks: `DescriptorMatcher` against a plain product with `torch.topk`.

    python tests/benchmarks/bench_matching.py
    python tests/benchmarks/bench_matching.py --device cuda --landmarks 100000 --out h200.json

The plain side keeps unit descriptors in single precision (half precision on a GPU) and takes the two largest of each
row of `queries @ landmarks.T`. Both sides get the keypoints of one image in NumPy, as they store them, and return
NumPy, in turns, on one core. CPU times leave out what other processes took of the core. Nothing here fails on time.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bench_scenes
import numpy as np
import torch
from numpy.typing import NDArray

from wheretolook.features.descriptors import quantize_descriptors, unit_descriptors
from wheretolook.features.matching import DescriptorMatcher


def descriptors_like_sift(n: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """RootSIFT of length 512: many small values and a few large ones."""
    return quantize_descriptors(unit_descriptors(np.sqrt(rng.exponential(size=(n, 128)) ** 2)))


def plain(landmarks: NDArray[np.uint8], device: str) -> Callable[[NDArray[np.float32]], NDArray[Any]]:
    """The product and the two best of each row, of which rows of landmarks are returned."""
    number = torch.float32 if device == "cpu" else torch.float16
    stored = torch.from_numpy(unit_descriptors(landmarks)).to(device, number)

    def nearest_two(queries: NDArray[np.float32]) -> NDArray[Any]:
        product = torch.from_numpy(queries).to(device, number) @ stored.T
        return torch.topk(product, 2).indices.cpu().numpy()

    return nearest_two


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keypoints", type=int, default=1000, help="of an image (default: %(default)s)")
    parser.add_argument("--landmarks", type=int, default=20_000, help="of the map (default: %(default)s)")
    parser.add_argument("--repeats", type=int, default=20, help="of each side (default: %(default)s)")
    parser.add_argument("--device", default="cpu", help="cpu or cuda (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the descriptors (default: %(default)s)")
    parser.add_argument("--out", type=Path, help="write all numbers to this JSON file")
    args = parser.parse_args()
    bench_scenes.use_one_thread()
    rng = np.random.default_rng(args.seed)
    landmarks = descriptors_like_sift(args.landmarks, rng)
    queries = descriptors_like_sift(args.keypoints, rng)
    unit_queries = unit_descriptors(queries)
    matcher = DescriptorMatcher(landmarks, args.device)
    by_topk = plain(landmarks, args.device)
    sides: dict[str, Callable[[], Any]] = {
        "DescriptorMatcher": lambda: matcher.nearest_two(queries),
        "product and topk": lambda: by_topk(unit_queries),
    }
    times: dict[str, list[float]] = {name: [] for name in sides}
    cpu_times: dict[str, list[float]] = {name: [] for name in sides}
    for repeat in range(args.repeats + 2):
        for name, run in sides.items():
            start = time.perf_counter()
            cpu_start = time.process_time()
            run()  # returns on the CPU: a GPU has finished then
            if repeat >= 2:  # what is set up on the first calls is not measured
                times[name].append(1e3 * (time.perf_counter() - start))
                cpu_times[name].append(1e3 * (time.process_time() - cpu_start))
    agree = np.mean(matcher.nearest_two(queries)[0] == by_topk(unit_queries)[:, 0])

    print(f"{args.keypoints:,} keypoints x {args.landmarks:,} landmarks on {args.device}, {args.repeats} times, ms:")
    for name, values in times.items():
        wall, cpu = (bench_scenes.format_spread(bench_scenes.spread(part), 2) for part in (values, cpu_times[name]))
        print(f"  {name:18} {wall}, least {min(values):,.2f}; CPU {cpu}")
    ratio = np.median(times["product and topk"]) / np.median(times["DescriptorMatcher"])
    print(f"  {ratio:.1f} times as fast; the same nearest landmark for {agree:.2%} of keypoints")
    settings = {name: str(value) if isinstance(value, Path) else value for name, value in vars(args).items()}
    report = {
        "settings": settings,
        "ms": {name: bench_scenes.spread(values) for name, values in times.items()},
        "cpu_ms": {name: bench_scenes.spread(values) for name, values in cpu_times.items()},
        "ratio": float(ratio),
        "same_nearest": float(agree),
    }
    bench_scenes.write_report(args.out, report)


if __name__ == "__main__":
    main()
