"""Measure visibility: occlusion rays, landmark counts and the best 100 directions, next to the plain NumPy twin.

    python tests/benchmarks/bench_visibility.py                           # one thread and all cores, the paper's size
    python tests/benchmarks/bench_visibility.py --device cuda --out h200.json
    python tests/benchmarks/bench_visibility.py --scaling --out scaling.json
    python tests/benchmarks/bench_visibility.py --draw laptop.json h200.json --figures FOLDER --log

The size is the paper's (Sec. "Runtimes"): 648 locations, 24,919 landmarks and the 500 directions of its released
configuration, in a synthetic apartment whose mesh is subdivided into at least 250,000 triangles.
"""

import contextlib
import ctypes
import gc
import json
import platform
import resource
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import trimesh
import warp as wp
from common import free_points, options, points_on_surface, seconds_of, show, write_csv

from wheretolook.figures.floor_plan import save_figure
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import rotation_looking_along
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.scenes.config import ApartmentConfig
from wheretolook.scenes.loading import load_mesh
from wheretolook.space.free_space import FreeSpace
from wheretolook.tracking import TrackingConfig
from wheretolook.utils.processes import cores
from wheretolook.utils.warp import start_warp
from wheretolook.visibility.counting import FrustumCounter, SurveyOptions, survey
from wheretolook.visibility.occlusion import DevicePoints, MeshOcclusion, NoOcclusion
from wheretolook_paper.figures.runtimes import runtime_figure, scaling_figure
from wheretolook_paper.release.runs import RUNTIMES_CSV, SCALING_CSV, log_runtimes
from wheretolook_rooms.generator import generate_apartment

CAMERA = PinholeCamera()
COUNTS = "counts alone"
EVERYTHING = "occlusion, counts, best 100"
TWIN = "NumPy twin, counts alone, scaled"

SCALING = {
    "landmarks": (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000, 2_000_000),
    "locations": (8, 16, 32, 64, 128, 256, 512, 1024, 2048, 5000),
    "directions": (50, 100, 200, 500, 1000, 2000, 5000),
}
BASE = {"landmarks": 24_919, "locations": 64, "directions": 500}


def subdivided(mesh, min_triangles):
    """Return an untextured copy of a mesh whose largest triangles are cut into four until there are `min_triangles`."""
    vertices = mesh.vertices.astype(np.float64)
    triangles = mesh.triangles
    while len(triangles) < min_triangles:
        largest = np.argsort(-trimesh.triangles.area(vertices[triangles]))
        cut = largest[: -(-(min_triangles - len(triangles)) // 3)]
        vertices, triangles = trimesh.remesh.subdivide(vertices, triangles, face_index=cut)
    n = len(triangles)
    corners = np.zeros((n, 3, 2), np.float32)
    texture = np.zeros((1, 1, 3), np.uint8)
    return TexturedMesh(
        vertices.astype(np.float32), triangles.astype(np.int32), corners, np.zeros(n, np.int32), (texture,)
    )


class Setup:
    """The mesh, landmarks, locations and occlusion of one run."""

    def __init__(self, args, device, n_landmarks, n_locations):
        self.rng = np.random.default_rng(0)
        base = load_mesh(args.scene) if args.scene else generate_apartment(ApartmentConfig(), 0, device=device)
        self.mesh = subdivided(base, args.triangles)
        self.points = points_on_surface(self.mesh, n_landmarks, self.rng)
        space = FreeSpace(self.mesh, device=device)
        self.locations = free_points(space, self.mesh.bounds, n_locations, self.rng)
        self.occlusion = MeshOcclusion(MeshRaycaster(self.mesh, device))
        self.device = device
        self.on_gpu = wp.get_device(device).is_cuda
        self.threads = 1 if self.on_gpu else cores()


class PeakMemory:
    """Measures the peak memory of a block: of the process, or of the device's pool."""

    def __init__(self, device):
        self.device = device
        self.bytes = 0

    def __enter__(self):
        gc.collect()
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL("libc.so.6").malloc_trim(0)  # otherwise reuse of freed memory would not be measured
        self._done = threading.Event()
        self._before = self._now()
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._done.set()
        self._thread.join()

    def _watch(self):
        while not self._done.wait(0.0005):
            self.bytes = max(self.bytes, self._now() - self._before)

    def _now(self):
        if wp.get_device(self.device).is_cuda:
            return int(wp.get_mempool_used_mem_current(self.device))
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def machine(device):
    """Return the name of the device and of the host's processor, and the number of usable cores."""
    host = platform.machine()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        host = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), host)
    name = wp.get_device(device).name if wp.get_device(device).is_cuda else host
    versions = {"warp": wp.__version__, "numpy": np.__version__}
    return {"device": device, "name": name, "host": host, "cores": cores(), **versions}


