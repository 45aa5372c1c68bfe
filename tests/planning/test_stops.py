"""Stops: where one look will not do, the fewest further looks that reach what is asked, or that gain what they cost."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from planning.rooms import CAMERA, occlusion, room_landmarks
from wheretolook.geometry.lattices import direction_lattice
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.map import Map
from wheretolook.planning.config import PathConfig, StopConfig
from wheretolook.planning.routes import PlannedPath
from wheretolook.planning.scene_map import path_views
from wheretolook.planning.stops import stops_along, within_pitch
from wheretolook.planning.view_sequence import TurnLimit, best_sequence
from wheretolook.scorers.registry import make_scorer
from wheretolook.utils.errors import ConfigError

WEIGHTS = Path(__file__).parents[2] / "data" / "release" / "weights" / "set.safetensors"
PLANNER = PathConfig(pitch_deg=(-30, 30))
DIRECTIONS = within_pitch(direction_lattice(200), PLANNER)
POSITIONS = np.linspace((0.8, 0.8, 1.4), (3.2, 0.8, 1.4), 5)


@pytest.fixture(scope="module")
def scorer():
    return make_scorer("set", LocalizationMap(Map(room_landmarks(300)), CAMERA, occlusion()), weights=WEIGHTS)


@pytest.fixture(scope="module")
def path(scorer):
    """Level views along a given path, the worst at its end, which looks at a corner without landmarks."""
    level = DIRECTIONS[np.abs(DIRECTIONS[:, 2]) < 0.3]
    chosen = best_sequence(-scorer.score_directions(POSITIONS, level), TurnLimit.of(level, 40.0))
    axes = level[chosen.direction_ids]
    return PlannedPath(POSITIONS, axes, scorer.score(poses_looking_along(POSITIONS, axes)), np.nan)


def test_a_place_with_a_low_score_becomes_a_stop(scorer, path):
    asked = float(np.median(path.scores))
    given = (scorer, path.positions, path.axes, DIRECTIONS)
    stops = stops_along(*given, StopConfig(3, asked), PLANNER)
    by_two = {stop.place: stop.together for stop in stops_along(*given, StopConfig(2, asked), PLANNER)}
    assert len(stops) > 0 and {stop.place for stop in stops} <= {*np.flatnonzero(path.scores < asked)}
    for stop in stops:
        assert 1 <= len(stop.axes) <= 2 and stop.together > path.scores[stop.place]
        own = path.axes[stop.place]
        assert (np.abs(stop.axes[:, 2]) <= np.sin(np.radians(30))).all() and (stop.axes @ own < np.cos(0.26)).all()
        tour = np.array([own, *stop.axes, own])
        angles = np.degrees(np.arccos((tour[1:] * tour[:-1]).sum(1).clip(-1, 1)))
        assert stop.turn_deg == pytest.approx(angles.sum())
        if len(stop.axes) == 2:  # one more look does not suffice
            assert by_two.get(stop.place, 0) < asked


def test_where_the_requested_score_is_out_of_reach_a_stop_must_gain_more_than_it_costs(scorer, path):
    config = StopConfig(2, 1.0)  # nothing is certain
    free = replace(PLANNER, turn_weight_m=0.0)
    stops = stops_along(scorer, path.positions, path.axes, DIRECTIONS, config, free)
    assert len(stops) == len(path.positions)
    dear = replace(PLANNER, turn_weight_m=100.0)
    assert stops_along(scorer, path.positions, path.axes, DIRECTIONS, config, dear) == ()
    priced = replace(PLANNER, turn_weight_m=0.02)
    for stop in stops_along(scorer, path.positions, path.axes, DIRECTIONS, config, priced):
        metres = 0.6 if 0 < stop.place < 4 else 0.3
        gain = priced.score_weight * metres * (stop.together - path.scores[stop.place])
        assert gain > priced.turn_weight_m * np.radians(stop.turn_deg)


def test_stops_are_off_by_default_and_need_probabilities(scorer, path):
    rule = make_scorer("visible", scorer.localization_map)
    with pytest.raises(ConfigError):
        stops_along(rule, path.positions, path.axes, DIRECTIONS, StopConfig(2), PLANNER)
    assert stops_along(scorer, path.positions, path.axes, DIRECTIONS, StopConfig(), PLANNER) == ()
    assert stops_along(scorer, path.positions, path.axes, DIRECTIONS, StopConfig(3, 1e-6), PLANNER) == ()


def test_the_looks_of_a_path_are_in_order(scorer, path):
    free = replace(PLANNER, turn_weight_m=0.0)
    stops = stops_along(scorer, path.positions, path.axes, DIRECTIONS, StopConfig(3, 0.999), free)
    some = replace(path, stops=(stops[1], stops[3]))
    views = path_views(some, scorer.localization_map)
    places, looks = views.waypoint, views.rank
    first, second = (len(stops[place].axes) for place in (1, 3))
    assert places.tolist() == [0, 1, *[1] * first, 2, 3, *[3] * second, 4]
    assert looks.tolist() == [1, 1, *range(2, 2 + first), 1, 1, *range(2, 2 + second), 1]
    expected = scorer.score(poses_looking_along(path.positions[places], some.all_axes))
    np.testing.assert_allclose(views.score, expected, atol=0.05)
    assert some.scores_with_stops[3] == stops[3].together
    np.testing.assert_array_equal(views.set_score, some.scores_with_stops[places])
    assert len(views.pixels) == len(views) and all(len(pixels) for pixels in views.pixels)


@pytest.mark.parametrize("options", [(0, 0.7), (7, 0.7), (2, 0.0), (2, float("nan"))])
def test_invalid_options(options):
    with pytest.raises(ConfigError):
        StopConfig(*options)
