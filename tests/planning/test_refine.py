"""The local search about a direction."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import pytest

from planning.rooms import DIRECTIONS, GRID, free_voxels, room_landmarks, room_map
from wheretolook.planning.stops import refine_directions
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.registry import make_scorer


class Towards(Scorer):
    """Half of one plus the cosine to an axis."""

    name: ClassVar[str] = "towards"
    axis = np.array([0.3, -0.5, 0.2]) / np.linalg.norm([0.3, -0.5, 0.2])

    def score(self, cam_from_world):
        return (1 + cam_from_world[:, 2, :3] @ self.axis) / 2


def angle_deg(a, b):
    return np.degrees(2 * np.arcsin(np.linalg.norm(a - b, axis=-1) / 2))


def test_a_smooth_maximum_is_found_within_the_last_step():
    scorer = Towards(room_map(room_landmarks(10)))
    near = DIRECTIONS[np.argsort(-DIRECTIONS @ scorer.axis)[:3]]
    found = refine_directions(scorer, np.ones((3, 3)), 5 * near, 90, last_step_deg=0.1)
    assert angle_deg(found.axes, scorer.axis).max() < 0.1
    np.testing.assert_allclose(found.score, (1 + found.axes @ scorer.axis) / 2)
    assert np.all(found.score > (1 + near @ scorer.axis) / 2)


@pytest.mark.parametrize("method", ["bins", "random"])
def test_no_method_gets_worse_and_batches_change_nothing(method):
    scorer = make_scorer(method, room_map(room_landmarks(400)))
    locations = GRID.centers()[list(free_voxels())]
    scores = scorer.score_directions(locations, DIRECTIONS)
    best = DIRECTIONS[scores.argmax(axis=1)]
    found = refine_directions(scorer, locations, best)
    gain = found.score - scores.max(axis=1)
    assert np.all(gain >= -1e-12) and np.mean(gain > 1e-12) > 0.3
    again = [
        scorer.score_directions(at[None], axis[None])[0, 0] for at, axis in zip(locations, found.axes, strict=True)
    ]
    np.testing.assert_allclose(again, found.score, rtol=1e-6)
    assert angle_deg(found.axes, best).max() <= 10 + 1e-6
    alone = refine_directions(scorer, locations[4], best[4])
    np.testing.assert_allclose(alone.axes[0], found.axes[4], atol=1e-12)


@pytest.mark.parametrize(
    "locations, axes, angle",
    [([[0, 0, np.nan]], [[1, 0, 0]], 10), ([[0, 0, 0]], [[0, 0, 0]], 10), ([[0, 0, 0]], [[1, 0, 0]], 0)],
)
def test_invalid_input(locations, axes, angle):
    with pytest.raises(ValueError):
        refine_directions(Towards(room_map(room_landmarks(10))), locations, axes, angle)
