"""Views along a path: the exact optimum against brute force, and limits on rotations."""

from itertools import product

import numpy as np
import pytest

from wheretolook.geometry.lattices import direction_lattice, yaw_pitch_angles
from wheretolook.geometry.poses import rotation_angle_deg, rotation_looking_along
from wheretolook.planning.view_sequence import TurnLimit, best_sequence
from wheretolook.utils.errors import PlanningError


def turns_of(ids, directions, start=None):
    rotations = rotation_looking_along(directions[ids])
    if start is not None:
        rotations = np.concatenate([rotation_looking_along(start)[None], rotations])
    return rotation_angle_deg(rotations[1:], rotations[:-1])


@pytest.mark.parametrize("seed", range(12))
def test_no_sequence_is_better(seed):
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
        with pytest.raises(PlanningError):
            best_sequence(scores, limit, start)
        return
    found = best_sequence(scores, limit, start)
    if start is not None:
        by_rotation = best_sequence(scores, limit, rotation_looking_along(start))
        np.testing.assert_array_equal(by_rotation.direction_ids, found.direction_ids)
    assert found.scores.sum() == pytest.approx(best, abs=1e-12)
    np.testing.assert_array_equal(found.scores, scores[np.arange(n), found.direction_ids])
    assert np.all(turns_of(found.direction_ids, directions, start) <= limit.max_turn_deg)


def test_on_20_degrees_the_benchmarks_limit_leaves_the_eight_neighbours():
    angles = yaw_pitch_angles()
    limit = TurnLimit.of(direction_lattice(0, "yaw-pitch"))
    across = np.abs(angles[:, None] - angles) / 20
    across[..., 0] = np.minimum(across[..., 0], 18 - across[..., 0])
    expected = across.max(axis=-1) <= 1
    for direction, near in enumerate(limit.neighbours):
        # turns of yaw and pitch together exceed 30 degrees nowhere, and two steps of yaw do everywhere
        np.testing.assert_array_equal(near[near < 108], np.flatnonzero(expected[direction]))


def test_unreachable_waypoint_is_reported():
    limit = TurnLimit.of(np.eye(3), 30)
    scores = np.ones((4, 3))
    with pytest.raises(PlanningError) as caught:
        best_sequence(scores, limit, start=(-1, 0, 0))
    assert caught.value.value == 0
    scores[2] = -np.inf
    with pytest.raises(PlanningError) as caught:
        best_sequence(scores, limit)
    assert caught.value.value == 2


@pytest.mark.parametrize("scores", [np.ones((2, 4)), np.ones(3), np.empty((0, 3)), [[1, np.nan, 0]]])
def test_invalid_scores(scores):
    with pytest.raises(ValueError):
        best_sequence(scores, TurnLimit.of(np.eye(3)))


def test_a_limit_is_a_number():
    with pytest.raises(ValueError):
        TurnLimit.of(np.eye(3), np.nan)
