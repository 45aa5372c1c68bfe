"""How fast visibility is: occlusion, counts and the best 100, against the plain NumPy twin in the same run.

    python tests/benchmarks/bench_visibility.py                           # one thread and all cores, the paper's size
    python tests/benchmarks/bench_visibility.py --device cuda --out h200.json
    python tests/benchmarks/bench_visibility.py --scaling --out scaling.json
    python tests/benchmarks/bench_visibility.py --draw laptop.json h200.json --figures FOLDER --log
    python tests/benchmarks/bench_visibility.py --draw FOLDER/runtimes.csv h200.json --figures FOLDER  # adds one

The size is the paper's (Sec. "Runtimes"): 648 locations, 24,919 landmarks and the 500 directions of its released
configuration, in a synthetic apartment whose mesh is cut into at least 250,000 triangles. Nothing here fails on time.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import json
import os
import platform
import resource
import statistics
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import warp as wp

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import rotation_looking_along
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.scenes.loading import load_mesh
from wheretolook.space.free_space import FreeSpace
from wheretolook.utils.warp import start_warp
from wheretolook.visibility.counting import FrustumCounter, count_plain
from wheretolook.visibility.occlusion import DevicePoints, MeshOcclusion, NoOcclusion
from wheretolook.visibility.survey import survey

CAMERA = PinholeCamera()
FLOPS_PER_PROJECTION = 22
"""A plain projection: 9 multiplies and 6 additions of the rotation, 3 of the offset, 4 of focal length and centre."""


def with_triangles(mesh: TexturedMesh, least: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a mesh whose largest triangles are cut into four until there are `least`."""
    vertices = mesh.vertices.astype(np.float64)
    triangles = mesh.triangles
    while len(triangles) < least:
        a, b, c = np.moveaxis(vertices[triangles], 1, 0)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        cut = np.argsort(-area)[: -(-(least - len(triangles)) // 3)]
        n = len(vertices)
        m = len(cut)
        a, b, c = np.moveaxis(vertices[triangles[cut]], 1, 0)
        vertices = np.concatenate([vertices, (a + b) / 2, (b + c) / 2, (c + a) / 2])
        ab = n + np.arange(m)
        bc = n + m + np.arange(m)
        ca = n + 2 * m + np.arange(m)
        i, j, k = triangles[cut].T
        parts = np.concatenate([np.stack(part, 1) for part in ((i, ab, ca), (ab, j, bc), (ca, bc, k), (ab, bc, ca))])
        triangles = np.concatenate([np.delete(triangles, cut, 0), parts])
    return vertices.astype(np.float32), triangles.astype(np.int32)


def untextured(vertices: np.ndarray, triangles: np.ndarray) -> TexturedMesh:
    return TexturedMesh(vertices, triangles, np.zeros((len(triangles), 3, 2), np.float32),
                        np.zeros(len(triangles), np.int32), (np.zeros((1, 1, 3), np.uint8),))  # fmt: skip


def on_surface(mesh: TexturedMesh, number: int, rng: np.random.Generator) -> np.ndarray:
    """Points spread over a mesh by area, 5 mm off, as landmarks are."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles].astype(np.float64), 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    rows = rng.choice(len(area), number, p=area / area.sum())
    u, v = rng.random((2, number, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a[rows] + u * (b - a)[rows] + v * (c - a)[rows] + rng.normal(scale=0.005, size=(number, 3))


def free_points(mesh: TexturedMesh, number: int, rng: np.random.Generator, device: str) -> np.ndarray:
    free_space = FreeSpace(mesh, device=device)
    found = np.empty((0, 3))
    while len(found) < number:
        candidates = rng.uniform(*mesh.bounds, (20_000, 3))
        found = np.concatenate([found, candidates[free_space.is_free(candidates)]])
    return found[:number]


class Peak:
    """The most memory in use while a block runs: of the process, or of the device's pool."""

    def __init__(self, device: str) -> None:
        self.device = device
        self.bytes = 0

    def __enter__(self) -> Peak:
        gc.collect()
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL("libc.so.6").malloc_trim(0)  # or memory kept from earlier would not be seen to be used again
        self._done = threading.Event()
        self._before = self._now()
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._done.wait(0.0005):
            self.bytes = max(self.bytes, self._now() - self._before)

    def _now(self) -> int:
        if wp.get_device(self.device).is_cuda:
            return int(wp.get_mempool_used_mem_current(self.device))
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def timed(work: Callable[[], object], repeats: int) -> dict[str, float]:
    """Median, least and most seconds over repeats, after one run to warm up."""
    work()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return {"median_s": statistics.median(seconds), "min_s": min(seconds), "max_s": max(seconds), "repeats": repeats}


@wp.kernel
def _multiply_add_kernel(n: wp.int32, out: wp.array[wp.float32]):
    i = wp.tid()
    a = wp.float32(i)
    b = wp.float32(i + 1)
    c = wp.float32(i + 2)
    d = wp.float32(i + 3)
    e = wp.float32(i + 4)
    f = wp.float32(i + 5)
    g = wp.float32(i + 6)
    h = wp.float32(i + 7)
    for _ in range(n):
        a = a * 0.999 + 0.5
        b = b * 0.999 + 0.5
        c = c * 0.999 + 0.5
        d = d * 0.999 + 0.5
        e = e * 0.999 + 0.5
        f = f * 0.999 + 0.5
        g = g * 0.999 + 0.5
        h = h * 0.999 + 0.5
    out[i] = a + b + c + d + e + f + g + h


def peak_flops(device: str) -> float:
    """Single-precision multiply-adds a second that independent chains reach here, times two."""
    threads, n = (1 << 21, 2048) if wp.get_device(device).is_cuda else (256, 1 << 16)
    out = wp.empty(threads, dtype=wp.float32, device=device)

    def work() -> None:
        wp.launch(_multiply_add_kernel, threads, [n], [out], device=device)
        wp.synchronize_device(device)

    return threads * n * 8 * 2 / timed(work, 5)["min_s"]


def machine(device: str) -> dict[str, Any]:
    host = platform.machine()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        host = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), host)
    name = wp.get_device(device).name if wp.get_device(device).is_cuda else host
    versions = {"warp": wp.__version__, "numpy": np.__version__}
    return {"device": device, "name": name, "host": host, "cores": len(os.sched_getaffinity(0)), **versions}


