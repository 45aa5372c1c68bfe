"""The frame that benchmarks share: options, timing, tables; rooms of random landmarks, generated scenes, COLMAP models."""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.map import Map
from wheretolook.scenes.config import ApartmentConfig
from wheretolook.scenes.loading import load_mesh, save_glb
from wheretolook.space.free_space import FreeSpace
from wheretolook.visibility.occlusion import StoredOcclusion
from wheretolook_rooms.generator import generate_apartment

sys.path.append(str(Path(__file__).parents[1]))

ROOM_M = ((-5.0, -4.0, 0.0), (5.0, 4.0, 2.6))
SIDE_M = 20.0  # of the building of `write_model`
HEIGHT_M = 3.0


def options(about, **defaults):
    """Parse the command line: `...` is a required path, a type an optional value, a list several values, False a flag."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in defaults.items():
        option = "--" + name.replace("_", "-")
        if default is False:
            parser.add_argument(option, action="store_true")
        elif default is ...:
            parser.add_argument(option, type=Path, required=True)
        elif isinstance(default, type):
            parser.add_argument(option, type=default)
        elif isinstance(default, list):
            parser.add_argument(option, nargs="*", type=type(default[0]), default=default)
        else:
            parser.add_argument(option, type=type(default), default=default)
    return parser.parse_args()


def seconds_of(work, repeats, clock=time.perf_counter, limit_s=float("inf")):
    """Return median, quartiles, minimum and maximum seconds over repeats, after one warm-up run.

    After two repeats no other begins beyond a limit.
    """
    work()
    seconds = []
    for n in range(repeats):
        if n >= 2 and sum(seconds) > limit_s:
            break
        start = clock()
        work()
        seconds.append(clock() - start)
    low, first, median, third, high = np.percentile(seconds, (0, 25, 50, 75, 100)).tolist()
    return {"median_s": median, "q1_s": first, "q3_s": third, "min_s": low, "max_s": high, "repeats": len(seconds)}


def show(label, times, about=""):
    """Print median, quartiles and range of `seconds_of` in milliseconds."""
    median, first, third, low, high = (1e3 * times[f"{name}_s"] for name in ("median", "q1", "q3", "min", "max"))
    print(f"{label:62} {median:12,.3f} ms, quartiles [{first:,.3f}, {third:,.3f}], range [{low:,.3f}, {high:,.3f}] {about}",
          flush=True)  # fmt: skip


def timed(label, work, repeats, each=1, clock=time.perf_counter):
    """Print the times of one of `each` pieces of work; return their median in seconds."""
    times = {name: value / each for name, value in seconds_of(work, repeats, clock).items()}
    show(label, times)
    return times["median_s"]


def write_csv(table, path):
    table.to_csv(path, index=False, float_format="%.6g", lineterminator="\n")


def room_landmarks(n, seed=0):
    """Return points (n, 3) m on the walls, floor and ceiling of one room."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(*ROOM_M, (n, 3))
    axis = rng.integers(0, 3, n)
    points[np.arange(n), axis] = np.array(ROOM_M)[rng.integers(0, 2, n), axis]
    return points


def room_map(n_landmarks, locations, device):
    """Return a map of room landmarks with random attributes; half of them are occluded from each location (L, 3) m."""
    rng = np.random.default_rng(0)
    points = room_landmarks(n_landmarks)
    offsets = points - np.mean(ROOM_M, axis=0)
    distance = np.linalg.norm(offsets, axis=1)

    def uniform(low, high):
        return rng.uniform(low, high, n_landmarks).astype(np.float32)

    landmarks = Landmarks(
        ids=np.arange(n_landmarks),
        points=points,
        track_length=rng.integers(2, 9, n_landmarks).astype(np.int32),
        reprojection_error_px=uniform(0, 0.5),
        triangulation_angle_deg=uniform(2, 40),
        mapping_direction=(offsets / distance[:, None]).astype(np.float32),
        mapping_direction_spread=uniform(0, 1),
        mapping_distance_m=distance.astype(np.float32),
        mapping_distance_spread=uniform(0, 0.5),
        descriptors=None,
        ambiguity=uniform(0.5, 1),
    )
    occlusion = StoredOcclusion.from_mask(locations, rng.random((len(locations), n_landmarks)) < 0.5)
    return LocalizationMap(Map(landmarks), PinholeCamera(), occlusion, device)


def points_on_surface(mesh, n, rng):
    """Return points (n, 3) m spread over a mesh by area, with 5 mm noise."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles].astype(np.float64), 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    rows = rng.choice(len(area), n, p=area / area.sum())
    weights = rng.dirichlet((1, 1, 1), n)[:, :, None]
    on_triangle = weights[:, 0] * a[rows] + weights[:, 1] * b[rows] + weights[:, 2] * c[rows]
    return on_triangle + rng.normal(scale=0.005, size=(n, 3))


def free_points(space, bounds, n, rng):
    """Return n points (n, 3) m drawn uniformly from free space within bounds (2, 3) m."""
    found = np.empty((0, 3))
    while len(found) < n:
        candidates = rng.uniform(*bounds, (20_000, 3))
        found = np.concatenate([found, candidates[space.is_free(candidates)]])
    return found[:n]


@dataclass(frozen=True, eq=False)
class Scene:
    """A mesh, its file, and its free space."""

    file: Path
    mesh: TexturedMesh
    free_space: FreeSpace


def open_scene(source, folder, seed, device):
    """Read a mesh file, or `mesh.glb` of a folder; without a source, generate an apartment into `folder`."""
    if source is None:
        source = folder / "mesh.glb"
        save_glb(generate_apartment(ApartmentConfig(), seed, device=device), source)
    elif source.is_dir():
        source = source / "mesh.glb"
    mesh = load_mesh(source)
    return Scene(source, mesh, FreeSpace(mesh, device=device))


def write_model(folder, n):
    """Write a COLMAP model of n landmarks on the walls of a building of rooms, seen by 200 images of a pinhole."""
    from colmap_models import colmap_model

    rng = np.random.default_rng(0)
    points = rng.uniform((0, 0, 0), (SIDE_M, SIDE_M, HEIGHT_M), (n, 3))
    points[np.arange(n), rng.integers(0, 2, n)] = 5.0 * rng.integers(0, 5, n)
    centers = rng.uniform((1, 1, 1), (SIDE_M - 1, SIDE_M - 1, 2), (200, 3))
    poses = poses_looking_along(centers, rng.normal(size=(200, 3)) * (1, 1, 0.2))
    seen = np.zeros((200, n), dtype=bool)
    nearest = np.argsort(np.linalg.norm(points[:, None] - centers[None], axis=2), axis=1)
    seen[nearest[:, :4].T, np.arange(n)] = True
    folder.mkdir(parents=True, exist_ok=True)
    colmap_model(points, poses, seen, (PinholeCamera(640, 480, 320.0),), False, 0.4).write(str(folder))


def waypoints(n):
    """Return n points (n, 3) m in the building of `write_model`."""
    return np.random.default_rng(1).uniform((1, 1, 1), (SIDE_M - 1, SIDE_M - 1, 2), (n, 3))


def write_waypoints(n, path):
    np.savetxt(path, waypoints(n), delimiter=",", header="x,y,z", comments="")


def use_one_thread():
    """Limit OpenCV and PyTorch to one thread, as in a labelling worker."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
