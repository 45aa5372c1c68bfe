"""Measure how costs grow with the landmarks of a map and with the locations at which views are scored.

    python tests/benchmarks/bench_scale.py --landmarks 2500 25000 250000 2500000 --locations 1 10 100 1000 --out scale.csv
    python tests/benchmarks/bench_scale.py --draw scale.csv --figure scale.webp

A building of rooms, 2,500 landmarks in each, so that a larger map is a larger building. Times are CPU seconds of one
core, medians over repeats: matching 2,000 keypoints with the map (from 200,000 landmarks on by the index), counting the
landmarks in 500 views at a location as if walls were transparent, and scoring 500 views at each location with the
default scorer, where landmarks of other rooms are occluded.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from common import ROOM_M, room_map, use_one_thread

from wheretolook.features.extractor import quantize_descriptors
from wheretolook.features.matches import match
from wheretolook.features.matching import DescriptorIndex, DescriptorMatcher, has_index
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import Float, rotation_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.map import Map
from wheretolook.scorers.weights import load_scorer
from wheretolook.utils.warp import start_warp
from wheretolook.visibility.counting import SurveyOptions, survey
from wheretolook.visibility.occlusion import DevicePoints, NoOcclusion, StoredOcclusion

IN_ROOM = 2_500  # landmarks
PITCH_M = 12.0  # between rooms
ROOMS_IN_ROW = 32
KEYPOINTS = 2_000
MATCHED = "match an image"
COUNTED = "count the landmarks of 500 views"
SCORED = "score 500 views at each location"


def seconds_of(work: Callable[[], object], repeats: int) -> list[float]:
    """Return the CPU seconds of each repeat after one that is not counted."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return times


def room_offset(room: np.ndarray) -> Float:
    """Return the positions (N, 3) m of rooms by their numbers (N,), in rows of `ROOMS_IN_ROW`."""
    return np.column_stack([room % ROOMS_IN_ROW, room // ROOMS_IN_ROW, np.zeros(len(room))]) * PITCH_M


def building(n: int) -> tuple[Landmarks, np.ndarray]:
    """Return n landmarks in rooms, and the room (n,) of each."""
    landmarks = room_map(n, np.zeros((1, 3)), "cpu").landmarks
    room = np.arange(n) // IN_ROOM
    return replace(landmarks, points=landmarks.points + room_offset(room)), room


def scoring(landmarks: Landmarks, room: np.ndarray, count: int) -> Callable[[], object]:
    """Return the work of scoring 500 views at each of `count` locations in random rooms."""
    rng = np.random.default_rng(1)
    chosen = rng.integers(0, room.max() + 1, count)
    locations = room_offset(chosen) + rng.uniform(*ROOM_M, (count, 3)) * (0.5, 0.5, 1)
    occlusion = StoredOcclusion.from_mask(locations, room == chosen[:, None])
    scorer = load_scorer(LocalizationMap(Map(landmarks), PinholeCamera(), occlusion, "cpu"))
    axes = fibonacci_sphere(500)
    return lambda: scorer.score_directions(locations, axes)


def matching(n: int) -> tuple[str, Callable[[], object]]:
    """Return what matches an image with n landmarks, exactly or by the index, and the work of one image."""
    rng = np.random.default_rng(0)
    stored = np.empty((n, 128), dtype=np.uint8)
    for start in range(0, n, 100_000):
        part = rng.gamma(0.3, size=(min(100_000, n - start), 128))
        stored[start : start + len(part)] = quantize_descriptors(part / np.linalg.norm(part, axis=1, keepdims=True))
    queries = stored[rng.integers(0, n, KEYPOINTS)]
    matcher = DescriptorIndex(stored) if has_index(n, "cpu") else DescriptorMatcher(stored)
    kind = "index" if isinstance(matcher, DescriptorIndex) else "exact"
    return kind, lambda: match(matcher, [queries], 0.85, 16)


def counting(landmarks: Landmarks, locations: Float, repeats: int) -> list[float]:
    """Return the times of counting the landmarks in 500 views at a location, whatever occludes them."""
    rotations = rotation_looking_along(fibonacci_sphere(500))
    points = DevicePoints(landmarks.points, "cpu")
    options = SurveyOptions(keep=1, keep_occlusion=False)
    return seconds_of(
        lambda: survey(PinholeCamera(), rotations, locations[:1], points, NoOcclusion(), options), repeats
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--landmarks", type=int, nargs="+", default=[2_500, 25_000, 250_000, 2_500_000])
    parser.add_argument("--locations", type=int, nargs="+", default=[1, 10, 100, 1_000])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("scale.csv"))
    parser.add_argument("--draw", type=Path, help="a table to draw instead of measuring")
    parser.add_argument("--figure", type=Path, default=Path("scale.webp"))
    args = parser.parse_args()
    if args.draw is not None:
        draw(pd.read_csv(args.draw), args.figure)
        return
    start_warp("cpu")
    use_one_thread()
    rows: list[dict[str, object]] = []

    def add(what: str, size: int, times: list[float], about: str = "") -> None:
        rows.append({"what": what, "size": size, "about": about, "median_s": np.median(times),
                     "min_s": min(times), "max_s": max(times)})  # fmt: skip
        print(
            f"{what:34} {size:10,} {np.median(times):10.4f} s [{min(times):.4f}, {max(times):.4f}] {about}", flush=True
        )

    for n in args.landmarks:
        landmarks, _ = building(n)
        add(COUNTED, n, counting(landmarks, np.array([[0.0, 0.0, 1.3]]), args.repeats))
        kind, work = matching(n)
        add(MATCHED, n, seconds_of(work, args.repeats), kind)
    landmarks, room = building(10 * IN_ROOM)
    for count in args.locations:
        add(SCORED, count, seconds_of(scoring(landmarks, room, count), max(1, args.repeats // 2)))
    pd.DataFrame(rows).to_csv(args.out, index=False, float_format="%.6g", lineterminator="\n")


def draw(table: pd.DataFrame, path: Path) -> None:
    """Draw times by the number of landmarks, and by the number of locations, on logarithmic axes."""
    import matplotlib.pyplot as plt

    from wheretolook.figures.floor_plan import save_figure

    figure, axes = plt.subplots(1, 2, figsize=(8, 3.2), layout="constrained")
    for axis, names, label in ((axes[0], (MATCHED, COUNTED), "landmarks"), (axes[1], (SCORED,), "locations")):
        for name in names:
            part = table[table["what"] == name]
            axis.plot(part["size"], part["median_s"], "o-", label=name)
        axis.set(xscale="log", yscale="log", xlabel=label, ylabel="CPU seconds, one core")
        axis.grid(alpha=0.3)
        axis.legend(frameon=False, loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.2)
    by_index = table[(table["what"] == MATCHED) & (table["about"] == "index")]
    if len(by_index):
        first = by_index.iloc[0]
        axes[0].annotate("index", (first["size"], first["median_s"]), (0, -14), textcoords="offset points", ha="center")
    save_figure(figure, path)


if __name__ == "__main__":
    main()