def paper_size(args, device):
    """Time every kind of work at the paper's size, print the times, and return a row for each."""
    setup = Setup(args, device, args.landmarks, args.locations)
    rotations = rotation_looking_along(fibonacci_sphere(args.directions))
    landmarks = DevicePoints(setup.points, device)
    counter = FrustumCounter(CAMERA, rotations, len(setup.points), device)
    size = {"locations": args.locations, "directions": args.directions, "landmarks": args.landmarks}
    size["triangles"] = len(setup.mesh.triangles)
    n = args.locations * args.directions * args.landmarks
    print(f"{size}: {n / 1e9:.2f} G projections; {machine(device)}")
    rows = []

    def add(what, threads, work, repeats=args.repeats, scale=1):
        times = seconds_of(work, repeats)
        times |= {name: scale * value for name, value in times.items() if name != "repeats"}
        row = {"what": what, "threads": threads, **size, **times, "scale": scale}
        row["projections_per_s"] = n / row["median_s"]
        rows.append(row)
        show(f"{what}, {threads} thread(s)", times, f"{row['projections_per_s'] / 1e9:.2f} G/s")

    shared = (CAMERA, rotations, setup.locations, landmarks)
    counts_only = {"keep": 1, "keep_occlusion": False}
    for threads in sorted({1, setup.threads}):
        add(EVERYTHING, threads, partial(survey, *shared, setup.occlusion, SurveyOptions(keep=100, threads=threads)))
        add(COUNTS, threads, partial(survey, *shared, NoOcclusion(), SurveyOptions(threads=threads, **counts_only)))
    if setup.on_gpu:

        def cast():
            mask = setup.occlusion.unoccluded_on_device(setup.locations, landmarks)
            wp.synchronize_device(device)
            return mask

        add("occlusion alone", 1, cast)
        add("occlusion, counts", 1, lambda: counter.count(setup.locations, landmarks.double, cast()).numpy())
    add("cells of the sphere (once)", 1, lambda: FrustumCounter(CAMERA, rotations, len(setup.points), device))
    some = setup.locations[setup.rng.choice(len(setup.locations), args.twin_locations, replace=False)]
    everything = np.ones((len(some), len(setup.points)), dtype=bool)
    from twins.visibility import count_plain

    twin = partial(count_plain, CAMERA, rotations, some, setup.points, everything)
    add(TWIN, 1, twin, args.twin_repeats, len(setup.locations) / len(some))
    print("counts equal the twin's:", np.array_equal(counter.count(some, landmarks.double).numpy(), twin()))
    mask = setup.occlusion.unoccluded(some, setup.points)
    seen = survey(CAMERA, rotations, some, landmarks, setup.occlusion, SurveyOptions(keep=100))
    masked = count_plain(CAMERA, rotations, some, setup.points, mask)
    print("counts with occlusion equal the twin's:", np.array_equal(seen.counts, masked))
    return rows


