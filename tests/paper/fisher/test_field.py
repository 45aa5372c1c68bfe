"""The field against direct sums over landmarks, and against the exact information that it approximates."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from twins.fisher import field_sums_plain
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.pose_information import information_matrices
from wheretolook.geometry.poses import Float
from wheretolook_paper.fisher.field import FisherField, stationary_axis_of_trace
from wheretolook_paper.fisher.field_sums import field_sums
from wheretolook_paper.fisher.soft_visibility import (
    JITTER,
    GaussianProcessVisibility,
    QuadraticVisibility,
    SoftVisibility,
)

HALF_ANGLE = 0.766  # of the paper's camera
VISIBILITIES = [QuadraticVisibility(HALF_ANGLE), GaussianProcessVisibility(HALF_ANGLE, 0.45)]


def jacobians(offsets: Float) -> Float:
    """Jacobians (N, 3, 6) of bearings, in the world, by a shift and a turn of the camera along the world's axes."""
    distance = np.linalg.norm(offsets, axis=1)[:, None, None]
    bearing = offsets[:, :, None] / distance
    x, y, z = offsets.T
    zero = np.zeros_like(x)
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    by_point = (np.eye(3) - bearing * bearing.transpose(0, 2, 1)) / distance
    return by_point @ np.concatenate([np.broadcast_to(-np.eye(3), cross.shape), cross], axis=2)


def soft_sums(visibility: SoftVisibility, location: Float, points: Float, axes: Float) -> Float:
    """Sum over landmarks of v(z, f) J^T J, (D, 6, 6), with v by its own formula."""
    offsets = points - location
    bearings = offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
    if isinstance(visibility, GaussianProcessVisibility):
        covariance = np.exp(-((axes[:, None] - visibility.axes) ** 2).sum(-1) / (2 * visibility.length**2))
        among = np.exp(-((visibility.axes[:, None] - visibility.axes) ** 2).sum(-1) / (2 * visibility.length**2))
        cosine = visibility.axes @ bearings.T
        seen = 1 / (1 + np.exp(-visibility.steepness * (cosine - np.cos(visibility.half_angle_rad))))
        v = covariance @ np.linalg.solve(among + JITTER * np.eye(len(among)), seen)
    else:
        v = np.polyval(visibility.coefficients, axes @ bearings.T)  # type: ignore[attr-defined]
    each = jacobians(offsets)
    return np.einsum("dn,nij,nik->djk", v, each, each, optimize=True)


@pytest.mark.parametrize("visibility", VISIBILITIES)
@pytest.mark.parametrize("masked", [False, True])
def test_the_field_gives_the_direct_sum(visibility: SoftVisibility, masked: bool, device: str) -> None:
    rng = np.random.default_rng(0)
    locations = rng.uniform(-2, 2, (20, 3))
    points = rng.uniform(-5, 5, (9000, 3))
    axes = fibonacci_sphere(60)
    mask = rng.random((20, 9000)) < 0.3 if masked else None
    field = FisherField.build(locations, points, visibility, mask, device)
    assert field.factors.shape == (20, visibility.n_factors, 15)
    for row in (0, 7, 19):
        seen = points if mask is None else points[mask[row]]
        expected = soft_sums(visibility, locations[row], seen, axes)
        error = np.abs(information_matrices(field.information(row, axes)) - expected)
        assert np.all(error.max((1, 2)) < 1e-5 * np.abs(expected).max((1, 2)))


@pytest.mark.parametrize("visibility", VISIBILITIES)
@pytest.mark.parametrize("masked", [False, True])
def test_sums_are_those_of_the_plain_twin(visibility: SoftVisibility, masked: bool, device: str) -> None:
    rng = np.random.default_rng(0)
    locations = rng.uniform(-2, 2, (40, 3))
    points = rng.uniform(-5, 5, (3000, 3))
    points[:5] = locations[:5] + 1e-4  # too near
    mask = rng.random((40, 3000)) < 0.4 if masked else None
    found = field_sums(locations, points, visibility, mask, device)
    plain = field_sums_plain(locations, points, visibility, mask)
    assert found.shape == plain.shape == (40, visibility.n_factors, 15)
    largest = np.abs(plain).max((1, 2), keepdims=True)
    assert np.all(np.abs(found - plain) < 1e-6 * largest)


@pytest.mark.parametrize("visibility", VISIBILITIES)
def test_a_map_far_from_the_origin(visibility: SoftVisibility) -> None:
    rng = np.random.default_rng(0)
    far = np.array([4e6, -2e6, 512.0])
    locations = rng.integers(-512, 512, (3, 3)) / 256
    points = rng.integers(-2048, 2048, (200, 3)) / 256
    near = FisherField.build(locations, points, visibility)
    np.testing.assert_array_equal(FisherField.build(locations + far, points + far, visibility).factors, near.factors)
    assert not FisherField.build(locations, np.empty((0, 3)), visibility).factors.any()


def test_the_stationary_axis_has_no_gradient() -> None:
    rng = np.random.default_rng(0)
    visibility = QuadraticVisibility(HALF_ANGLE)
    points = rng.normal((1, 2, 0), size=(100, 3))
    axis = stationary_axis_of_trace(FisherField.build(np.zeros((1, 3)), points, visibility), 0)
    distance = torch.from_numpy(np.linalg.norm(points, axis=1))
    bearings = torch.from_numpy(points) / distance[:, None]
    k1, k2, k3 = visibility.coefficients

    def trace(z: torch.Tensor) -> torch.Tensor:
        cosine = bearings @ z
        return ((k1 * cosine**2 + k2 * cosine + k3) * (2 / distance**2 + 2)).sum()

    hessian = torch.func.hessian(trace)(torch.zeros(3, dtype=torch.float64))
    gradient = torch.func.grad(trace)(torch.zeros(3, dtype=torch.float64))
    stationary = -torch.linalg.solve(hessian, gradient)
    np.testing.assert_allclose(axis, stationary / stationary.norm(), atol=1e-5)
