"""The field against direct sums over landmarks, and against the exact information that it approximates."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from paper.fisher.twins import field_sums_plain
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.pose_information import bearing_numbers
from wheretolook_paper.fisher.field import FisherField, stationary_axis_of_trace
from wheretolook_paper.fisher.soft_visibility import GaussianProcessVisibility, QuadraticVisibility

HALF_ANGLE = 0.766  # of the paper's camera
VISIBILITIES = [QuadraticVisibility(HALF_ANGLE), GaussianProcessVisibility(HALF_ANGLE, 0.45)]


@pytest.mark.parametrize("visibility", VISIBILITIES)
@pytest.mark.parametrize("masked", [False, True])
def test_a_field_holds_the_sums_of_the_plain_twin(visibility, masked, device):
    rng = np.random.default_rng(0)
    locations = rng.uniform(-2, 2, (20, 3))
    points = rng.uniform(-5, 5, (3000, 3))
    points[:5] = locations[:5] + 1e-4  # too near
    mask = rng.random((20, 3000)) < 0.4 if masked else None
    field = FisherField.build(locations, points, visibility, mask, device)
    plain = field_sums_plain(locations, points, visibility, mask)
    factors = visibility.finish(plain)
    assert field.factors.shape == (20, visibility.n_factors, 15)
    assert np.all(np.abs(field.factors - factors) < 1e-4 * np.abs(factors).max((1, 2), keepdims=True))
    # v(z, f) times the information of each landmark, summed
    axes = fibonacci_sphere(60)
    offsets = (points if mask is None else points[mask[7]]) - locations[7]
    bearings = offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
    seen = visibility.of_axes(axes) @ visibility.finish(visibility.of_bearings(bearings).T)
    expected = seen @ bearing_numbers(offsets)
    np.testing.assert_allclose(field.information(7, axes), expected, atol=1e-5 * np.abs(expected).max())


def test_the_stationary_axis_has_no_gradient():
    rng = np.random.default_rng(0)
    visibility = QuadraticVisibility(HALF_ANGLE)
    points = rng.normal((1, 2, 0), size=(100, 3))
    axis = stationary_axis_of_trace(FisherField.build(np.zeros((1, 3)), points, visibility), 0)
    distance = torch.from_numpy(np.linalg.norm(points, axis=1))
    bearings = torch.from_numpy(points) / distance[:, None]
    k1, k2, k3 = visibility.coefficients

    def trace(z):
        cosine = bearings @ z
        return ((k1 * cosine**2 + k2 * cosine + k3) * (2 / distance**2 + 2)).sum()

    hessian = torch.func.hessian(trace)(torch.zeros(3, dtype=torch.float64))
    gradient = torch.func.grad(trace)(torch.zeros(3, dtype=torch.float64))
    stationary = -torch.linalg.solve(hessian, gradient)
    np.testing.assert_allclose(axis, stationary / stationary.norm(), atol=1e-5)


@pytest.mark.slow
def test_the_benchmark_runs_small():
    options = ["--landmarks", "300", "--samples", "10"]
    subprocess.run([sys.executable, str(Path(__file__).with_name("bench_fisher.py")), *options], check=True)
