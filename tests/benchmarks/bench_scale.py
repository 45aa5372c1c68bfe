"""Measure how costs grow with the landmarks of a map and with the locations at which views are scored.

    python tests/benchmarks/bench_scale.py --landmarks 2500 25000 250000 2500000 --locations 1 10 100 1000 --out scale.csv
    python tests/benchmarks/bench_scale.py --draw scale.csv --figure scale.webp

A building of rooms, 2,500 landmarks in each, so that a larger map is a larger building. Times are CPU seconds of one
core, medians over repeats: matching 2,000 keypoints with the map (from 200,000 landmarks on by the index), counting the
landmarks in 500 views at a location as if walls were transparent, and scoring 500 views at each location with the
default scorer, where landmarks of other rooms are occluded.
"""

import time
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from common import ROOM_M, options, room_map, seconds_of, show, use_one_thread, write_csv

from wheretolook.features.extractor import quantize_descriptors
from wheretolook.features.matches import match
from wheretolook.features.matching import DescriptorIndex, DescriptorMatcher, has_index
from wheretolook.figures.floor_plan import RC
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import rotation_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
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


def room_offset(room):
    """Return the positions (N, 3) m of rooms by their numbers (N,), in rows of `ROOMS_IN_ROW`."""
    return np.column_stack([room % ROOMS_IN_ROW, room // ROOMS_IN_ROW, np.zeros(len(room))]) * PITCH_M


def building(n):
    """Return n landmarks in rooms, and the room (n,) of each."""
    landmarks = room_map(n, np.zeros((1, 3)), "cpu").landmarks
    room = np.arange(n) // IN_ROOM
    return replace(landmarks, points=landmarks.points + room_offset(room)), room


def scoring(landmarks, room, count):
    """Return the work of scoring 500 views at each of `count` locations in random rooms."""
    rng = np.random.default_rng(1)
    chosen = rng.integers(0, room.max() + 1, count)
    locations = room_offset(chosen) + rng.uniform(*ROOM_M, (count, 3)) * (0.5, 0.5, 1)
    occlusion = StoredOcclusion.from_mask(locations, room == chosen[:, None])
    scorer = load_scorer(LocalizationMap(Map(landmarks), PinholeCamera(), occlusion, "cpu"))
    axes = fibonacci_sphere(500)
    return lambda: scorer.score_directions(locations, axes)


def matching(n):
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


def counting(landmarks):
    """Return the work of counting the landmarks in 500 views at a location, whatever occludes them."""
    rotations = rotation_looking_along(fibonacci_sphere(500))
    points = DevicePoints(landmarks.points, "cpu")
    place = np.array([[0.0, 0.0, 1.3]])
    chosen = SurveyOptions(keep=1, keep_occlusion=False)
    return lambda: survey(PinholeCamera(), rotations, place, points, NoOcclusion(), chosen)


def main():
    args = options(
        __doc__, landmarks=[2_500, 25_000, 250_000, 2_500_000], locations=[1, 10, 100, 1_000], repeats=5,
        out=Path("scale.csv"), draw=Path, figure=Path("scale.webp"),
    )  # fmt: skip
    if args.draw is not None:
        draw(pd.read_csv(args.draw), args.figure)
        return
    start_warp("cpu")
    use_one_thread()
    rows = []

    def add(what, size, work, repeats, about=""):
        times = seconds_of(work, repeats, time.process_time)
        rows.append({"what": what, "size": size, "about": about, **times})
        show(f"{what}, {size:,}", times, about)

    for n in args.landmarks:
        landmarks, _ = building(n)
        add(COUNTED, n, counting(landmarks), args.repeats)
        kind, work = matching(n)
        add(MATCHED, n, work, args.repeats, kind)
    landmarks, room = building(10 * IN_ROOM)
    for count in args.locations:
        add(SCORED, count, scoring(landmarks, room, count), max(1, args.repeats // 2))
    write_csv(pd.DataFrame(rows), args.out)


def draw(table, path):
    """Draw times by the number of landmarks, and by the number of locations, on logarithmic axes."""
    mpl.rcParams.update(RC)
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
    figure.savefig(path, pil_kwargs={"lossless": True})


if __name__ == "__main__":
    main()
