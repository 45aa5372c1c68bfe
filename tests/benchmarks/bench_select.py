"""Times of `wheretolook select`: a map of N landmarks in a building of rooms, W waypoints, D directions.

Run as a script; nothing fails on time. Prints median and spread (lowest, highest) over repetitions: wall time, and
time of all the process's CPU cores, which other programs on the machine disturb less. With --process the command
itself is run, start and reading of the map included, on a COLMAP model that is written first; with --first each of its
runs finds an empty cache of kernels, as the first one on a machine does.

    python tests/benchmarks/bench_select.py --landmarks 100000 --waypoints 1000
    python tests/benchmarks/bench_select.py --process --landmarks 25000 --waypoints 20 --repeat 5
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from wheretolook.geometry.camera import Camera, ColmapCamera, PinholeCamera
from wheretolook.geometry.poses import Float, poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.select.where_to_look import WhereToLook
from wheretolook.utils.shipped import WEIGHTS, shipped
from wheretolook.visibility.cached_occlusion import RememberedOcclusion
from wheretolook.visibility.hidden_points import HiddenPointRemoval
from wheretolook.visibility.occlusion import NoOcclusion
from wheretolook.weights.resolve import load_scorer

SIDE_M = 20.0
ROOM_M = 5.0
HEIGHT_M = 3.0
CAMERAS: dict[str, Camera] = {
    "pinhole": PinholeCamera(640, 480, 320.0),
    "radial": ColmapCamera("SIMPLE_RADIAL", 640, 480, (320.0, 320.0, 240.0, 0.01)),
}


def walls(n: int, rng: np.random.Generator) -> Float:
    """Points (n, 3) on the walls of rooms, side by side."""
    points = rng.uniform((0, 0, 0), (SIDE_M, SIDE_M, HEIGHT_M), (n, 3))
    axis = rng.integers(0, 2, n)
    points[np.arange(n), axis] = rng.integers(0, int(SIDE_M / ROOM_M) + 1, n) * ROOM_M
    return points


def made_map(n: int, camera: Camera, hidden: bool, device: str) -> LocalizationMap:
    """A map of so many landmarks with plausible attributes, mapped from the middle of its rooms."""
    rng = np.random.default_rng(0)
    points = walls(n, rng)
    rooms = (np.floor(np.clip(points, 0, SIDE_M - 1e-6) / ROOM_M) + 0.5) * ROOM_M
    toward = points - rooms * (1, 1, 0) - (0, 0, HEIGHT_M / 2)
    distance = np.linalg.norm(toward, axis=1)
    values = {
        "track_length": rng.integers(3, 12, n).astype(np.int32),
        "reprojection_error_px": rng.uniform(0.1, 0.9, n).astype(np.float32),
        "triangulation_angle_deg": rng.uniform(2, 40, n).astype(np.float32),
        "mapping_direction": (toward / distance[:, None]).astype(np.float32),
        "mapping_direction_spread": rng.uniform(0, 0.3, n).astype(np.float32),
        "mapping_distance_m": distance.astype(np.float32),
        "mapping_distance_spread": rng.uniform(0, 0.5, n).astype(np.float32),
        "ambiguity": np.full(n, np.nan, dtype=np.float32),
        "mapping_focal_px": np.full(n, 500, dtype=np.float32),
    }
    landmarks = Landmarks(ids=np.arange(n), points=points, descriptors=None, **values)
    centers = rng.uniform((1, 1, 1), (SIDE_M - 1, SIDE_M - 1, 2), (200, 3))
    poses = poses_looking_along(centers, rng.normal(size=(200, 3)) * (1, 1, 0.2))
    occlusion = RememberedOcclusion(HiddenPointRemoval()) if hidden else NoOcclusion()
    return LocalizationMap(landmarks, camera, occlusion, device, poses)


def write_model(folder: Path, n: int) -> None:
    """A COLMAP model of such a map, of 200 images of a pinhole."""
    import pycolmap

    rng = np.random.default_rng(0)
    points = walls(n, rng)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[320, 320, 320, 240], camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    centers = rng.uniform((1, 1, 1), (SIDE_M - 1, SIDE_M - 1, 2), (200, 3))
    poses = poses_looking_along(centers, rng.normal(size=(200, 3)) * (1, 1, 0.2))
    seen_by = np.sort(np.argsort(np.linalg.norm(points[:, None] - centers[None], axis=2), axis=1)[:, :4], axis=1)
    of_image: list[list[int]] = [[] for _ in centers]
    for point, images in enumerate(seen_by):
        for image in images:
            of_image[image].append(point)
    place = [{point: index for index, point in enumerate(seen)} for seen in of_image]
    for number, (pose, seen) in enumerate(zip(poses, of_image, strict=True)):
        image = pycolmap.Image(name=f"{number:04}.jpg", keypoints=np.full((len(seen), 2), 100.0), camera_id=1)
        image.image_id = number + 1
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for point, images in enumerate(seen_by):
        track = pycolmap.Track()
        for image in images:
            track.add_element(int(image) + 1, place[image][point])
        model.add_point3D(points[point], track, np.zeros(3, dtype=np.uint8))
    for point in model.points3D.values():
        point.error = 0.4
    folder.mkdir(parents=True, exist_ok=True)
    model.write(str(folder))


def cpu_seconds() -> float:
    """CPU time of this process and of those it started and waited for."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


