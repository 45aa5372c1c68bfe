"""The voxel grid and the direction lattices against values known from elsewhere."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import cKDTree

from wheretolook.geometry.lattices import (
    VoxelGrid,
    axes_of_angles,
    direction_lattice,
    fibonacci_sphere,
    released_lattice,
    yaw_pitch_angles,
)
from wheretolook.utils.errors import ConfigError


def covering_radius_deg(directions):
    """Largest angle from any direction to the nearest of the lattice, over 200,000 random probes."""
    probes = np.random.default_rng(0).normal(size=(200_000, 3))
    probes /= np.linalg.norm(probes, axis=1, keepdims=True)
    chord, _ = cKDTree(directions).query(probes)
    return float(np.degrees(2 * np.arcsin(chord.max() / 2)))


def test_fibonacci_covers_the_sphere_three_times_finer_than_the_released_lattice():
    assert covering_radius_deg(fibonacci_sphere(500)) == pytest.approx(6.9, abs=0.1)
    assert covering_radius_deg(released_lattice(500)) == pytest.approx(20.3, abs=0.4)


@pytest.mark.parametrize("lattice", ["fibonacci", "azimuth-elevation", "released"])
@pytest.mark.parametrize("n", [1, 2, 50, 500])
def test_lattices_are_distinct_unit_vectors(lattice, n):
    directions = direction_lattice(n, lattice)
    assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-12)
    assert len(np.unique(directions.round(9), axis=0)) == len(directions)


def test_the_benchmarks_yaws_and_pitches():
    directions = direction_lattice(500, "yaw-pitch")
    assert directions.shape == (108, 3)
    pitches = np.degrees(np.arcsin(directions[:, 2])).round(9)
    assert np.unique(pitches).tolist() == [-60, -40, -20, 0, 20, 40]
    assert_allclose(axes_of_angles([[0, 0], [90, 0], [0, 90]]), np.eye(3), atol=1e-15)
    assert_allclose(axes_of_angles(yaw_pitch_angles()), directions)


def test_centres_and_ids_are_inverse():
    grid = VoxelGrid.over([[-1, 0, 2], [3, 2, 5]], (8, 4, 3))
    assert len(grid) == 96
    assert_allclose(grid.centers()[0], [-0.75, 0.25, 2.5])
    assert_array_equal(grid.location_ids(grid.centers()), np.arange(96))


def test_points_outside_have_no_voxel_and_the_upper_face_has_one():
    grid = VoxelGrid.over([[0, 0, 0], [1, 1, 1]], (2, 2, 2))
    points = [[-1e-9, 0.5, 0.5], [0.5, 1.1, 0.5], [np.nan, 0.5, 0.5], [1, 1, 1], [0, 0, 0]]
    assert_array_equal(grid.location_ids(points), [-1, -1, -1, 7, 0])


@pytest.mark.parametrize(("upper", "shape"), [((1, 0, 1), (8, 8, 8)), ((1, 1, 1), (8, 0, 8))])
def test_invalid_grids(upper, shape):
    with pytest.raises(ConfigError):
        VoxelGrid.over([(0, 0, 0), upper], shape)
    with pytest.raises(ConfigError):
        fibonacci_sphere(0)