def paper_size(args: argparse.Namespace, device: str) -> list[dict[str, Any]]:
    from wheretolook.scenes.config import ApartmentConfig
    from wheretolook_rooms.generator import generate_apartment

    rng = np.random.default_rng(0)
    base = load_mesh(args.scene) if args.scene else generate_apartment(ApartmentConfig(), 0, device=device)
    mesh = untextured(*with_triangles(base, args.triangles))
    points = on_surface(mesh, args.landmarks, rng)
    locations = free_points(mesh, args.locations, rng, device)
    rotations = rotation_looking_along(fibonacci_sphere(args.directions))
    n = len(locations) * len(rotations) * len(points)
    landmarks = DevicePoints(points, device)
    occlusion = MeshOcclusion(MeshRaycaster(mesh, device))
    counter = FrustumCounter(CAMERA, rotations, len(points), device)
    print(f"{len(mesh.triangles):,} triangles, {len(locations)} locations, {len(rotations)} directions, "
          f"{len(points):,} landmarks: {n / 1e9:.2f} G projections; {machine(device)}")  # fmt: skip
    on_gpu = wp.get_device(device).is_cuda
    rows: list[dict[str, Any]] = []
    size = {"locations": len(locations), "directions": len(rotations), "landmarks": len(points),
            "triangles": len(mesh.triangles)}  # fmt: skip

    def add(what: str, threads: int, work: Callable[[], object], repeats: int = args.repeats) -> None:
        row = {"what": what, "threads": threads, **size, **timed(work, repeats)}
        row["projections_per_s"] = n / row["median_s"]
        rows.append(row)
        spread = f"({1e3 * row['min_s']:,.2f} to {1e3 * row['max_s']:,.2f}, {repeats} repeats)"
        rate = f"{row['projections_per_s'] / 1e9:10,.2f} G/s"
        print(f"{what:32} {threads} thread(s): {1e3 * row['median_s']:12,.2f} ms  {spread}, {rate}")

    def everything(threads: int) -> object:
        return survey(CAMERA, rotations, locations, landmarks, occlusion, keep=100, threads=threads)

    def counts_alone(threads: int) -> object:
        return survey(CAMERA, rotations, locations, landmarks, NoOcclusion(), keep=1, keep_occlusion=False,
                      threads=threads)  # fmt: skip

    for threads in (1,) if on_gpu else sorted({1, len(os.sched_getaffinity(0))}):
        add("occlusion, counts, best 100", threads, lambda threads=threads: everything(threads))
        add("counts alone", threads, lambda threads=threads: counts_alone(threads))
    if on_gpu:
        rays = occlusion.raycaster

        def cast() -> None:
            rays.unoccluded_on_device(locations, landmarks.single, 0.05)
            wp.synchronize_device(device)

        add("occlusion alone", 1, cast)

        def unoccluded() -> object:
            mask = rays.unoccluded_on_device(locations, landmarks.single, 0.05)
            return counter.count(locations, landmarks.double, mask).numpy()

        add("occlusion, counts", 1, unoccluded)
    add("cells of the sphere (once)", 1, lambda: FrustumCounter(CAMERA, rotations, len(points), device))

    some = rng.choice(len(locations), args.twin_locations, replace=False)
    everywhere = np.ones((len(some), len(points)), dtype=bool)
    plain: dict[str, np.ndarray] = {}

    def twin() -> None:
        plain["counts"] = count_plain(CAMERA, rotations, locations[some], points, everywhere)

    twin_time = timed(twin, args.twin_repeats)
    scale = len(locations) / len(some)
    row = {"what": "NumPy twin, counts alone, scaled", "threads": 1, **size, "repeats": args.twin_repeats,
           "scale": scale,
           **{key: twin_time[key] * scale for key in ("median_s", "min_s", "max_s")}}  # fmt: skip
    rows.append({**row, "projections_per_s": n / row["median_s"]})
    print(f"{row['what']:32} 1 thread(s): {row['median_s']:12,.1f} s   ({row['min_s']:,.1f} to {row['max_s']:,.1f}, "
          f"{args.twin_repeats} repeats on {len(some)} locations)")  # fmt: skip
    for ours in [row for row in rows if row["what"] in ("counts alone", "occlusion, counts, best 100")]:
        times = rows[-1]["median_s"] / ours["median_s"]
        print(f"{ours['what']}, {ours['threads']} thread(s): {times:,.1f} times as fast as the twin's counts alone")
    counts = counter.count(locations[some], landmarks.double).numpy()
    print("counts equal the twin's:", bool(np.array_equal(counts, plain["counts"])))
    seen = survey(CAMERA, rotations, locations[some], landmarks, occlusion, keep=100)
    mask = occlusion.unoccluded(locations[some], points)
    masked = count_plain(CAMERA, rotations, locations[some], points, mask)
    print(
        "counts with occlusion equal the twin's:", bool(np.array_equal(seen.counts, masked)), f"{mask.mean():.1%} free"
    )
    if on_gpu:
        flops = peak_flops(device)
        alone = next(row for row in rows if row["what"] == "counts alone")
        share = alone["projections_per_s"] * FLOPS_PER_PROJECTION / flops
        rows.append({"what": "peak", "threads": 1, "flops": flops, "equivalent_share_of_peak": share})
        print(f"measured peak {flops / 1e12:.1f} TFLOP/s in single precision; projecting everything as fast as counts "
              f"alone would take {share:.0%} of it, at {FLOPS_PER_PROJECTION} operations a projection")  # fmt: skip
    return rows


