"""Methods compared by paths between the same places."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from box_scenes import furnished_room
from planning.rooms import build, patiently, room_landmarks
from wheretolook.dataset.viewpoint_table import poses
from wheretolook.geometry.poses import camera_centers
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
    bins = shares_below(build(room_landmarks(200), directions=np.asarray(_lattice())))

    def compare(seconds):
        config = replace(QUICK, planner=replace(QUICK.planner, time_s=seconds))
        found = plan_pairs(draw_pairs(space, config), space, {"bins": bins}, config)
        if not found.paths["planned"].all():
            raise PlanningError("a path was not found in time")
        return found

    return patiently(compare)


def _lattice():
    from wheretolook.geometry.lattices import direction_lattice

    return direction_lattice(200)


def test_pairs_are_far_apart_and_free(space):
    pairs = draw_pairs(space, replace(QUICK, pairs=3))
    assert pairs.shape == (3, 2, 3) and space.is_free(pairs.reshape(-1, 3)).all()
    assert (np.linalg.norm(pairs[:, 1] - pairs[:, 0], axis=1) >= 1.5).all()
    heights = pairs.reshape(-1, 3)[:, 2] - space.floor_below(pairs.reshape(-1, 3))
    assert ((heights > 0.999) & (heights < 1.401)).all()
    np.testing.assert_array_equal(draw_pairs(space, replace(QUICK, pairs=3)), pairs)
    with pytest.raises(SceneError):
        draw_pairs(space, replace(QUICK, min_distance_m=50.0))


def test_ways_lead_round_walls_but_not_through_them():
    class Rooms:
        """Two rooms, and a door between them or not."""

        bounds = np.array([[0.0, 0.0, 0.0], [4.0, 2.0, 1.0]])

        def __init__(self, door):
            self.door = door

        def is_free(self, points):
            x, y, z = np.atleast_2d(points).T
            wall = (np.abs(x - 2) < 0.2) & ~(self.door & (y > 1))
            return (x > 0) & (x < 4) & (y > 0) & (y < 2) & (z > 0) & (z < 1) & ~wall

        def segments_are_free(self, a, b):
            a = np.atleast_2d(a)
            b = np.atleast_2d(b)
            t = np.linspace(0, 1, 50)[:, None, None]
            points = a * (1 - t) + b * t
            return self.is_free(points.reshape(-1, 3)).reshape(points.shape[:2]).all(0)

    left = (0.5, 0.5, 0.5)
    right = (3.5, 0.5, 0.5)
    assert Reachability(Rooms(True)).connects(left, right)
    closed = Reachability(Rooms(False))
    assert closed.connects(left, (1.5, 1.5, 0.5)) and not closed.connects(left, right)
    assert not closed.connects(left, (2.0, 0.5, 0.5))  # in the wall


def test_every_method_goes_the_same_way(compared, space):
    paths = compared.paths
    assert paths["planned"].all()
    assert {*zip(paths["task"], paths["method"], strict=True)} == {
        ("planned", "forward"), ("planned", "bins"), ("given", "forward"), ("given", "bins"), ("given", "bins greedy"),
    }  # fmt: skip
    for (pair, task, method), rows in compared.views.groupby(["pair", "task", "method"]):
        row = paths[(paths["pair"] == pair) & (paths["task"] == task) & (paths["method"] == method)].iloc[0]
        cam_from_world = poses(rows)
        centers = camera_centers(cam_from_world)
        assert len(rows) == row["n_views"] and space.is_free(centers).all()
        np.testing.assert_allclose(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum(), row["length_m"], rtol=1e-6)
        if task == "given" and method != "forward":
            rotations = cam_from_world[:, :, :3]
            cosines = (np.einsum("nij,nij->n", rotations[1:], rotations[:-1]) - 1) / 2
            assert np.degrees(np.arccos(cosines.clip(-1, 1))).max(initial=0) <= 30.001
    given = paths[paths["task"] == "given"].set_index(["pair", "method"])
    for pair in (0, 1):
        assert given.loc[(pair, "bins"), "promised"] >= given.loc[(pair, "bins greedy"), "promised"] - 1e-9
        assert given.loc[(pair, "bins"), "length_m"] == given.loc[(pair, "forward"), "length_m"]


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
    assert table.loc["forward", "localized"] == pytest.approx(3 / 10)
    assert table.loc["set", "localized"] == pytest.approx(5 / 10)
    of_both = paths[paths["planned"]].groupby("pair")["method"].nunique() == 2
    good = views[views["error_m"] < 0.25].groupby(["method", "pair"]).size().unstack(fill_value=0)
    size = views.groupby(["method", "pair"]).size().unstack(fill_value=0)
    shares = good.loc[:, of_both].sum(axis=1) / size.loc[:, of_both].sum(axis=1)  # pairs that both planned
    assert table.loc["set", "times_forward"] == pytest.approx(shares["set"] / shares["forward"])
    assert table.loc["set", "times_forward_length"] == pytest.approx(6 / 5)  # over the pairs that both planned
    assert table.loc["set", "failures"] == 1 and table.loc["set", "turn_deg_per_m"] == pytest.approx(10)
    assert table.loc["forward", "times_forward_low"] == table.loc["forward", "times_forward_high"] == 1
    assert table.loc["set", "localized_low"] < 0.5 < table.loc["set", "localized_high"] <= 0.8
    strict = summarize_paths(paths, views, replace(QUICK, max_error_deg=0.5)).set_index("method")
    assert strict.loc["set", "localized"] == 0
