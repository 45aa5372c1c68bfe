"""Helpers that several benchmarks share: timing, rooms of random landmarks, generated scenes, COLMAP models."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import Float, poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.map import Map
from wheretolook.scenes.config import ApartmentConfig
from wheretolook.scenes.loading import load_mesh, save_glb
from wheretolook.space.free_space import FreeSpace
from wheretolook.visibility.occlusion import StoredOcclusion
from wheretolook_rooms.generator import generate_apartment

ROOM_M = ((-5.0, -4.0, 0.0), (5.0, 4.0, 2.6))
SIDE_M = 20.0  # of the building of `write_model`
HEIGHT_M = 3.0


def timed(label: str, work: Callable[[], object], repeats: int, unit: float = 1.0, units: str = "s") -> float:
    """Print the median and the range over repeats after one warm-up run; return the median in seconds."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    median = float(np.median(times))
    print(f"{label:62} {median * unit:9.3f} {units} [{min(times) * unit:.3f}, {max(times) * unit:.3f}]", flush=True)
    return median


def room_landmarks(n: int, seed: int = 0) -> Float:
    """Return points (n, 3) m on the walls, floor and ceiling of one room."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(*ROOM_M, (n, 3))
    axis = rng.integers(0, 3, n)
    points[np.arange(n), axis] = np.array(ROOM_M)[rng.integers(0, 2, n), axis]
    return points


def room_map(n_landmarks: int, locations: Float, device: str) -> LocalizationMap:
    """Return a map of room landmarks with random attributes; half of them are occluded from each location (L, 3) m."""
    rng = np.random.default_rng(0)
    points = room_landmarks(n_landmarks)
    offsets = points - np.mean(ROOM_M, axis=0)
    distance = np.linalg.norm(offsets, axis=1)

    def uniform(low: float, high: float) -> np.ndarray:
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


def points_on_surface(mesh: TexturedMesh, n: int, rng: np.random.Generator) -> Float:
    """Return points (n, 3) m spread over a mesh by area, with 5 mm noise."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles].astype(np.float64), 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    rows = rng.choice(len(area), n, p=area / area.sum())
    weights = rng.dirichlet((1, 1, 1), n)[:, :, None]
    on_triangle = weights[:, 0] * a[rows] + weights[:, 1] * b[rows] + weights[:, 2] * c[rows]
    return on_triangle + rng.normal(scale=0.005, size=(n, 3))


def free_points(space: FreeSpace, bounds: Float, n: int, rng: np.random.Generator) -> Float:
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


def open_scene(source: Path | None, folder: Path, seed: int, device: str) -> Scene:
    """Read a mesh file, or `mesh.glb` of a folder; without a source, generate an apartment into `folder`."""
    if source is None:
        source = folder / "mesh.glb"
        save_glb(generate_apartment(ApartmentConfig(), seed, device=device), source)
    elif source.is_dir():
        source = source / "mesh.glb"
    mesh = load_mesh(source)
    return Scene(source, mesh, FreeSpace(mesh, device=device))


def write_model(folder: Path, n: int) -> None:
    """Write a COLMAP model of n landmarks on the walls of a building of rooms, seen by 200 images of a pinhole."""
    import pycolmap

    rng = np.random.default_rng(0)
    points = rng.uniform((0, 0, 0), (SIDE_M, SIDE_M, HEIGHT_M), (n, 3))
    points[np.arange(n), rng.integers(0, 2, n)] = 5.0 * rng.integers(0, 5, n)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[320, 320, 320, 240], camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    centers = rng.uniform((1, 1, 1), (SIDE_M - 1, SIDE_M - 1, 2), (200, 3))
    poses = poses_looking_along(centers, rng.normal(size=(200, 3)) * (1, 1, 0.2))
    nearest = np.argsort(np.linalg.norm(points[:, None] - centers[None], axis=2), axis=1)
    tracks = [pycolmap.Track() for _ in points]
    n_observed = np.zeros(len(centers), dtype=int)
    for track, images in zip(tracks, nearest[:, :4], strict=True):
        for image in np.sort(images):
            track.add_element(int(image) + 1, int(n_observed[image]))
            n_observed[image] += 1
    for number, pose in enumerate(poses):
        keypoints = np.full((n_observed[number], 2), 100.0)
        image = pycolmap.Image(name=f"{number:04}.jpg", keypoints=keypoints, camera_id=1, image_id=number + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for point, track in zip(points, tracks, strict=True):
        model.add_point3D(point, track, np.zeros(3, dtype=np.uint8))
    for point in model.points3D.values():
        point.error = 0.4
    folder.mkdir(parents=True, exist_ok=True)
    model.write(str(folder))


def use_one_thread() -> None:
    """Limit OpenCV and PyTorch to one thread, as in a labelling worker."""
    import cv2
    import torch

    cv2.setNumThreads(1)
    torch.set_num_threads(1)