SCALING = {
    "landmarks": (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000, 2_000_000),
    "locations": (8, 16, 32, 64, 128, 256, 512, 1024, 2048, 5000),
    "directions": (50, 100, 200, 500, 1000, 2000, 5000),
}
BASE = {"landmarks": 24_919, "locations": 64, "directions": 500}


def scaling(args: argparse.Namespace, device: str) -> list[dict[str, Any]]:
    from wheretolook.scenes.config import ApartmentConfig
    from wheretolook_rooms.generator import generate_apartment

    rng = np.random.default_rng(0)
    base = load_mesh(args.scene) if args.scene else generate_apartment(ApartmentConfig(), 0, device=device)
    mesh = untextured(*with_triangles(base, args.triangles))
    points = on_surface(mesh, max(SCALING["landmarks"]), rng)
    locations = free_points(mesh, max(SCALING["locations"]), rng, device)
    occlusion = MeshOcclusion(MeshRaycaster(mesh, device))
    on_gpu = wp.get_device(device).is_cuda
    rows = []
    for axis, values in SCALING.items():
        for value in values:
            size = {**BASE, axis: value}
            rotations = rotation_looking_along(fibonacci_sphere(size["directions"]))
            landmarks = DevicePoints(points[: size["landmarks"]], device)
            for what, model in (("with occlusion", occlusion), ("counts alone", NoOcclusion())):
                work = partial(
                    survey, CAMERA, rotations, locations[: size["locations"]], landmarks, model, keep=100,
                    keep_occlusion=model is occlusion, memory_bytes=round(args.memory_gb * 1e9),
                )  # fmt: skip
                n = size["locations"] * size["directions"] * size["landmarks"]
                slow = not on_gpu and (n > 5e10 or (model is occlusion and size["locations"] * size["landmarks"] > 2e7))
                with Peak(device) as peak:
                    found = timed(work, 1 if slow else args.scaling_repeats)
                threads = 1 if on_gpu else len(os.sched_getaffinity(0))
                rows.append({"axis": axis, **size, "what": what, "threads": threads, **found, "peak_bytes": peak.bytes})
                print(f"{axis:10} {value:9,} {what:15} {found['median_s']:10.4f} s {peak.bytes / 1e6:10,.1f} MB")
    return rows


