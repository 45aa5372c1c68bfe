"""Queries of a viewpoint map against brute force over its arrays, and its build against the scorer."""

import numpy as np
import pytest

from planning.rooms import CAMERA, DIRECTIONS, GRID, TURNED, build, free_voxels, occlusion, room_landmarks, room_map
from wheretolook.geometry.poses import poses_looking_along, rotation_angle_deg, rotation_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.map import Map
from wheretolook.mapping.map_frame import MapFrame
from wheretolook.planning.scene_map import build_viewpoint_map
from wheretolook.scorers.registry import make_scorer
from wheretolook.utils.errors import ConfigError, SceneError


@pytest.fixture(scope="module")
def viewpoint_map():
    return build(room_landmarks(400))


def points_about(n, seed=0):
    """Points in the grid and around it."""
    return np.random.default_rng(seed).uniform(np.array(GRID.lower) - 0.5, np.array(GRID.upper) + 0.5, (n, 3))


def row_by_hand(viewpoint_map, point):
    """The nearest voxel centre, if the point lies in the grid and the voxel is free."""
    if np.any(point < GRID.lower) or np.any(point > GRID.upper):
        return -1
    voxel = int(np.linalg.norm((GRID.centers() - point) / GRID.voxel_m, ord=np.inf, axis=1).argmin())
    return [*viewpoint_map.voxel_of_row].index(voxel) if voxel in viewpoint_map.voxel_of_row else -1


def best_by_hand(viewpoint_map, row, allowed):
    """The allowed direction of highest score; bins' scores differ by more than rounding or are the same."""
    if row < 0 or not allowed.any():
        return None
    return int(np.where(allowed, viewpoint_map.scores[row], -1).argmax())


def id_of(choice):
    return None if choice is None else choice.direction_id


def test_every_direction_of_every_free_voxel_has_its_score_and_count(viewpoint_map):
    localization_map = room_map(room_landmarks(400))
    centers = GRID.centers()[list(free_voxels())]
    np.testing.assert_array_equal(viewpoint_map.locations, centers)
    views = poses_looking_along(np.repeat(centers, len(DIRECTIONS), axis=0), np.tile(DIRECTIONS, (len(centers), 1)))
    scores = make_scorer("bins", localization_map).score(views)
    np.testing.assert_array_equal(viewpoint_map.scores.ravel(), scores.astype(np.float32))
    n_visible = np.diff(localization_map.landmarks_in_view(views).starts)
    np.testing.assert_array_equal(viewpoint_map.n_visible.ravel(), n_visible)
    np.testing.assert_array_equal(viewpoint_map.ranked, np.argsort(-scores.reshape(-1, 60), axis=1, kind="stable"))
    origin = viewpoint_map.origin
    assert (origin.scorer, origin.lattice, origin.occlusion) == ("bins", "fibonacci", "mesh")
    assert origin.camera == {"model": "PINHOLE", "width": 160, "height": 120, "params": [80.0, 80.0, 80.0, 60.0]}


def test_queries_equal_brute_force(viewpoint_map):
    rng = np.random.default_rng(1)
    points = points_about(150)
    everything = np.ones(len(DIRECTIONS), dtype=bool)
    many = viewpoint_map.best_many(points)
    assert 20 < (many.direction_id >= 0).sum() < 130
    for number, point in enumerate(points):
        row = row_by_hand(viewpoint_map, point)
        assert viewpoint_map.row(point) == row
        best = viewpoint_map.best(point)
        expected = best_by_hand(viewpoint_map, row, everything)
        assert id_of(best) == expected and (many.direction_id[number] >= 0) == (row >= 0)
        if best is None:
            assert viewpoint_map.best_n(point, 3) is None
            assert (many.direction_id[number], many.n_visible[number]) == (-1, 0) and np.isnan(many.score[number])
        else:
            np.testing.assert_allclose(many.positions[number], point, atol=1e-12)
            np.testing.assert_array_equal(many.axes[number], rotation_looking_along(best.axis)[2])
            values = (viewpoint_map.scores[row, expected], viewpoint_map.n_visible[row, expected])
            assert (best.score, best.n_visible) == (many.score[number], many.n_visible[number]) == values
            np.testing.assert_array_equal(best.axis, DIRECTIONS[expected])
            top = viewpoint_map.best_n(point, 7)
            np.testing.assert_array_equal([c.score for c in top], np.sort(viewpoint_map.scores[row])[::-1][:7])
        axis = rng.normal(size=3)
        limit = rng.uniform(1, 90)
        in_cone = np.degrees(np.arccos(np.clip(DIRECTIONS @ axis / np.linalg.norm(axis), -1, 1))) <= limit
        assert id_of(viewpoint_map.best_in_cone(point, axis, limit)) == best_by_hand(viewpoint_map, row, in_cone)
        turn = rotation_looking_along(axis)
        near = rotation_angle_deg(turn, rotation_looking_along(DIRECTIONS)) <= limit
        for start in (axis, turn):
            assert id_of(viewpoint_map.best_reachable(point, start, limit)) == best_by_hand(viewpoint_map, row, near)


