"""Pictures from above show the cut scene, and world points project to where the picture shows them."""

from __future__ import annotations

import numpy as np
import pytest

from box_scenes import CABINET, ROOM, furnished_room
from wheretolook.figures.dollhouse import dollhouse
from wheretolook.utils.errors import ConfigError, SceneError


def test_a_plan_has_x_to_the_right_and_y_up() -> None:
    plan = dollhouse(furnished_room(), elevation_deg=90, width_px=300)
    low, high = plan.pixels([[0, 0, 0], ROOM])
    assert low[0] < 10 < 290 < high[0] and high[1] < 10 and low[1] > plan.rgb.shape[0] - 10
    assert (high[0] - low[0]) / (low[1] - high[1]) == pytest.approx(ROOM[0] / ROOM[1], rel=0.05)
    # the ceiling turns its back, so that one looks at the floor, and at the cabinet's top
    depth = plan.depth_m[plan.depth_m > 0]
    column, row = plan.pixels([5.0, 1.0, 2.0]).astype(int)
    assert np.median(depth) - plan.depth_m[row, column] == pytest.approx(CABINET[1][2], abs=0.01)


def test_points_are_shown_unless_something_stands_before_them() -> None:
    plan = dollhouse(furnished_room(), elevation_deg=90, width_px=300)
    under_the_cabinet = [5.0, 1.0, 0.05]
    on_the_floor = [2.0, 4.0, 0.0]
    outside = [20.0, 0.0, 0.0]
    assert plan.shows(np.array([under_the_cabinet, on_the_floor, outside])).tolist() == [False, True, False]


def test_near_walls_are_taken_away_and_two_sided_ones_stay() -> None:
    floor = np.array([[3.0, 0.5, 0.0]])  # right behind the wall at y = 0, which is nearest to the eye at -90 degrees
    options = {"azimuth_deg": -90.0, "elevation_deg": 45.0, "width_px": 200}
    assert dollhouse(furnished_room(ceiling=False), **options).shows(floor).all()
    assert not dollhouse(furnished_room(ceiling=False), one_sided=False, **options).shows(floor).any()


def test_what_cannot_be_drawn_is_refused() -> None:
    with pytest.raises(ConfigError):
        dollhouse(furnished_room(), elevation_deg=0)
    with pytest.raises(SceneError, match="nothing"):
        dollhouse(furnished_room(), cut_m=-1.0)
