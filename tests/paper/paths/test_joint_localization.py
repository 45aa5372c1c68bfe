"""Views of compared paths localized jointly: those of a stop, and the last views linked by odometry."""

from functools import partial

import numpy as np
import pandas as pd
import pytest

from paper.matched_views import matched_views
from planning.rooms import CAMERA, room_landmarks
from wheretolook.dataset.viewpoint_table import pose_columns
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.planning.config import StopConfig
from wheretolook_paper.evaluation.looks import label_sets
from wheretolook_paper.figures.paths import paths_figure
from wheretolook_paper.paths.config import PathsConfig
from wheretolook_paper.paths.path_comparison import ComparedPaths
from wheretolook_paper.paths.path_report import path_markdown, summarize_paths
from wheretolook_paper.paths.scene_comparison import (
    OUTCOME,
    chained,
    joint_paths,
    localize_last_views,
    localize_stops,
    noisy_steps,
    rig_of_last,
)

LANDMARKS = room_landmarks(900)
POSITIONS = np.linspace((1.0, 0.9, 1.3), (3.0, 0.9, 1.3), 6)
AXES = np.tile((0.2, 1.0, 0.0), (6, 1)) / np.hypot(0.2, 1)
BLIND = 3  # where the path's view matches nothing right
METHODS = ("forward", "set", "set greedy")  # the last by another rule, which has neither stops nor views together
CONFIG = PathsConfig(methods=("forward", "set"), stops=StopConfig(2, 0.7), last_views=3, resamples=50)


def seen(cam_from_world, blind, seed=0):
    """Return the labels of views (B, 3, 4), which match nothing right where they are blind."""
    labels = matched_views(LANDMARKS.points, CAMERA, cam_from_world, blind, seed)
    return labels.assign(location_id=range(len(labels)))


@pytest.fixture(scope="module")
def compared():
    """The same way by two methods, with a stop at the blind place of one; paths, further looks, and labels of both."""
    pose = poses_looking_along(POSITIONS, AXES)
    labels = pd.concat([seen(pose, np.arange(6) == BLIND, seed) for seed in (0, 1)], ignore_index=True)
    about = {"pair": 0, "task": "planned", "waypoint": np.tile(np.arange(6), 2), "score": 0.5}
    views = pd.DataFrame({**about, "method": np.repeat(["forward", "set"], 6)}).join(labels[OUTCOME])
    views = views.assign(**pose_columns(np.tile(pose, (2, 1, 1))))
    views, labels = (pd.concat([all_of, all_of.iloc[6:]], ignore_index=True) for all_of in (views, labels))
    views.loc[12:, "method"] = "set greedy"
    path = {"pair": 0, "task": "planned", "planned": True, "length_m": 2.0, "turn_deg": 0.0, "n_views": 6}
    paths = pd.DataFrame([{**path, "method": name, "promised": 0.5, "found_by": ""} for name in METHODS])
    aside = poses_looking_along(POSITIONS[[BLIND]], np.array([(0.0, -1.0, 0.0)]))
    stop = {"pair": 0, "task": "planned", "method": "set", "waypoint": BLIND, "look": 2, "score": 0.6}
    further = pd.DataFrame([{**stop, "together": 0.8, "turn_deg": 350.0}]).assign(**pose_columns(aside))
    return ComparedPaths(paths, views), further, labels, seen(aside, np.array([False]))


def test_joint_views_localize_where_a_single_view_does_not(compared):
    single, further, labels, further_labels = compared
    near = (single.views["status"] == "localized") & (single.views["error_m"] < 0.25)
    assert near.tolist() == [number % 6 != BLIND for number in range(18)]
    localize = partial(label_sets, points=LANDMARKS.points, cameras=CAMERA)
    stops = localize_stops(single.views, further, pd.concat([labels, further_labels], ignore_index=True), localize)
    last = localize_last_views(single.views, labels, CONFIG, localize)
    names = ["set with stops", "forward last 3 together", "set last 3 together"]
    paths = [joint_paths(single.paths, stops, further), joint_paths(single.paths, last, further.iloc[:0])]
    assert pd.concat(paths)["method"].tolist() == names
    all_paths = pd.concat([single.paths.assign(n_looks=6), *paths], ignore_index=True).assign(scene="room")
    all_views = pd.concat([single.views, stops, last], ignore_index=True).assign(scene="room")
    table = summarize_paths(all_paths, all_views, CONFIG).set_index("method")
    for name in ("forward", "set"):
        assert table.loc[name, "localized"] == pytest.approx(5 / 6) and table.loc[name, "looks"] == 1
        assert table.loc[f"{name} last 3 together", "localized"] == 1
    stopped = table.loc["set with stops"]
    assert stopped["localized"] == 1 and stopped["looks"] == pytest.approx(7 / 6)
    assert stopped["turn_deg_per_m"] == pytest.approx(175) and stopped["promised"] == pytest.approx((5 * 0.5 + 0.8) / 6)
    stop = stops.set_index("waypoint")
    own = single.views[single.views["method"] == "set"].set_index("waypoint")
    pd.testing.assert_frame_equal(stop[OUTCOME].drop(BLIND), own[OUTCOME].drop(BLIND))
    assert stop.loc[BLIND, "error_m"] < 0.05 and stop.loc[BLIND, "score"] == 0.8
    assert "| set with stops " in path_markdown(table.reset_index(), CONFIG)
    assert paths_figure(table.reset_index()).axes


def test_odometry_without_noise_is_the_way_itself():
    rng = np.random.default_rng(0)
    way = poses_looking_along(rng.uniform(-2, 2, (6, 3)), rng.normal(size=(6, 3)))
    steps = noisy_steps(way, 0.0, 0.0, rng)
    for view, n in ((0, 3), (1, 3), (4, 3), (5, 6)):
        rig = rig_of_last(steps, view, n)
        assert len(rig) == min(n, view + 1)
        for back, cam_from_rig in enumerate(rig):
            np.testing.assert_allclose(chained(cam_from_rig, way[view]), way[view - back], atol=1e-9)
