"""ActLoc's greedy rule, and evenly spaced waypoints."""

from itertools import product

import numpy as np

from wheretolook.geometry.lattices import direction_lattice
from wheretolook.planning.view_sequence import TurnLimit, best_sequence
from wheretolook_paper.paths.path_comparison import greedy_sequence, resample_path


def test_greedy_rule_is_actlocs():
    """Written out for rows of pitch and columns of yaw."""
    directions = direction_lattice(0, "yaw-pitch")
    limit = TurnLimit.of(directions, 30)
    scores = np.random.default_rng(3).random((50, 108))
    sequence = greedy_sequence(scores, limit)
    ids = sequence.direction_ids
    row, column = divmod(int(scores[0].argmax()), 18)
    assert ids[0] == row * 18 + column
    for waypoint in range(1, 50):
        values = {}
        for r, c in product(range(6), range(18)):
            across = min(abs(c - column), 18 - abs(c - column))
            if max(abs(r - row), across) <= 1:
                values[r * 18 + c] = scores[waypoint, r * 18 + c] - 0.02 * (abs(r - row) + across)
        best = max(values, key=lambda key: values[key])
        assert ids[waypoint] == best
        row, column = divmod(best, 18)
    assert best_sequence(scores, limit).scores.sum() > sequence.scores.sum()


def test_waypoints_every_20_cm():
    path = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 0], [1, 0.5, 0]])
    along = [*np.arange(0, 1.5, 0.2), 1.5]
    np.testing.assert_allclose(resample_path(path), [(min(s, 1), max(0, s - 1), 0) for s in along], atol=1e-12)
    assert len(resample_path(path[:2])) == 6  # the end is a waypoint once
    np.testing.assert_array_equal(resample_path([path[0], path[0]]), path[:1])
