"""Methods compared by paths between the same places."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from box_scenes import furnished_room
from planning.rooms import build, patiently, room_landmarks
from wheretolook.dataset.viewpoint_table import poses
from wheretolook.geometry.lattices import direction_lattice
from wheretolook.geometry.poses import camera_centers, rotation_angle_deg
from wheretolook.planning.config import PathConfig
from wheretolook.planning.scene_map import shares_below
from wheretolook.space.free_space import FreeSpace
from wheretolook.utils.errors import PlanningError, SceneError
from wheretolook_paper.paths.config import PathsConfig
from wheretolook_paper.paths.path_comparison import Reachability, draw_pairs, plan_pairs
from wheretolook_paper.paths.path_report import summarize_paths

QUICK = PathsConfig(
    pairs=2, min_distance_m=1.5, height_m=(1.0, 1.4), methods=("forward", "bins"), max_turn_deg=30.0, resamples=200,
    planner=PathConfig(time_s=0.6, pitch_deg=(-30, 30)),
)  # fmt: skip


@pytest.fixture(scope="module")
def space():
    return FreeSpace(furnished_room())


@pytest.fixture(scope="module")
def compared(space):
    bins = shares_below(build(room_landmarks(200), directions=direction_lattice(200)))

    def compare(seconds):
        config = replace(QUICK, planner=replace(QUICK.planner, time_s=seconds))
        found = plan_pairs(draw_pairs(space, config), space, {"bins": bins}, config)
        if not found.paths["planned"].all():
            raise PlanningError("a path was not found in time")
        return found

    return patiently(compare)


def test_pairs_are_far_apart_and_free(space):
    pairs = draw_pairs(space, replace(QUICK, pairs=3))
    assert pairs.shape == (3, 2, 3) and space.is_free(pairs.reshape(-1, 3)).all()
    assert (np.linalg.norm(pairs[:, 1] - pairs[:, 0], axis=1) >= 1.5).all()
    heights = pairs.reshape(-1, 3)[:, 2] - space.floor_below(pairs.reshape(-1, 3))
    assert ((heights > 0.999) & (heights < 1.401)).all()
    np.testing.assert_array_equal(draw_pairs(space, replace(QUICK, pairs=3)), pairs)
    with pytest.raises(SceneError):
        draw_pairs(space, replace(QUICK, min_distance_m=50.0))


class Rooms:
    """Two rooms, and a door between them or not."""

    bounds = np.array([[0.0, 0.0, 0.0], [4.0, 2.0, 1.0]])

    def __init__(self, door):
        self.door = door

    def is_free(self, points):
        points = np.asarray(points)
        wall = (np.abs(points[..., 0] - 2) < 0.2) & ~(self.door & (points[..., 1] > 1))
        return ((points > self.bounds[0]) & (points < self.bounds[1])).all(-1) & ~wall

    def segments_are_free(self, a, b):
        return self.is_free(np.linspace(np.atleast_2d(a), np.atleast_2d(b), 50)).all(0)


def test_ways_lead_round_walls_but_not_through_them():
    left, right = (0.5, 0.5, 0.5), (3.5, 0.5, 0.5)
    assert Reachability(Rooms(True)).connects(left, right)
    closed = Reachability(Rooms(False))
    assert closed.connects(left, (1.5, 1.5, 0.5)) and not closed.connects(left, right)
    assert not closed.connects(left, (2.0, 0.5, 0.5))  # in the wall


def test_every_method_goes_the_same_way(compared, space):
    paths = compared.paths.set_index(["pair", "task", "method"])
    assert paths["planned"].all() and {key[1:] for key in paths.index} == {
        ("planned", "forward"), ("planned", "bins"), ("given", "forward"), ("given", "bins"), ("given", "bins greedy"),
    }  # fmt: skip
    for key, rows in compared.views.groupby(["pair", "task", "method"]):
        cam_from_world = poses(rows)
        centers = camera_centers(cam_from_world)
        assert len(rows) == paths.loc[key, "n_views"] and space.is_free(centers).all()
        length_m = np.linalg.norm(np.diff(centers, axis=0), axis=1).sum()
        assert length_m == pytest.approx(paths.loc[key, "length_m"], rel=1e-6)
        if key[1] == "given" and key[2] != "forward":
            rotations = cam_from_world[:, :, :3]
            assert rotation_angle_deg(rotations[1:], rotations[:-1]).max(initial=0) <= 30.001
    for pair in (0, 1):
        forward, bins, greedy = (paths.loc[(pair, "given", name)] for name in ("forward", "bins", "bins greedy"))
        assert bins["promised"] >= greedy["promised"] - 1e-9 and bins["length_m"] == forward["length_m"]


def _labelled():
    """Two pairs: forward localizes 1 of 4 and 2 of 4 views, ours 4 of 5 and 1 of 5; on the third ours found no way."""
    paths = []
    views = []
    for pair, method, good, n, length in (
        (0, "forward", 1, 4, 2.0), (1, "forward", 2, 4, 3.0), (2, "forward", 0, 2, 5.0),
        (0, "set", 4, 5, 3.0), (1, "set", 1, 5, 3.0), (2, "set", 0, 0, np.nan),
    ):  # fmt: skip
        about = {"scene": "a", "pair": pair, "task": "planned", "method": method}
        paths.append({**about, "planned": n > 0, "length_m": length, "turn_deg": 10 * length, "n_views": n,
                      "promised": 0.5})  # fmt: skip
        for number in range(n):
            error = 0.1 if number < good else 0.3
            views.append({**about, "status": "localized", "error_m": error, "error_deg": 1.0})
    return pd.DataFrame(paths), pd.DataFrame(views)


def test_shares_by_hand():
    paths, views = _labelled()
    table = summarize_paths(paths, views, QUICK).set_index("method")
    assert table["localized"][["forward", "set"]].tolist() == pytest.approx([3 / 10, 5 / 10])
    ours = table.loc["set"]
    assert ours["times_forward"] == pytest.approx((5 / 10) / (3 / 8))  # over the pairs that both planned
    assert ours["times_forward_length"] == pytest.approx(6 / 5)
    assert ours["failures"] == 1 and ours["turn_deg_per_m"] == pytest.approx(10)
    assert table.loc["forward", "times_forward_low"] == table.loc["forward", "times_forward_high"] == 1
    assert ours["localized_low"] < 0.5 < ours["localized_high"] <= 0.8
    strict = summarize_paths(paths, views, replace(QUICK, max_error_deg=0.5)).set_index("method")
    assert strict.loc["set", "localized"] == 0
