"""Hidden-point removal against closed forms, a linear program, an independent library and a mesh."""

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import linprog
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from box_scenes import ROOM, furnished_room
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.utils.errors import ConfigError, MapError, SceneError
from wheretolook.visibility.hidden_points import (
    LEAST_POINTS,
    HiddenPointRemoval,
    hull_length,
    may_be_near_hull,
    on_hull,
    on_hull_plain,
)
from wheretolook.visibility.occlusion import CachedOcclusion

ORIGIN = np.zeros((1, 3))


def hull_length_plain(points, direction):
    """Largest t with t * direction = sum of w_i points_i, w_i >= 0, sum of w_i <= 1 (the rest is the origin's)."""
    equations = np.column_stack([points.T, -direction])
    shares = np.append(np.ones(len(points)), 0)[None]
    found = linprog(np.append(np.zeros(len(points)), -1), shares, [1], equations, np.zeros(3))
    assert found.success
    return float(found.x[-1])


def free_plain(location, points, radius, margin_m):
    """The definition: no mix of flipped landmarks and the location reaches farther out than the landmark's own."""
    lines = points - location
    distance = np.linalg.norm(lines, axis=1)
    big = radius * distance.max()
    flipped = lines * ((2 * big - distance) / distance)[:, None]
    reach = np.array([hull_length_plain(flipped, line) for line in lines / distance[:, None]])
    return reach <= 2 * big - distance + margin_m + 1e-9 * big


def surfaces(seed, n):
    """Points on the furnished room's surfaces, 5 mm off, and locations inside it."""
    rng = np.random.default_rng(seed)
    mesh = furnished_room()
    points, _ = trimesh.sample.sample_surface(trimesh.Trimesh(mesh.vertices, mesh.triangles), n, seed=seed)
    locations = rng.uniform((0.5, 2.2, 1.0), (3.5, 4.5, 2.5), (8, 3))
    return points + rng.normal(scale=0.005, size=(n, 3)), locations


@pytest.mark.parametrize("radius", [1.0, 10.0, 1e3, 1e6])
def test_a_sphere_is_seen_from_its_centre(radius):
    points = 3 * fibonacci_sphere(500)
    assert HiddenPointRemoval(radius).unoccluded(ORIGIN, points).all()


def test_few_landmarks():
    model = HiddenPointRemoval(margin_m=0)
    assert model.unoccluded(ORIGIN, np.array([[1.0, 2, 3]])).tolist() == [[True]]
    ray = np.array([[2.0, 0, 0], [1, 0, 0], [-3, 0, 0], [-2, 0, 0]])
    assert model.unoccluded(ORIGIN, ray).tolist() == [[False, True, False, True]]
    assert model.unoccluded(ORIGIN, np.array([[1.0, 0, 0], [0, 1, 0]])).all()
    assert model.unoccluded(ORIGIN, np.eye(3)).all()
    assert model.unoccluded(np.zeros((0, 3)), np.eye(3)).shape == (0, 3)


def test_landmarks_in_one_plane_with_the_location():
    """A ring in a tilted plane hides a ring outside it, and a third one is nearer than the margin behind the first."""
    turn = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    ring = np.column_stack([np.cos(turn), np.sin(turn), 0 * turn]) @ Rotation.from_rotvec([0.4, 1.1, 0.2]).as_matrix()
    points = np.concatenate([ring, 2 * ring, 1.03 * ring])
    for margin_m, third in ((0.05, True), (0.02, False)):
        seen = HiddenPointRemoval(10, margin_m).unoccluded(ORIGIN, points)[0]
        assert seen.tolist() == [True] * 60 + [False] * 60 + [third] * 60


@pytest.mark.parametrize("radius, margin_m", [(1.0, 0.0), (3.0, 0.05), (100.0, 0.0), (100.0, 0.05)])
def test_agrees_with_the_definition(radius, margin_m):
    points = surfaces(1, 45)[0]
    locations = np.array([[2.0, 3, 1.5], [0.5, 4, 2.2], [9, 2, 1], [40, 50, -30]])  # the last two see it from outside
    seen = HiddenPointRemoval(radius, margin_m).unoccluded(locations, points)
    expected = np.stack([free_plain(location, points, radius, margin_m) for location in locations])
    assert_array_equal(seen, expected)
    assert 0.05 < seen.mean() < 0.95 or radius == 100


