"""Hidden-point removal against the mesh's occlusion, over its radius, and its time for each location.

    python tests/benchmarks/bench_hidden_points.py --scene a/mesh.glb a/map/landmarks.npz --scene b/mesh.glb ...

Without --scene, generated apartments with points on the surfaces that are seen from free locations. Prints precision,
recall and F1 for every scene and radius, which radius has the greatest mean F1, what the mean of the other scenes would
have chosen for each (leave-one-out), and the time with one thread and with all.
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
from wheretolook.dataset.sampling import free_locations
from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.scenes.config import ApartmentConfig
from wheretolook.scenes.loading import load_mesh
from wheretolook.space.free_space import FreeSpace
from wheretolook.utils.tracking import log, start_run
from wheretolook.utils.tracking_config import TrackingConfig
from wheretolook.visibility.config import DEFAULT_RADIUS
from wheretolook.visibility.hidden_points import HiddenPointRemoval
from wheretolook.visibility.occlusion import MeshOcclusion
from wheretolook_rooms.generator import generate_apartment

RADII = (1, 2, 5, 10, 15, 20, 30, 40, 50, 70, 100, 150, 200, 300, 500, 1000)


def surface_points(raycaster: MeshRaycaster, locations: np.ndarray, n: int, seed: int) -> np.ndarray:
    """What n rays in random directions from random free locations meet, (at most n, 3) metres, 5 mm off."""
    rng = np.random.default_rng(seed)
    origins = locations[rng.integers(0, len(locations), n)]
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distance = raycaster.cast(origins, directions).distance_m
    hit = np.isfinite(distance)
    points = origins[hit] + distance[hit, None] * directions[hit]
    return points + rng.normal(scale=0.005, size=points.shape)


def scenes(args: argparse.Namespace) -> Iterator[tuple[str, TexturedMesh, np.ndarray | None]]:
    """Name, mesh and landmarks of every scene."""
    for mesh, landmarks in args.scene:
        folder = Path(landmarks).resolve().parent
        name = folder.parent.name if folder.name == "map" else folder.name
        yield name, load_mesh(mesh, up=args.up), Landmarks.load(landmarks).points
    for seed in range(0 if args.scene else 3):
        yield f"generated-{seed}", generate_apartment(ApartmentConfig(), seed, args.device), None


def time_per_location(model: HiddenPointRemoval, locations: np.ndarray, points: np.ndarray, repeats: int = 3) -> float:
    """Median milliseconds."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        model.unoccluded(locations, points)
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times)) / len(locations)


def report_choice(curves: pd.DataFrame) -> None:
    """Print the mean over scenes and which radius it chooses, from all scenes and from all but one."""
    f1 = curves.pivot(index="radius", columns="scene", values="f1")
    mean = curves.groupby("radius")[["precision", "recall", "f1"]].mean()
    print("\nmean of the scenes\n" + mean.round(3).to_string())
    near = mean.index[mean["f1"] >= mean["f1"].max() - 0.01]
    print(f"\ngreatest mean F1 {mean['f1'].max():.3f} at radius {mean['f1'].idxmax():g}, "
          f"within 0.01 of it from {near.min():g} to {near.max():g}")  # fmt: skip
    for scene in f1.columns if f1.shape[1] > 1 else ():
        chosen = f1.drop(columns=scene).mean(axis=1).idxmax()
        print(f"  {scene:24} chosen by the others {chosen:6g}: F1 {f1.loc[chosen, scene]:.3f}; "
              f"its own best {f1[scene].idxmax():6g}: {f1[scene].max():.3f}")  # fmt: skip


def log_curves(curves: pd.DataFrame, margin_m: float) -> None:
    """One run: the curve of each scene as metrics, the radius in thousandths as their step."""
    params = {"margin_m": margin_m, "scenes": ", ".join(curves["scene"].unique()), "default_radius": DEFAULT_RADIUS}
    with start_run(TrackingConfig(), "hidden points", "benchmark", params) as (client, run_id):
        for row in curves.itertuples():
            metrics = {f"{name}/{row.scene}": getattr(row, name) for name in ("precision", "recall", "f1")}
            log(client, run_id, metrics=metrics, step=round(1000 * row.radius))
        client.log_table(run_id, curves, "hidden_points.json")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", nargs=2, action="append", default=[], metavar=("MESH", "LANDMARKS"))
    parser.add_argument("--up", default="z", help="the meshes' up axis")
    parser.add_argument("--radii", type=float, nargs="+", default=RADII)
    parser.add_argument("--margin", type=float, default=0.05, help="margin of the model and of the mesh, metres")
    parser.add_argument("--locations", type=int, default=30, help="free locations of each scene, at random")
    parser.add_argument("--landmarks", type=int, default=15_000, help="landmarks of a generated scene")
    parser.add_argument("--device", default="cpu", help="Warp's device")
    parser.add_argument("--log", action="store_true", help="log the curves to MLflow, in mlruns/")
    args = parser.parse_args()

    rows = []
    threads = len(os.sched_getaffinity(0))
    for name, mesh, landmarks in scenes(args):
        raycaster = MeshRaycaster(mesh, args.device)
        grid = VoxelGrid.over(mesh.bounds)
        free = grid.centers()[free_locations(grid, FreeSpace(mesh, device=args.device))]
        points = surface_points(raycaster, free, args.landmarks, seed=0) if landmarks is None else landmarks
        locations = free[np.random.default_rng(0).permutation(len(free))[: args.locations]]
        truth = MeshOcclusion(raycaster, args.margin).unoccluded(locations, points)
        print(f"\n{name}: {len(points):,} landmarks, {len(np.unique(points, axis=0)):,} in distinct places, from "
              f"{len(locations)} locations {100 * truth.mean():.1f} % free; with all taken as free F1 "
              f"{MaskAgreement.between(np.ones_like(truth), truth).f1:.3f}")  # fmt: skip
        print("  radius  precision  recall     F1")
        for radius in args.radii:
            found = HiddenPointRemoval(radius, args.margin).unoccluded(locations, points)
            agreement = MaskAgreement.between(found, truth)
            rows.append({"scene": name, "radius": radius, "precision": agreement.precision,
                         "recall": agreement.recall, "f1": agreement.f1})  # fmt: skip
            print(f"{radius:8g} {agreement.precision:10.3f} {agreement.recall:7.3f} {agreement.f1:6.3f}", flush=True)
        for margin_m in (0.0, args.margin):
            one, every = (
                time_per_location(HiddenPointRemoval(DEFAULT_RADIUS, margin_m, n), locations[:8], points)
                for n in (1, threads)
            )
            print(f"  at the default radius {DEFAULT_RADIUS:g} and margin {margin_m:g} m: {one:.0f} ms a location with "
                  f"one thread, {every:.0f} ms with {threads}")  # fmt: skip
    curves = pd.DataFrame(rows)
    report_choice(curves)
    if args.log:
        log_curves(curves, args.margin)


if __name__ == "__main__":
    main()