def measure(text: str, work: Callable[[], object], repeat: int) -> None:
    """Print median and spread of wall and CPU time."""
    wall = []
    cpu = []
    for _ in range(repeat):
        start = time.perf_counter()
        start_cpu = cpu_seconds()
        work()
        wall.append(time.perf_counter() - start)
        cpu.append(cpu_seconds() - start_cpu)
    parts = [
        f"{name} {np.median(values):.3g} s ({min(values):.3g} to {max(values):.3g})"
        for name, values in (("wall", wall), ("CPU", cpu))
    ]
    print(f"{text}: {', '.join(parts)}, {repeat} runs", flush=True)


def main() -> None:
    """Read the options, measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--landmarks", type=int, default=100_000)
    parser.add_argument("--waypoints", type=int, default=1_000)
    parser.add_argument("--camera", choices=CAMERAS, default="pinhole")
    parser.add_argument("--hidden-points", action="store_true")
    parser.add_argument("--process", action="store_true")
    parser.add_argument("--first", action="store_true", help="with --process: kernels are compiled anew in each run")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    rng = np.random.default_rng(1)
    points = rng.uniform((1, 1, 1), (SIDE_M - 1, SIDE_M - 1, 2), (options.waypoints, 3))
    size = f"{options.waypoints:,} waypoints x 500 directions x {options.landmarks:,} landmarks"
    if options.process:
        with tempfile.TemporaryDirectory() as folder:
            write_model(Path(folder) / "sparse", options.landmarks)
            np.savetxt(Path(folder) / "at.csv", points, delimiter=",", header="x,y,z", comments="")
            run = "import sys; from wheretolook.cli import main; sys.exit(main(sys.argv[1:]))"
            command = [sys.executable, "-c", run, "select", "--map", "sparse", "--at", "at.csv", "--out", "v.csv"]
            command += ["--device", options.device, "--occlusion", "hidden-points" if options.hidden_points else "none"]

            def run_command() -> None:
                with tempfile.TemporaryDirectory() as cache:
                    env = {**os.environ, "WARP_CACHE_PATH": cache} if options.first else None
                    subprocess.run(command, cwd=folder, check=True, env=env)

            measure(f"{'first ' if options.first else ''}process, {size}", run_command, options.repeat)
        return
    around = made_map(options.landmarks, CAMERAS[options.camera], options.hidden_points, options.device)
    look = WhereToLook(load_scorer(shipped(WEIGHTS), around))
    start = time.perf_counter()
    look.best(points[:1])
    print(f"the first waypoint, kernels loaded: {time.perf_counter() - start:.3g} s")

    def work() -> None:
        if options.hidden_points:
            around.occlusion.__init__(HiddenPointRemoval())  # type: ignore[misc]  # forgets
        look.best(points)

    measure(size, work, options.repeat)


if __name__ == "__main__":
    main()
