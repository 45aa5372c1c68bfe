"""Measure ten million queries of a viewpoint map from eight processes: consistency, time and memory.

    python tests/benchmarks/bench_queries.py [FOLDER] [--queries 10000000] [--processes 8]

Without the folder of a viewpoint map, a map of random scores with 4096 voxels and 500 directions (20 MB) is made. All
processes memory-map its files and query the best view at the same points in different orders, in batches of 10,000 and
for one point in a hundred also alone. All answers must be equal. Prints times, and the resident and unique memory of
the processes before and after.
"""

from __future__ import annotations

import argparse
import hashlib
import multiprocessing
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from wheretolook.geometry.lattices import VoxelGrid, fibonacci_sphere
from wheretolook.geometry.poses import Float
from wheretolook.planning.viewpoint_map import MapOrigin, ViewpointMap

BATCH = 10_000
ONE_BY_ONE = 100  # every such point is also queried alone


def random_map(folder: Path) -> Path:
    """Save a viewpoint map of random scores; return its folder."""
    rng = np.random.default_rng(0)
    grid = VoxelGrid((0.0, 0.0, 0.0), (16.0, 16.0, 16.0), (16, 16, 16))
    directions = fibonacci_sphere(500)
    scores = rng.random((len(grid), len(directions))).astype(np.float32)
    ranked = np.argsort(-scores, axis=1, kind="stable").astype(np.uint16)
    n_visible = rng.integers(0, 900, scores.shape).astype(np.uint32)
    origin = MapOrigin(
        "random", "fibonacci", {"model": "PINHOLE", "width": 1, "height": 1, "params": [1.0] * 4}, "none", ""
    )
    rows = np.arange(len(grid), dtype=np.int32)
    ids = np.arange(3, dtype=np.int64)
    digests = np.zeros((3, 2), dtype=np.uint64)
    ViewpointMap(grid, rows, directions, ranked, scores, n_visible, ids, digests, origin).save(folder)
    return folder


def memory_mb() -> tuple[float, float]:
    """Return resident and unique memory of this process in MB."""
    memory = psutil.Process().memory_full_info()
    return memory.rss / 1e6, memory.uss / 1e6


def query(folder: Path, n: int, number: int) -> tuple[str, float, float, tuple[float, float], tuple[float, float]]:
    """Return a digest of the answers to n queries, seconds of batches and of single queries, memory before and after."""
    viewpoint_map = ViewpointMap.load(folder, mmap=True)
    before = memory_mb()
    low = np.asarray(viewpoint_map.grid.lower)
    high = np.asarray(viewpoint_map.grid.upper)
    blocks = -(-n // BATCH)
    digests = [b""] * blocks
    batches_s = 0.0
    singles_s = 0.0
    for block in np.roll(np.arange(blocks), number * blocks // 8):
        points: Float = np.random.default_rng(int(block)).uniform(low, high, (min(BATCH, n - int(block) * BATCH), 3))
        start = time.perf_counter()
        found = viewpoint_map.best_many(points)
        batches_s += time.perf_counter() - start
        start = time.perf_counter()
        singles = [viewpoint_map.best(point) for point in points[::ONE_BY_ONE]]
        singles_s += time.perf_counter() - start
        for choice, row in zip(singles, range(0, len(points), ONE_BY_ONE), strict=True):
            if choice is not None and choice.direction_id != found.direction_id[row]:
                raise AssertionError(f"point {row} of block {block} has two answers")
        answers = b"".join(
            np.ascontiguousarray(part).tobytes() for part in (found.direction_id, found.score, found.n_visible)
        )
        digests[block] = hashlib.sha256(answers).digest()
    return hashlib.sha256(b"".join(digests)).hexdigest(), batches_s, singles_s, before, memory_mb()


def main() -> None:
    """Query from several processes and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--queries", type=int, default=10_000_000)
    parser.add_argument("--processes", type=int, default=8)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.folder or random_map(Path(temporary) / "map")
        n = -(-args.queries // args.processes)
        start = time.perf_counter()
        with multiprocessing.get_context("spawn").Pool(args.processes) as pool:
            results = pool.starmap(query, [(folder, n, number) for number in range(args.processes)])
        seconds = time.perf_counter() - start
    digests, batches, singles, before, after = zip(*results, strict=True)
    total = f"{n * args.processes:,} queries of {args.processes} processes"
    print(f"{total} in {seconds:.1f} s: {len(set(digests))} answer(s) to each")
    each = np.array(batches) / n * 1e6
    print(f"in batches {np.median(each):.2f} us each [{each.min():.2f}, {each.max():.2f}] wall time, by process")
    single = np.array(singles) / -(-n // ONE_BY_ONE) * 1e6
    print(f"one by one {np.median(single):.1f} us each [{single.min():.1f}, {single.max():.1f}]")
    for name, column in (("resident", 0), ("unique", 1)):
        was, now = (np.array(values)[:, column] for values in (before, after))
        print(f"memory of a process, {name}: {was.max():.0f} MB once loaded, {now.max():.0f} MB at the end (maximum)")
    if len(set(digests)) > 1:
        raise SystemExit("the processes got different answers")


if __name__ == "__main__":
    main()
