"""Views along a path: the exact sum against brute force, ActLoc's rule, and limits on the turns."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from planning.rooms import build, room_landmarks
from wheretolook.geometry.lattices import axes_of_angles, direction_lattice, yaw_pitch_angles
from wheretolook.geometry.poses import Float, rotation_angle_deg, rotation_looking_along
from wheretolook.planning.view_sequence import TurnLimit, best_sequence, greedy_sequence, resample_path
from wheretolook.utils.errors import PlanningError

LATTICES = {"yaw-pitch": direction_lattice(0, "yaw-pitch"), "fibonacci": direction_lattice(300)}


def turns_of(ids: np.ndarray, directions: Float, start: Float | None = None) -> Float:
    rotations = rotation_looking_along(directions[ids])
    if start is not None:
        rotations = np.concatenate([rotation_looking_along(start)[None], rotations])
    return rotation_angle_deg(rotations[1:], rotations[:-1])


@pytest.mark.parametrize("seed", range(30))
def test_no_sequence_is_better(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = rng.integers(1, 6)
    d = rng.integers(2, 7)
    directions = rng.normal(size=(d, 3)) + np.array([2, 0, 0]) * (seed % 2)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    scores = np.round(rng.random((n, d)), seed % 3 + 1)  # some are equal
    scores[rng.random((n, d)) < 0.2] = -np.inf
    limit = TurnLimit.of(directions, rng.uniform(5, 120))
    start = None if seed % 3 else rng.normal(size=3)
    best = -np.inf
    for ids in product(range(d), repeat=int(n)):
        if np.all(turns_of(np.array(ids), directions, start) <= limit.max_turn_deg):
            best = max(best, sum(scores[i, direction] for i, direction in enumerate(ids)))
    if np.isneginf(best):
        with pytest.raises(PlanningError, match="waypoint"):
            best_sequence(scores, limit, start)
        return
    found = best_sequence(scores, limit, start)
    assert found.total == pytest.approx(best, abs=1e-12)
    np.testing.assert_array_equal(found.scores, scores[np.arange(n), found.direction_ids])
    assert np.all(turns_of(found.direction_ids, directions, start) <= limit.max_turn_deg)


@pytest.mark.parametrize("lattice", LATTICES)
@pytest.mark.parametrize("max_turn_deg", [0.0, 20.0, 30.0, 45.0, 180.0])
def test_limits_hold_and_greedy_never_wins(lattice: str, max_turn_deg: float) -> None:
    directions = LATTICES[lattice]
    rng = np.random.default_rng(0)
    limit = TurnLimit.of(directions, max_turn_deg)
    wins = 0
    for _ in range(10):
        scores = rng.random((40, len(directions)))
        best = best_sequence(scores, limit)
        greedy = greedy_sequence(scores, limit)
        for found in (best, greedy):
            turns = turns_of(found.direction_ids, directions)
            assert turns.max() <= max_turn_deg + 2e-5
        assert best.total >= greedy.total - 1e-9
        wins += best.total > greedy.total + 1e-9
    assert wins == 10  # without a limit, too: what greedy saves in turns it pays in scores
    if max_turn_deg == 180:
        np.testing.assert_array_equal(best_sequence(scores, limit).direction_ids, scores.argmax(axis=1))
    if max_turn_deg == 0:
        assert set(best.direction_ids) == {scores.sum(axis=0).argmax()}


def test_on_20_degrees_the_benchmarks_limit_leaves_the_eight_neighbours() -> None:
    angles = yaw_pitch_angles()
    limit = TurnLimit.of(LATTICES["yaw-pitch"])
    across = np.abs(angles[:, None] - angles) / 20
    across[..., 0] = np.minimum(across[..., 0], 18 - across[..., 0])
    expected = across.max(axis=-1) <= 1
    for direction, near in enumerate(limit.neighbours):
        # turns of yaw and pitch together exceed 30 degrees nowhere, and two steps of yaw do everywhere
        np.testing.assert_array_equal(near[near < 108], np.flatnonzero(expected[direction]))


def test_it_is_the_turn_of_the_whole_camera_that_counts() -> None:
    down = axes_of_angles([[0.0, -80.0], [90.0, -80.0]])
    assert np.degrees(np.arccos(down[0] @ down[1])) < 30
    assert TurnLimit.of(down, 30).neighbours.tolist() == [[0], [1]]
    assert TurnLimit.of(down, 90).neighbours.tolist() == [[0, 1], [0, 1]]


@pytest.mark.parametrize("keep_limit", [True, False])
def test_the_greedy_rule_is_actlocs(keep_limit: bool) -> None:
    """On rows of pitch and columns of yaw, written out as ActLoc does."""
    directions = LATTICES["yaw-pitch"]
    rng = np.random.default_rng(3)
    limit = TurnLimit.of(directions, 30)
    scores = rng.random((50, 108))
    found = greedy_sequence(scores, limit, turn_penalty=0.05, keep_limit=keep_limit).direction_ids
    row, column = divmod(int(scores[0].argmax()), 18)
    assert found[0] == row * 18 + column
    for waypoint in range(1, 50):
        values = {}
        for r, c in product(range(6), range(18)):
            across = min(abs(c - column), 18 - abs(c - column))
            if not keep_limit or max(abs(r - row), across) <= 1:
                values[r * 18 + c] = scores[waypoint, r * 18 + c] - 0.05 * (abs(r - row) + across)
        best = max(values, key=lambda key: values[key])
        assert found[waypoint] == best
        row, column = divmod(best, 18)


def test_what_cannot_be_looked_along_names_the_waypoint() -> None:
    directions = np.eye(3)
    limit = TurnLimit.of(directions, 30)
    scores = np.ones((4, 3))
    with pytest.raises(PlanningError, match="waypoint 0 has no direction that is allowed within 30 degrees of the st"):
        best_sequence(scores, limit, start=(-1, 0, 0))
    with pytest.raises(PlanningError, match="waypoint 0"):
        greedy_sequence(scores, limit, start=(-1, 0, 0))
    assert greedy_sequence(scores, limit, start=(-1, 0, 0), keep_limit=False).total == 4
    scores[2] = -np.inf
    with pytest.raises(PlanningError, match="waypoint 2 has no direction that is allowed within 30 degrees of waypo"):
        best_sequence(scores, limit)
    scores[2, 1] = 1
    scores[1, 1] = -np.inf
    for plan in (best_sequence, greedy_sequence):
        with pytest.raises(PlanningError, match="waypoint 2") as caught:
            plan(scores, limit)
        assert caught.value.value == 2 and caught.value.fix
    scores[0] = -np.inf
    with pytest.raises(PlanningError, match="waypoint 0 has no direction that is allowed "):
        best_sequence(scores, limit)


def test_a_start_is_an_axis_or_a_rotation() -> None:
    directions = LATTICES["fibonacci"]
    scores = np.random.default_rng(0).random((5, 300))
    limit = TurnLimit.of(directions, 40)
    start = np.array([1.0, 2, 0.3])
    by_axis, by_rotation = (best_sequence(scores, limit, one) for one in (start, rotation_looking_along(start)))
    np.testing.assert_array_equal(by_axis.direction_ids, by_rotation.direction_ids)
    assert turns_of(by_axis.direction_ids, directions, start).max() <= 40


def test_bad_scores_are_refused() -> None:
    limit = TurnLimit.of(np.eye(3))
    for bad in (np.ones((2, 4)), np.ones(3), np.empty((0, 3)), [[1, np.nan, 0]], [[1, np.inf, 0]]):
        for plan in (best_sequence, greedy_sequence):
            with pytest.raises(ValueError, match="scores"):
                plan(bad, limit)
    with pytest.raises(ValueError, match="penalty"):
        greedy_sequence(np.ones((1, 3)), limit, turn_penalty=-1)
    with pytest.raises(ValueError, match="unit vectors"):
        TurnLimit.of(2 * np.eye(3))
    with pytest.raises(ValueError, match="at least 0"):
        TurnLimit.of(np.eye(3), np.nan)


def test_paths_are_cut_every_20_cm() -> None:
    path = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 0], [1, 0.5, 0]])
    waypoints = resample_path(path)
    along = [*np.arange(0, 1.5, 0.2), 1.5]
    np.testing.assert_allclose(waypoints, [(min(s, 1), max(0, s - 1), 0) for s in along], atol=1e-12)
    assert len(resample_path(path[:2])) == 6  # the end is a stop, once
    np.testing.assert_array_equal(resample_path(path[:1]), path[:1])
    np.testing.assert_array_equal(resample_path([path[0], path[0]]), path[:1])
    for bad in (np.empty((0, 3)), np.ones((2, 2)), [[0, 0, np.nan]]):
        with pytest.raises(ValueError, match="path"):
            resample_path(bad)
    with pytest.raises(ValueError, match="spacing"):
        resample_path(path, 0)


def test_a_path_through_a_viewpoint_map() -> None:
    viewpoint_map = build(room_landmarks(300), directions=LATTICES["fibonacci"])
    a = viewpoint_map.locations[0]
    b = viewpoint_map.locations[1]
    waypoints = resample_path([a, b])
    scores = viewpoint_map.scores[viewpoint_map.rows(waypoints)]
    limit = TurnLimit.of(viewpoint_map.directions)
    assert best_sequence(scores, limit).total >= greedy_sequence(scores, limit).total
