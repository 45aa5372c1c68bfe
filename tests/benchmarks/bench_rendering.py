"""Frames a second of the Warp renderer and of its Open3D reference, and occlusion rays a second, in one run.

    python tests/benchmarks/bench_rendering.py --scene my_scene.glb --device cuda

Without --scene, a generated mesh of 100,000 triangles. Prints the median and the range over repeats.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from open3d_renderer import Open3DRenderer
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh


def bumpy_room(n_triangles: int = 100_000, seed: int = 0) -> TexturedMesh:
    """The inside of a bumpy ellipsoid of 8 x 6 x 3 m with one texture of 2048 x 2048 texels of noise."""
    rows = round(np.sqrt(n_triangles / 4))
    columns = 2 * rows
    v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    azimuth = 2 * np.pi * u
    polar = np.pi * v
    radius = 1 + 0.05 * np.sin(40 * azimuth) * np.sin(20 * polar)
    sphere = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=-1)
    vertices = (sphere * radius[..., None] * (4, 3, 1.5)).reshape(-1, 3)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).reshape(-1, 1)
    triangles = np.concatenate(
        [corner + np.array(step) for step in ((0, 1, columns + 2), (0, columns + 2, columns + 1))]
    )
    uvs = np.stack([u, v], axis=-1).reshape(-1, 2)
    texture = np.random.default_rng(seed).integers(0, 256, (2048, 2048, 3), dtype=np.uint8)
    return TexturedMesh(
        vertices.astype(np.float32),
        triangles.astype(np.int32),
        uvs[triangles].astype(np.float32),
        np.zeros(len(triangles), dtype=np.int32),
        (texture,),
    )


def rate(work: Callable[[], object], amount: float, repeats: int) -> str:
    """Median and range of `amount` a second over repeats, after one run to warm up."""
    work()
    rates = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        rates.append(amount / (time.perf_counter() - start))
    return f"{np.median(rates):14,.1f} /s   ({min(rates):,.1f} to {max(rates):,.1f}, {repeats} repeats)"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", help="mesh file; default: a generated one")
    parser.add_argument("--up", default="z", help="the file's up axis")
    parser.add_argument("--device", default="cpu", help="Warp's device")
    parser.add_argument("--batch", type=int, default=8, help="poses rendered at a time")
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()

    mesh = bumpy_room() if args.scene is None else load_mesh(args.scene, up=args.up)
    rng = np.random.default_rng(0)
    low, high = mesh.bounds
    locations = rng.uniform(low + 0.3 * (high - low), high - 0.3 * (high - low), (args.batch, 3))
    directions = rng.normal(size=(args.batch, 3)) * (1, 1, 0.2)
    camera = PinholeCamera()
    poses = poses_looking_along(locations, directions)
    texels = sum(texture.shape[0] * texture.shape[1] for texture in mesh.textures)
    print(f"{len(mesh.triangles):,} triangles, {texels / 1e6:.1f} M texels, {camera.width} x {camera.height} pixels")

    start = time.perf_counter()
    warp = WarpRenderer(mesh, args.device)
    raycaster = MeshRaycaster(mesh, args.device)
    print(f"Warp set-up           {time.perf_counter() - start:14.2f} s")
    open3d = Open3DRenderer(mesh)
    landmarks = mesh.vertices[rng.integers(0, len(mesh.vertices), 20_000)]
    n_rays = len(locations) * len(landmarks)
    print(f"Warp {args.device:6} frames    ", rate(lambda: warp.render(camera, poses), len(poses), args.repeats))
    if warp.method != "rays":
        rays = WarpRenderer(mesh, args.device, method="rays")
        print("  the same, by rays   ", rate(lambda: rays.render(camera, poses), len(poses), args.repeats))
    print("Open3D frames         ", rate(lambda: open3d.render(camera, poses[:2]), 2, args.repeats))
    print(
        f"Warp {args.device:6} occlusion ", rate(lambda: raycaster.occluded(locations, landmarks), n_rays, args.repeats)
    )


if __name__ == "__main__":
    main()
