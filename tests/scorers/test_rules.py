"""Views near a heading."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from synthetic_dataset import make_landmarks
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.map import Map
from wheretolook.scorers.forward import ForwardScorer
from wheretolook.scorers.registry import make_scorer

CAMERA = PinholeCamera(320, 320, 277.0)


@pytest.fixture
def localization_map():
    return LocalizationMap(Map(make_landmarks(np.random.default_rng(0), 400)), CAMERA)


def test_forward_prefers_the_heading(localization_map):
    directions = fibonacci_sphere(200)
    poses = poses_looking_along(np.zeros((200, 3)), directions)
    for heading in ((1.0, 0, 0), (0, -20.0, 0), (1, 1, 1e-3)):
        scores = ForwardScorer(localization_map, heading).score(poses)
        unit = np.array(heading) / np.linalg.norm(heading)
        assert_array_equal(np.argsort(-scores), np.argsort(-directions @ unit))
        assert 0 <= scores.min() < 0.01 and 0.99 < scores.max() <= 1
    straight = poses_looking_along(np.zeros((3, 3)), [[1.0, 0, 0], [0, 1, 0], [-1, 0, 0]])
    assert_allclose(ForwardScorer(localization_map, (1, 0, 0)).score(straight), [1, 0.5, 0])


def test_forward_follows_a_path(localization_map):
    path = [[0.0, 0, 1], [4, 0, 1], [4, 3, 1], [4, 3, 2]]
    scorer = ForwardScorer(localization_map, path)
    at = [[-5.0, 0, 1], [1, 0.5, 1], [3.5, 2, 1], [5, 2.9, 3]]
    assert_allclose(scorer.headings(at), [[1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert_allclose(scorer.score(poses_looking_along(at, np.tile([0.0, 1, 0], (4, 1)))), [0.5, 0.5, 1, 0.5])
    by_name = make_scorer("forward", localization_map, heading=tuple(map(tuple, path)))
    assert_allclose(by_name.headings(at), scorer.headings(at))


def test_without_a_heading_one_is_drawn_for_each_location(localization_map):
    at = np.random.default_rng(0).uniform(-5, 5, (4000, 3))
    headings = ForwardScorer(localization_map, seed=1).headings(at)
    assert_allclose(np.linalg.norm(headings, axis=1), 1)
    assert not headings[:, 2].any() and np.abs(headings.mean(0)).max() < 0.05  # in every direction alike
    assert_array_equal(ForwardScorer(localization_map, seed=1).headings(at[7:9]), headings[7:9])
    assert np.abs(ForwardScorer(localization_map, seed=2).headings(at) - headings).max(1).mean() > 0.5


@pytest.mark.parametrize(
    "heading", [(0.0, 0, 0), (np.nan, 0, 1), (np.inf, 0, 0), (1.0, 0), [[1.0, 0, 0]], [[1.0, 0, 0], [1, 0, 0]]]
)
def test_invalid_headings(heading, localization_map):
    with pytest.raises(ValueError):
        ForwardScorer(localization_map, heading)