def test_climbing_finds_the_facet_that_a_search_of_all_finds():
    """Also where many facets lie in one plane: the points of a lattice in a cube, from its middle."""
    lattice = np.stack(np.meshgrid(*[np.arange(-2.0, 3)] * 3), axis=-1).reshape(-1, 3)
    for points in (surfaces(3, 3000)[0] - np.array(ROOM) / 2, lattice[np.any(lattice != 0, axis=1)]):
        hull = ConvexHull(points)
        directions = np.random.default_rng(0).normal(size=(2000, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        along = directions @ hull.equations[:, :3].T
        expected = 1 / (along / -hull.equations[:, 3]).max(axis=1)
        assert_allclose(hull_length(hull, directions), expected, rtol=1e-12)


def test_the_number_of_threads_changes_nothing(monkeypatch):
    points, locations = surfaces(5, 2000)
    masks = []
    for threads in (1, 5):
        monkeypatch.setattr("wheretolook.visibility.hidden_points.cores", lambda threads=threads: threads)
        masks.append(HiddenPointRemoval(20, 0.05).unoccluded(locations, points))
    assert_array_equal(*masks)


def seen_from(points, at, radius=50.0):
    """Directions and lengths of the hull's points, and 5 cm, as the model has them."""
    lines = points - at
    distance = np.linalg.norm(lines, axis=1)
    unit = 2 * radius * distance.max()
    return lines / distance[:, None], 1 - distance / unit, 0.05 / unit


@pytest.mark.parametrize("radius", [1.0, 50.0])
def test_a_building_of_many_landmarks_has_the_hull_of_all(rng, radius):
    size = np.array([30.0, 20.0, 6.0])
    room = np.array([6.0, 5.0, 3.0])
    n = 2 * LEAST_POINTS
    points = rng.uniform((0, 0, 0), size, (n, 3))
    axis = rng.integers(0, 3, n)
    points[np.arange(n), axis] = rng.integers(0, (size / room)[axis].astype(int) + 1) * room[axis]  # on walls
    for at in ((8.0, 7, 1.5), (-5.0, -4, 1)):  # in a room, and outside of all, where the location is a corner
        directions, lengths, margin = seen_from(points, np.array(at), radius)
        near = may_be_near_hull(directions, lengths, margin)
        assert near.mean() < 0.6  # most need not be looked at
        for asked in (0.0, margin):
            expected = on_hull_plain(directions, lengths, asked)
            assert np.array_equal(on_hull(directions, lengths, asked), expected)
            assert 0.01 < expected.mean() < 0.5


@pytest.mark.parametrize(
    ("error", "options", "location", "points"),
    [
        (MapError, {}, (0, 0, 0), np.zeros((0, 3))),
        (MapError, {}, (0, 0, 0), np.array([[0, 0, 1.0], [1, np.nan, 2]])),
        (SceneError, {}, (0, 1, 0), np.eye(3)),
        (SceneError, {}, (0, np.inf, 0), np.eye(3)),
        (ConfigError, {"radius": 0.9}, (0, 0, 0), np.eye(3)),
        (ConfigError, {"margin_m": -0.1}, (0, 0, 0), np.eye(3)),
    ],
)
def test_invalid_input(error, options, location, points):
    with pytest.raises(error):
        HiddenPointRemoval(**options).unoccluded(np.array([location], dtype=float), points)


def test_cached_results_are_those_of_the_same_landmarks(rng):
    points = rng.normal(size=(300, 3)) * 3
    location = np.zeros((1, 3))
    cached = CachedOcclusion(HiddenPointRemoval())
    for some in (points, points[::2], points[1::2], points):
        expected = HiddenPointRemoval().unoccluded(location, some)
        for _ in range(2):
            assert_array_equal(cached.unoccluded(location, some), expected)
