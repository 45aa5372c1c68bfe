"""Occlusion by fused depth images against the mesh they are rendered from: agreement, time and memory by voxel size.

    python tests/benchmarks/bench_tsdf.py --mesh house.glb --mesh hall.glb --landmarks hall/map/landmarks.npz

Without --mesh, a generated apartment. Landmarks go with the last meshes; a mesh without has points on surfaces that are
seen from free space, 3 mm off. Depth images are taken from random free places in random, mostly level directions.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from mask_agreement import MaskAgreement
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.geometry.tsdf import BYTES_PER_BLOCK, DepthImage, TsdfConfig, TsdfVolume
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.rendering.types import camera_rays
from wheretolook.scenes.config import ApartmentConfig
from wheretolook.scenes.loading import load_mesh
from wheretolook.space.free_space import FreeSpace
from wheretolook.visibility.occlusion import MeshOcclusion
from wheretolook.visibility.tsdf import TsdfOcclusion
from wheretolook_rooms.generator import generate_apartment

MAX_DEPTH_M = 20.0


def free_points(mesh: TexturedMesh, rng: np.random.Generator, n: int) -> np.ndarray:
    """Random free places (n, 3)."""
    space = FreeSpace(mesh)
    found = np.empty((0, 3))
    while len(found) < n:
        points = rng.uniform(*mesh.bounds, (20_000, 3))
        found = np.concatenate([found, points[space.is_free(points)]])
    return found[:n]


def surface_points(raycaster: MeshRaycaster, places: np.ndarray, rng: np.random.Generator, n: int) -> np.ndarray:
    """What random, mostly level rays from the places meet, 3 mm off, (at most n, 3)."""
    origins = places[rng.integers(0, len(places), n)]
    rays = rng.normal(size=(n, 3)) * (1, 1, 0.5)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    distance = raycaster.cast(origins, rays).distance_m
    hit = np.isfinite(distance)
    points = origins[hit] + distance[hit, None] * rays[hit]
    return points + rng.normal(scale=0.003, size=points.shape)


def render_depth(
    raycaster: MeshRaycaster, camera: PinholeCamera, places: np.ndarray, rng: np.random.Generator
) -> Iterator[DepthImage]:
    """A depth image from each place; only depth is needed, so textures are left alone."""
    poses = poses_looking_along(places, rng.normal(size=(len(places), 3)) * (1, 1, 0.45))
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    for pose, center, ray_from_pixel in zip(poses, *camera_rays(camera, poses), strict=True):
        rays = pixels @ ray_from_pixel.T
        z = raycaster.cast(np.broadcast_to(center, rays.shape), rays).distance_m / np.linalg.norm(rays, axis=1)
        yield DepthImage(z.reshape(x.shape).astype(np.float32), camera, pose)


def measure(name: str, mesh: TexturedMesh, landmarks: np.ndarray | None, args: argparse.Namespace) -> Iterator[dict]:
    """One row for each number of images and voxel size."""
    rng = np.random.default_rng(args.seed)
    raycaster = MeshRaycaster(mesh)
    places = free_points(mesh, rng, args.locations + max(args.images))
    locations = places[: args.locations]
    eyes = places[args.locations :]
    points = surface_points(raycaster, eyes, rng, 20_000) if landmarks is None else landmarks
    truth = MeshOcclusion(raycaster).unoccluded(locations, points)
    images = list(render_depth(raycaster, PinholeCamera(), eyes, rng))
    for n_images in args.images:
        for voxel_cm in args.voxels_cm:
            start = time.perf_counter()
            config = TsdfConfig(voxel_cm / 100, args.truncation, MAX_DEPTH_M)
            volume = TsdfVolume.from_images(images[:n_images], config, progress=False)
            fused = time.perf_counter()
            occlusion = TsdfOcclusion(volume)
            built = time.perf_counter()
            mask = occlusion.unoccluded(locations, points)
            asked = time.perf_counter()
            agreement = MaskAgreement.between(mask, truth)
            yield {
                "scene": name,
                "landmarks": len(points),
                "free": truth.mean(),
                "images": n_images,
                "voxel cm": voxel_cm,
                "MB": len(volume) * BYTES_PER_BLOCK / 1e6,
                "fuse s": fused - start,
                "surface s": built - fused,
                "ms/location": 1e3 * (asked - built) / len(locations),
                "precision": agreement.precision,
                "recall": agreement.recall,
            }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mesh", action="append", default=[], help="mesh file; may be given several times")
    parser.add_argument("--landmarks", action="append", default=[], help="landmarks.npz of the last meshes, in order")
    parser.add_argument("--up", default="z", help="the files' up axis")
    parser.add_argument("--voxels-cm", type=float, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--images", type=int, nargs="+", default=[400])
    parser.add_argument("--truncation", type=float, default=TsdfConfig.truncation_voxels, help="in voxels")
    parser.add_argument("--locations", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()

    print(f"{os.cpu_count()} cores, {PinholeCamera()}, truncation of {args.truncation:g} voxels")
    landmarks = [None] * (len(args.mesh) - len(args.landmarks)) + [Landmarks.load(p).points for p in args.landmarks]
    rows = []
    for path, points in zip(args.mesh or [None], landmarks or [None], strict=True):
        mesh = generate_apartment(ApartmentConfig(), args.seed) if path is None else load_mesh(path, up=args.up)
        name = "generated" if path is None else Path(path).parent.name if Path(path).stem == "mesh" else Path(path).stem
        for row in measure(name, mesh, points, args):
            rows.append(row)
            print(" ".join(f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values()))
    print(pd.DataFrame(rows).to_string(index=False, float_format=lambda value: f"{value:.4g}"))


if __name__ == "__main__":
    main()
