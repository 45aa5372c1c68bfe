"""Floor plans: which part of a map they show, and how their axes are labelled."""

import numpy as np
import pytest

from wheretolook.figures.floor_plan import floor_plan_figure, plan_extent
from wheretolook.geometry.similarity import Similarity
from wheretolook.mapping.georeference import MapScale
from wheretolook.mapping.map_frame import MapFrame

POSITIONS = np.array([[1.0, 2.0, 1.5], [2.0, 1.0, 1.5]])
AXES = np.array([[1.0, 0, 0], [0, 1, 0]])


def room(n=1000):
    return np.random.default_rng(0).uniform((0, 0, 0), (6, 5, 3), (n, 3))


@pytest.mark.parametrize("share", [0.0, 0.03, 0.2])
def test_far_points_do_not_widen_a_plan(share):
    points = room()
    points[: int(share * len(points)), 0] += 16_000
    low, high = plan_extent(points, POSITIONS)
    np.testing.assert_allclose([low, high], [[0, 0], [6, 5]], atol=12 if share else 0.2)
    assert (plan_extent(room(), POSITIONS + 100)[1] == 102).all()  # positions are always shown


@pytest.mark.parametrize(
    ("frame", "label"),
    [
        (MapFrame(), "y (m)"),
        (MapFrame(Similarity(2.0), MapScale("given", 2.0)), "y (map units)"),
        (MapFrame(scale=MapScale("unknown", 1.0)), "y (map units)"),
    ],
)
def test_plans_name_unit_and_axes(frame, label):
    figure = floor_plan_figure(room(), POSITIONS, AXES, np.array([0.5, 0.7]), ["a", "b"], frame)
    assert figure.axes[0].get_ylabel() == label


def test_a_plan_of_a_turned_map_has_the_maps_axes():
    y_down = MapFrame(Similarity(rotation=np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])))
    plan = floor_plan_figure(room(), POSITIONS, AXES, np.array([0.5, 0.7]), ["a", "b"], y_down).axes[0]
    arrows = {
        text.get_text(): np.subtract(text.get_position(), text.xy) for text in plan.texts if text.get_text() in "xyz"
    }
    assert plan.get_ylabel() == ""
    for name, direction in {"x": (1, 0), "y": (0, 0), "z": (0, 1)}.items():
        np.testing.assert_allclose(arrows[name] / np.linalg.norm(arrows["x"]), direction, atol=1e-9)
