"""Measure Fisher information: building and querying fields, and exact sums over a grid of viewpoints.

    python tests/paper/fisher/bench_fisher.py [--device cuda]

Landmarks are on the walls of a room; a random half is occluded from each location. Prints the median and the range over
repeats, and the time of each kernel's NumPy twin, extrapolated from a small part. On the CPU also the errors of the
approximations against the exact information, by the number of samples of the Gaussian process.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

from common import ROOM_M, room_landmarks, timed

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import VoxelGrid, fibonacci_sphere
from wheretolook.geometry.pose_information import information_matrices
from wheretolook.geometry.poses import Float, poses_looking_along
from wheretolook.visibility.frustum import LandmarkSets, PosedViews
from wheretolook_paper.fisher.exact import exact_information, exact_information_plain
from wheretolook_paper.fisher.field import FisherField
from wheretolook_paper.fisher.metrics import METRICS, eigenvalues, metric_of
from wheretolook_paper.fisher.soft_visibility import (
    GaussianProcessVisibility,
    QuadraticVisibility,
    SoftVisibility,
    cone_half_angle,
)


def query(locations: Float, points: Float, visibilities: dict[str, SoftVisibility], axes: Float) -> None:
    """Time a planner's query: all directions at one location, on the CPU."""
    print(f"querying a field for {len(axes)} directions at one location")
    for name, visibility in visibilities.items():
        field = FisherField.build(locations, points, visibility)
        for metric in METRICS:
            timed(f"  {name} {metric}", lambda f=field, m=metric: metric_of(f.information(3, axes), m), 200, 1e3, "ms")
        numbers = field.information(3, axes)
        timed(f"  {name} eigenvalues alone", lambda n=numbers: eigenvalues(n), 200, 1e3, "ms")


def errors_over_samples(samples: list[int], n_landmarks: int) -> None:
    """Print the errors of the approximations against the true view, by the samples of the Gaussian process."""
    camera = PinholeCamera()
    points = room_landmarks(n_landmarks)
    axes = fibonacci_sphere(300)
    locations = np.random.default_rng(1).uniform((-4, -3, 0.6), (4, 3, 2.0), (20, 3))
    views = poses_looking_along(np.repeat(locations, len(axes), axis=0), np.tile(axes, (len(locations), 1)))
    rows = np.repeat(np.arange(len(locations)), len(axes))
    everything = LandmarkSets.from_mask(np.ones((len(locations), len(points)), bool))
    exact = exact_information(PosedViews(camera, views, points, everything, rows))
    truth = information_matrices(exact)
    best = {metric: metric_of(exact, metric).reshape(len(locations), -1) for metric in METRICS}
    print(f"{len(locations)} locations, {len(axes)} directions each, {len(points):,} landmarks, none hidden")
    print("factors  length  held-out RMSE  error of the matrix  exact metric at the chosen direction, % of the best")
    half_angle = cone_half_angle(camera)
    visibilities: list[SoftVisibility] = [QuadraticVisibility(half_angle)]
    visibilities += [GaussianProcessVisibility.fitted(half_angle, n) for n in samples]
    for visibility in visibilities:
        field = FisherField.build(locations, points, visibility)
        numbers = field.information_of_views(rows, views[:, 2, :3])
        found = information_matrices(numbers)
        error = np.linalg.norm(found - truth, axis=(1, 2)) / np.linalg.norm(truth, axis=(1, 2))
        reached = []
        for metric, values in best.items():
            chosen = metric_of(numbers, metric).reshape(values.shape).argmax(1)
            share = np.take_along_axis(values, chosen[:, None], 1)[:, 0] / values.max(1)
            reached.append(f"{metric} {100 * share.mean():.1f}")
        about = "quadratic" if isinstance(visibility, QuadraticVisibility) else ""
        if isinstance(visibility, GaussianProcessVisibility):
            about = f"{visibility.length:6.3f}  {visibility.held_out_error():13.4f}"
        print(f"{visibility.n_factors:7}  {about:21}  {np.median(error):19.3f}  {', '.join(reached)}", flush=True)


def main() -> None:
    """Parse the options, measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cpu", help="Warp's device")
    parser.add_argument("--landmarks", type=int, default=25_000)
    parser.add_argument("--voxels", type=int, default=8, help="along each axis")
    parser.add_argument("--directions", type=int, default=500)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--samples", type=int, nargs="+", default=[10, 15, 20, 30, 50, 70, 100, 150])
    parser.add_argument("--errors", action="store_true", help="only the errors of the approximations")
    args = parser.parse_args()
    if args.errors:
        errors_over_samples(args.samples, 5000)
        return
    rng = np.random.default_rng(0)
    repeats = args.repeats
    device = args.device

    camera = PinholeCamera()
    points = room_landmarks(args.landmarks)
    visibilities: dict[str, SoftVisibility] = {
        "quadratic": QuadraticVisibility(cone_half_angle(camera)),
        "gp": GaussianProcessVisibility.fitted(cone_half_angle(camera)),
    }

    voxels = VoxelGrid(*map(np.array, ROOM_M), (args.voxels,) * 3).centers()
    free = rng.random((len(voxels), len(points))) < 0.5
    print(f"fields of {len(voxels)} voxels and {len(points):,} landmarks, on {device}")
    for name, visibility in visibilities.items():
        for label, mask in (("none occluded", None), ("half occluded", free)):
            timed(f"  {name} ({visibility.n_factors} factors), {label}",
                  lambda v=visibility, m=mask: FisherField.build(voxels, points, v, m, device), repeats)  # fmt: skip

    axes = fibonacci_sphere(args.directions)
    if device == "cpu":
        query(voxels[:8], points, visibilities, axes)
        errors_over_samples(args.samples, min(5000, args.landmarks))

    locations = VoxelGrid(*map(np.array, ROOM_M), (args.voxels + 1, args.voxels + 1, args.voxels)).centers()
    views = poses_looking_along(np.repeat(locations, len(axes), axis=0), np.tile(axes, (len(locations), 1)))
    rows = np.repeat(np.arange(len(locations)), len(axes))
    print(f"exact, {len(views):,} viewpoints")
    for label, mask in (
        ("none occluded", np.ones((len(locations), len(points)), bool)),
        ("half occluded", rng.random((len(locations), len(points))) < 0.5),
    ):
        sets = LandmarkSets.from_mask(mask)
        few = max(1, repeats // 2)
        posed = PosedViews(camera, views, points, sets, rows)

        def all_metrics(posed: PosedViews = posed) -> None:
            numbers = exact_information(posed, device)
            for metric in METRICS:
                metric_of(numbers, metric, device)

        timed(f"  sums, {label}", lambda p=posed: exact_information(p, device), few)
        timed(f"  the three metrics, {label}", all_metrics, few)
        start = time.perf_counter()
        exact_information_plain(PosedViews(camera, views[:200], points, sets, rows[:200]))
        print(f"  {'  sums by NumPy, from 200 viewpoints':60} "
              f"{(time.perf_counter() - start) * len(views) / 200:9.0f} s")  # fmt: skip


if __name__ == "__main__":
    main()
