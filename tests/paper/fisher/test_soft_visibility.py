"""Soft visibilities against published numbers and against scikit-learn's Gaussian process."""

import numpy as np
import pytest
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF

from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook_paper.fisher.soft_visibility import (
    JITTER,
    GaussianProcessVisibility,
    QuadraticVisibility,
    cone_half_angle,
)

QUARTER = np.pi / 4

PUBLISHED_LENGTHS = {30: 0.646, 50: 0.481, 70: 0.452, 100: 0.389, 120: 0.365, 150: 0.348}
"""Of rpg_information_field, params/fov_approximator_gp/fov45_fs*_lm1000_k15/kernel_params.txt."""


def random_directions(n, seed):
    vectors = np.random.default_rng(seed).normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def values(visibility, axes, bearings):
    """v of axes (D, 3) and bearings (N, 3); (D, N)."""
    return visibility.of_axes(axes) @ visibility.finish(visibility.of_bearings(bearings).T)


@pytest.mark.parametrize(
    ("boundary", "coefficients"), [(0.5, (0.70710678, 0.5, -0.20710678)), (0.8, (0.10710678, 0.5, 0.39289322))]
)
def test_published_coefficients(boundary, coefficients):
    found = QuadraticVisibility(QUARTER, boundary, boundary).coefficients
    np.testing.assert_allclose(found, coefficients, atol=1e-8)


def test_scikit_learn_predicts_the_same():
    visibility = GaussianProcessVisibility(QUARTER, 0.45, n_factors=70)
    axes = random_directions(200, 0)
    bearings = random_directions(30, 1)
    seen = 1 / (1 + np.exp(-15 * (visibility.axes @ bearings.T - np.cos(QUARTER))))
    process = GaussianProcessRegressor(RBF(0.45, "fixed"), alpha=JITTER, optimizer=None)
    expected = process.fit(visibility.axes, seen).predict(axes)
    np.testing.assert_allclose(values(visibility, axes, bearings), expected, atol=1e-9)


@pytest.mark.parametrize("n_factors", PUBLISHED_LENGTHS)
def test_fitted_lengths_are_near_the_published_ones(n_factors):
    found = GaussianProcessVisibility.fitted(QUARTER, n_factors).length
    assert found == pytest.approx(PUBLISHED_LENGTHS[n_factors], rel=0.01 if n_factors >= 50 else 0.06)


def test_the_cone_has_the_solid_angle_of_the_field_of_view():
    cube_face = PinholeCamera(600, 600, 300.0)  # a sixth of the sphere
    assert 2 * np.pi * (1 - np.cos(cone_half_angle(cube_face))) == pytest.approx(4 * np.pi / 6)
    narrow = PinholeCamera(200, 100, 1e4)
    assert 2 * np.pi * (1 - np.cos(cone_half_angle(narrow))) == pytest.approx(0.02 * 0.01, rel=1e-3)
    colmap = ColmapCamera("PINHOLE", 640, 480, (320.0, 320.0, 320.0, 240.0))
    assert cone_half_angle(colmap) == pytest.approx(cone_half_angle(PinholeCamera()), rel=0.01)
    fisheye = ColmapCamera("OPENCV_FISHEYE", 640, 480, (200.0, 200.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0))
    assert 1.0 < cone_half_angle(fisheye) < np.pi / 2