def test_a_map_of_a_turned_model_answers_in_its_frame(viewpoint_map):
    landmarks = room_landmarks(400)
    there = LocalizationMap(Map(landmarks, frame=MapFrame(TURNED)), CAMERA, occlusion())
    turned = build_viewpoint_map(make_scorer("bins", there), GRID, free_voxels(), DIRECTIONS, "fibonacci")
    for number, point in enumerate(points_about(40, seed=3)):
        at = TURNED.inverse.apply(point)
        expected = viewpoint_map.best(point)
        best = turned.best(at)
        assert id_of(best) == id_of(expected) and turned.rows([at])[0] == viewpoint_map.row(point)
        if best is None:
            continue
        np.testing.assert_allclose(TURNED.rotation @ best.axis, expected.axis, atol=1e-12)
        np.testing.assert_allclose(turned.interpolated(at), viewpoint_map.interpolated(point), atol=1e-9)
        many = turned.best_many([at])
        np.testing.assert_allclose(many.positions, [at], atol=1e-9)
        np.testing.assert_allclose(many.axes, [best.axis], atol=1e-12)
        in_world = viewpoint_map.best_many([point]).cam_from_world[0, :, :3]
        np.testing.assert_allclose(many.cam_from_world[0, :, :3], in_world @ TURNED.rotation, atol=1e-12)
        axis = TURNED.rotation.T @ AXIS
        start = rotation_looking_along(AXIS) @ TURNED.rotation
        for name, own, world in (
            ("best_in_cone", axis, AXIS),
            ("best_reachable", axis, AXIS),
            ("best_reachable", start, AXIS),
        ):
            found, expected = getattr(turned, name)(at, own, 40.0), getattr(viewpoint_map, name)(point, world, 40.0)
            assert id_of(found) == id_of(expected)
        if number < 3:
            looks = turned.best_looks(at, 2, 100.0, scorer=make_scorer("bins", there), start=axis)
            expected = viewpoint_map.best_looks(point, 2, 100.0, scorer=make_scorer("bins", there), start=AXIS)
            assert [*map(id_of, looks)] == [*map(id_of, expected)]
    np.testing.assert_allclose(TURNED.apply(turned.locations), viewpoint_map.locations, atol=1e-9)


def test_interpolation_lies_between_free_neighbours_and_is_trilinear(viewpoint_map):
    centers = GRID.centers()
    n_partial = 0
    for point in points_about(200, seed=2):
        scores = viewpoint_map.interpolated(point)
        if scores is None:
            continue
        weights = np.clip(1 - np.abs((centers - point) / GRID.voxel_m), 0, None).prod(axis=1)
        weights = np.where(viewpoint_map.row_of_voxel >= 0, weights, 0)
        used = np.flatnonzero(weights > 0)
        neighbours = viewpoint_map.scores[viewpoint_map.row_of_voxel[used]].astype(np.float64)
        np.testing.assert_allclose(scores, weights[used] / weights[used].sum() @ neighbours, atol=1e-12)
        n_partial += 1 < len(used) < 8
    assert n_partial > 10  # some neighbours were occupied or outside the grid


def test_limits_include_their_border(viewpoint_map):
    point = viewpoint_map.locations[0]
    for axis in DIRECTIONS:
        at = viewpoint_map.best_in_cone(point, axis, 0)
        np.testing.assert_array_equal(at.axis, axis)
        assert id_of(viewpoint_map.best_reachable(point, axis, 0)) == at.direction_id
    assert viewpoint_map.best_in_cone(point, DIRECTIONS[30] + DIRECTIONS[31], 0.1) is None
    for beyond in (np.nextafter(GRID.lower, -1), np.nextafter(GRID.upper, 10), np.array([1e9, 1, 1])):
        assert viewpoint_map.best(beyond) is None and viewpoint_map.best_many(beyond[None]).direction_id[0] == -1
    assert len(viewpoint_map.best_many(np.empty((0, 3)))) == 0


def test_looks_are_chosen_together_in_a_free_voxel(viewpoint_map):
    scorer = make_scorer("bins", room_map(room_landmarks(400)))
    point = viewpoint_map.locations[3]
    looks = viewpoint_map.best_looks(point, 3, scorer=scorer)
    assert len({look.direction_id for look in looks}) == 3
    near = viewpoint_map.best_looks(point, 3, 100.0, scorer=scorer, start=looks[0].axis)
    rotations = rotation_looking_along(np.array([looks[0].axis, *(look.axis for look in near)]))
    assert rotation_angle_deg(rotations[:-1], rotations[1:]).sum() <= 100 + 1e-4
    assert viewpoint_map.best_looks(np.array(GRID.upper) + 1, 2, scorer=scorer) is None
    for request in ({"n": 2, "scorer": make_scorer("visible", scorer.localization_map)}, {"n": 9, "scorer": scorer}):
        with pytest.raises(ConfigError):
            viewpoint_map.best_looks(point, **request)


INSIDE = (1.0, 1.0, 1.0)
AXIS = (1, 0, 0)


@pytest.mark.parametrize(
    "query, arguments",
    [
        ("best", [(1.0, np.nan, 1.0)]),
        ("best_many", [INSIDE]),
        ("best_n", [INSIDE, 0]),
        ("best_in_cone", [INSIDE, AXIS, -1]),
        ("best_in_cone", [INSIDE, (0, np.nan, 0), 10]),
        ("best_reachable", [INSIDE, (0, 0, 0), 10]),
        ("best_reachable", [INSIDE, np.diag([1.0, 1.0, -1.0]), 180.0]),
    ],
)
def test_invalid_queries(viewpoint_map, query, arguments):
    with pytest.raises(ValueError):
        getattr(viewpoint_map, query)(*arguments)


@pytest.mark.parametrize(
    "free, directions, error",
    [
        ([], DIRECTIONS, SceneError),
        ([len(GRID)], DIRECTIONS, ConfigError),
        ([0], np.ones((65_537, 3)), ConfigError),
        ([0], [[0, 0, 0]], ValueError),
    ],
)
def test_invalid_maps(free, directions, error):
    with pytest.raises(error):
        build_viewpoint_map(make_scorer("bins", room_map(room_landmarks(50))), GRID, free, directions)
