"""Views of a scene from outside: projection, visibility of points, errors."""

import numpy as np
import pytest

from box_scenes import CABINET, ROOM, furnished_room
from wheretolook_paper.figures.dollhouse import dollhouse


def test_a_plan_has_x_to_the_right_and_y_up_and_knows_what_is_visible():
    plan = dollhouse(furnished_room(), elevation_deg=90, width_px=300)
    low, high = plan.pixels([[0, 0, 0], ROOM])
    assert low[0] < 10 < 290 < high[0] and high[1] < 10 and low[1] > plan.rgb.shape[0] - 10
    depth = plan.depth_m[plan.depth_m > 0]  # most of it is floor, since the ceiling faces away
    column, row = plan.pixels([5.0, 1.0, 2.0]).astype(int)
    assert np.median(depth) - plan.depth_m[row, column] == pytest.approx(CABINET[1][2], abs=0.01)
    under_cabinet_on_floor_outside = np.array([[5.0, 1.0, 0.05], [2.0, 4.0, 0.0], [20.0, 0.0, 0.0]])
    assert plan.shows(under_cabinet_on_floor_outside).tolist() == [False, True, False]


def test_near_walls_are_removed_unless_two_sided():
    floor = np.array([[3.0, 0.5, 0.0]])  # behind the wall at y = 0, the nearest to the eye
    options = {"elevation_deg": 45.0, "width_px": 200}
    assert dollhouse(furnished_room(ceiling=False), **options).shows(floor).all()
    assert not dollhouse(furnished_room(ceiling=False), one_sided=False, **options).shows(floor).any()