def bounded(args: argparse.Namespace, device: str) -> list[dict[str, Any]]:
    """2 million landmarks x 5,000 locations within the memory allowed."""
    from wheretolook.scenes.config import ApartmentConfig
    from wheretolook_rooms.generator import generate_apartment

    rng = np.random.default_rng(0)
    mesh = untextured(*with_triangles(generate_apartment(ApartmentConfig(), 0, device=device), args.triangles))
    points = on_surface(mesh, 2_000_000, rng)
    locations = free_points(mesh, 5_000, rng, device)
    occlusion = MeshOcclusion(MeshRaycaster(mesh, device)) if wp.get_device(device).is_cuda else NoOcclusion()
    rotations = rotation_looking_along(fibonacci_sphere(args.directions))
    start = time.perf_counter()
    with Peak(device) as peak:
        survey(CAMERA, rotations, locations, points, occlusion, keep=100, device=device, progress="2 M landmarks",
               memory_bytes=round(args.memory_gb * 1e9))  # fmt: skip
    rss = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    row = {"what": "bounded", "occlusion": type(occlusion).__name__, "seconds": time.perf_counter() - start,
           "peak_bytes": peak.bytes, "peak_rss_bytes": rss}  # fmt: skip
    print(row)
    return [row]


def rows_of(file: Path, part: str) -> list[dict[str, Any]]:
    """Rows of results of an earlier run, or of a table made of such."""
    if file.suffix == ".csv":
        return pd.read_csv(file).to_dict("records") if part == "paper_size" else []
    result = json.loads(file.read_text())
    return [{**row, **result["machine"]} for row in result.get(part, [])]


def draw(args: argparse.Namespace) -> None:
    from wheretolook.figures.style import save_figure
    from wheretolook.utils.tracking_config import TrackingConfig
    from wheretolook_paper.figures.runtimes import runtime_figure, scaling_figure
    from wheretolook_paper.release.benchmark_runs import RUNTIMES_CSV, SCALING_CSV, log_runtimes

    sizes, growth = (
        pd.DataFrame([row for file in args.draw for row in rows_of(Path(file), part)])
        for part in ("paper_size", "scaling")
    )
    folder = Path(args.figures)
    folder.mkdir(parents=True, exist_ok=True)
    save_figure(runtime_figure(sizes), folder / "runtimes.png")
    sizes.to_csv(folder / RUNTIMES_CSV, index=False, float_format="%.6g", lineterminator="\n")
    if len(growth):
        save_figure(scaling_figure(growth), folder / "visibility-scaling.png")
        growth.to_csv(folder / SCALING_CSV, index=False, float_format="%.6g", lineterminator="\n")
    if args.log:
        log_runtimes(TrackingConfig(), sizes, growth)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", help="mesh file; default: a synthetic apartment")
    parser.add_argument("--device", default="cpu", help="Warp's device")
    parser.add_argument("--locations", type=int, default=648)
    parser.add_argument("--directions", type=int, default=500)
    parser.add_argument("--landmarks", type=int, default=24_919)
    parser.add_argument("--triangles", type=int, default=250_000, help="least number of triangles")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--twin-locations", type=int, default=2, help="the twin runs on these, its time is scaled up")
    parser.add_argument("--twin-repeats", type=int, default=20)
    parser.add_argument("--scaling", action="store_true", help="how time and memory grow, too")
    parser.add_argument("--scaling-repeats", type=int, default=5)
    parser.add_argument("--bounded", action="store_true", help="2 million landmarks x 5,000 locations, too")
    parser.add_argument("--memory-gb", type=float, default=2.0, help="bound on the blocks in work")
    parser.add_argument("--out", help="write the results to this JSON file")
    parser.add_argument("--draw", nargs="+", metavar="JSON", help="draw earlier results, or a table of such")
    parser.add_argument("--figures", default=".", help="folder for figures and tables")
    parser.add_argument("--log", action="store_true", help="log tables and figures to MLflow")
    args = parser.parse_args()
    if args.draw:
        draw(args)
        return
    device = start_warp(args.device)
    result: dict[str, Any] = {"machine": machine(device), "paper_size": paper_size(args, device)}
    if args.scaling:
        result["scaling"] = scaling(args, device)
    if args.bounded:
        result["bounded"] = bounded(args, device)
    if args.out:
        Path(args.out).write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