def scaling(args, device):
    """Measure how time and memory grow along each axis of `SCALING`, up to `--scaling-limit` of each."""
    axes = {axis: [value for value in values if value <= args.scaling_limit] for axis, values in SCALING.items()}
    base = {axis: min(value, max(axes[axis])) for axis, value in BASE.items()}
    setup = Setup(args, device, max(*axes["landmarks"], base["landmarks"]), max(*axes["locations"], base["locations"]))
    rows = []
    for axis, values in axes.items():
        for value in values:
            size = {**base, axis: value}
            rotations = rotation_looking_along(fibonacci_sphere(size["directions"]))
            landmarks = DevicePoints(setup.points[: size["landmarks"]], device)
            for what, model in (("with occlusion", setup.occlusion), (COUNTS, NoOcclusion())):
                work = partial(
                    survey, CAMERA, rotations, setup.locations[: size["locations"]], landmarks, model,
                    SurveyOptions(keep=100, keep_occlusion=model is setup.occlusion,
                                  memory_bytes=round(args.memory_gb * 1e9)),
                )  # fmt: skip
                n_rays = size["locations"] * size["landmarks"] if model is setup.occlusion else 0
                n_projections = size["locations"] * size["landmarks"] * size["directions"]
                slow = not setup.on_gpu and (n_projections > 5e10 or n_rays > 2e7)
                with PeakMemory(device) as peak:
                    times = seconds_of(work, 1 if slow else args.scaling_repeats)
                about = {"axis": axis, **size, "what": what, "threads": setup.threads}
                rows.append({**about, **times, "peak_bytes": peak.bytes})
                print(f"{axis:10} {value:9,} {what:15} {times['median_s']:10.4f} s {peak.bytes / 1e6:10,.1f} MB")
    return rows


def bounded(args, device):
    """Run 2 million landmarks x 5,000 locations within a memory bound; return its time and peak memory."""
    setup = Setup(args, device, 2_000_000, 5_000)
    rotations = rotation_looking_along(fibonacci_sphere(args.directions))
    occlusion = setup.occlusion if setup.on_gpu else NoOcclusion()
    start = time.perf_counter()
    with PeakMemory(device) as peak:
        survey(
            CAMERA,
            rotations,
            setup.locations,
            setup.points,
            occlusion,
            SurveyOptions(keep=100, device=device, progress="2 M landmarks", memory_bytes=round(args.memory_gb * 1e9)),
        )
    row = {"what": "bounded", "occlusion": type(occlusion).__name__, "seconds": time.perf_counter() - start}
    row |= {"peak_bytes": peak.bytes, "peak_rss_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024}
    print(row)
    return [row]


def draw(args):
    """Write tables and figures of earlier results, and log them to MLflow if asked to."""
    tables = [pd.read_csv(file) for file in args.draw if file.endswith(".csv")]
    results = [json.loads(Path(file).read_text()) for file in args.draw if not file.endswith(".csv")]
    sizes, growth = (
        pd.DataFrame([{**row, **result["machine"]} for result in results for row in result.get(part, [])])
        for part in ("paper_size", "scaling")
    )
    about = ["what", "threads", "name"]
    sizes = pd.concat([*tables, sizes], ignore_index=True).drop_duplicates(about, keep="last", ignore_index=True)
    folder = args.figures
    folder.mkdir(parents=True, exist_ok=True)
    save_figure(runtime_figure(sizes), folder / "runtimes.png")
    write_csv(sizes, folder / RUNTIMES_CSV)
    if len(growth):
        save_figure(scaling_figure(growth), folder / "visibility-scaling.png")
        write_csv(growth, folder / SCALING_CSV)
    if args.log:
        log_runtimes(TrackingConfig(), folder)


def main():
    """Parse the options and measure, or draw earlier results."""
    args = options(
        __doc__, scene=str, device="cpu", locations=648, directions=500, landmarks=24_919, triangles=250_000,
        repeats=20, twin_locations=2, twin_repeats=20, scaling=False, scaling_limit=2_000_000, scaling_repeats=5,
        bounded=False, memory_gb=2.0, out=Path, draw=[""], figures=Path("."), log=False,
    )  # fmt: skip
    if any(args.draw):
        draw(args)
        return
    device = start_warp(args.device)
    result = {"machine": machine(device), "paper_size": paper_size(args, device)}
    if args.scaling:
        result["scaling"] = scaling(args, device)
    if args.bounded:
        result["bounded"] = bounded(args, device)
    if args.out:
        args.out.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
