"""Errors of fields of Fisher information against exact information, by the samples of the Gaussian process.

python tests/paper/fisher/bench_fisher.py
"""

import sys
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

from common import options, room_landmarks

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.pose_information import information_matrices
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.visibility.frustum import LandmarkSets, PosedViews
from wheretolook_paper.fisher.exact import exact_information
from wheretolook_paper.fisher.field import FisherField
from wheretolook_paper.fisher.metrics import METRICS, metric_of
from wheretolook_paper.fisher.soft_visibility import GaussianProcessVisibility, QuadraticVisibility, cone_half_angle


def main():
    args = options(__doc__, landmarks=5000, samples=[10, 15, 20, 30, 50, 70, 100, 150])
    camera = PinholeCamera()
    points = room_landmarks(args.landmarks)
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
    visibilities = [QuadraticVisibility(half_angle)]
    visibilities += [GaussianProcessVisibility.fitted(half_angle, n) for n in args.samples]
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
            about = f"{visibility.length:6.3f}  {held_out_error(visibility):13.4f}"
        print(f"{visibility.n_factors:7}  {about:21}  {np.median(error):19.3f}  {', '.join(reached)}", flush=True)


def held_out_error(visibility):
    """Root mean square of v(z, f) - s(z . f) over random bearings and axes not used in the fit."""
    vectors = np.random.default_rng(1).normal(size=(2, 1000, 3))
    bearings, axes = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    predicted = visibility.of_axes(axes) @ visibility.finish(visibility.of_bearings(bearings).T)
    return float(np.sqrt(np.mean((predicted - visibility.step(axes @ bearings.T)) ** 2)))


if __name__ == "__main__":
    main()
