"""What the viewer computes, against the scorers themselves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from selection.room import POINTS, WEIGHTS, write_room
from wheretolook.geometry.poses import camera_centers, poses_looking_along
from wheretolook.select.where_to_look import WhereToLook
from wheretolook.utils.errors import ConfigError, MapError, TableError
from wheretolook.view.opened import Opened, open_map
from wheretolook.view.scores import FLOOR_DIRECTIONS, floor_at, judged_labels, landmarks_seen, look_around, report_of


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Opened:
    return open_map(write_room(tmp_path_factory.mktemp("view") / "sparse"), weights=WEIGHTS)


def test_a_floor_has_the_best_score_of_each_free_place(room: Opened) -> None:
    look = room.look("visible", "none", FLOOR_DIRECTIONS)
    floor = floor_at(room.space, look.localization_map.occlusion, 1.5)
    assert room.space.is_free(floor.points).all() and (floor.points[:, 2] == 1.5).all()
    assert floor.n_first == 12 < len(floor.cells) / 10 and len({*floor.cells.tolist()}) == len(floor.cells)
    while floor.score_next(look, 50):
        pass
    assert floor.done and not floor.score_next(look)
    for k in (0, len(floor.cells) // 2, len(floor.cells) - 1):
        poses = poses_looking_along(np.tile(floor.points[k], (len(look.directions), 1)), look.directions)
        scores = look.scorer.score(poses)
        assert floor.scores[k] == scores.max()
        assert look.scorer.score(poses_looking_along(floor.points[k : k + 1], floor.axes[k : k + 1])) == scores.max()
    raster = floor.raster()
    assert np.isfinite(raster).sum() == len(floor.cells)
    x, y = floor.points[7, :2]
    column = int((x - floor.lower[0]) / floor.cell_m)
    row = int((y - floor.lower[1]) / floor.cell_m)
    assert raster[row, column] == floor.scores[7]


def test_a_floor_has_a_color_everywhere_once_its_coarse_places_are_scored(room: Opened) -> None:
    look = room.look("visible", "none", FLOOR_DIRECTIONS)
    floor = floor_at(room.space, look.localization_map.occlusion, 1.5)
    assert not np.isfinite(floor.raster()).any()
    floor.score_next(look, floor.n_first)
    assert np.isfinite(floor.raster()).sum() == len(floor.cells)
    away = np.linalg.norm(floor.points[:, None] - floor.points[: floor.n_first], axis=2).min(axis=1)
    assert away.max() <= 2 * np.sqrt(len(floor.cells) / 12) * floor.cell_m


def test_the_best_views_of_a_place_are_those_that_select_gives(room: Opened) -> None:
    look = room.look("set", "hidden-points")
    place = look_around(look, POINTS[0], 4)
    chosen = WhereToLook(look.scorer, look.directions).best(POINTS[:1], 4)
    np.testing.assert_array_equal(place.best.cam_from_world, chosen.cam_from_world)
    np.testing.assert_allclose(place.best.score, look.scorer.score(place.best.cam_from_world), atol=1e-6)
    np.testing.assert_allclose(place.scores, look.scorer.score_around(POINTS[:1], look.directions)[0])
    with pytest.raises(TableError, match="outside the map"):
        look_around(look, np.array([80.0, 0.0, 1.0]), 1)


def test_a_view_turned_by_hand_has_the_scorers_score(room: Opened) -> None:
    look = room.look("set", "none")
    axis = np.array([-1.0, -0.5, 0.1])
    pose = poses_looking_along(POINTS[0], axis)
    assert report_of(look.scorer, POINTS[0], axis).score == pytest.approx(look.scorer.score(pose[None]), abs=1e-6)


@pytest.mark.parametrize("method", ["set", "expected-inliers"])
def test_landmarks_seen_have_chances_that_add_up_to_the_expected_inliers(room: Opened, method: str) -> None:
    scorer = room.look(method, "none").scorer
    pose = poses_looking_along(POINTS[0], (-1.0, -0.5, 0.0))
    seen = landmarks_seen(scorer, pose)
    rows = scorer.localization_map.landmarks_in_view(pose[None])[0]
    np.testing.assert_array_equal(np.sort(seen.points, axis=0), np.sort(room.landmarks.points[rows], axis=0))
    assert len(rows) > 20 and ((seen.chances > 0) & (seen.chances < 1)).all()
    assert seen.chances.sum() == pytest.approx(scorer.report(pose[None]).expected_inliers[0], rel=1e-4)
    inside = (seen.pixels >= 0) & (seen.pixels <= (room.camera.width, room.camera.height))
    assert inside.all()


def test_chances_come_from_another_scorer_where_the_method_tells_none(room: Opened) -> None:
    pose = poses_looking_along(POINTS[0], (-1.0, -0.5, 0.0))
    counting = room.look("visible", "none").scorer
    teller = room.look("set", "none").scorer
    assert np.isnan(landmarks_seen(counting, pose).chances).all()
    told = landmarks_seen(counting, pose, teller)
    np.testing.assert_array_equal(told.chances, landmarks_seen(teller, pose).chances)


def test_labels_are_compared_with_the_scorer(room: Opened) -> None:
    import pandas as pd

    from wheretolook.dataset.viewpoint_table import pose_columns

    scorer = room.look("set", "none").scorer
    axes = np.array([(-1.0, -0.5, 0.0), (1.0, 0.2, 0.0), (-1.0, 0.0, 0.0), (0.3, 1.0, 0.0)])
    poses = poses_looking_along(np.tile(POINTS[0], (4, 1)), axes)
    table = pd.DataFrame({**pose_columns(poses), "status": "localized", "error_m": [0.01, 0.2, 0.01, 9.0]})
    table["error_deg"] = 0.1
    scores = scorer.score(poses)
    threshold = float(np.median(scores))
    steps = judged_labels(scorer, table, (0.05, 0.4), threshold)
    with pytest.raises(StopIteration) as ended:
        while True:
            next(steps)
    judged = ended.value.value
    good = np.array([True, False, True, False])
    np.testing.assert_array_equal(judged.good, good)
    np.testing.assert_allclose(judged.scores, scores, atol=1e-6)
    np.testing.assert_array_equal(judged.promised, (judged.scores >= threshold) & ~good)
    np.testing.assert_array_equal(judged.missed, (judged.scores < threshold) & good)
    np.testing.assert_allclose(judged.positions, camera_centers(poses), atol=1e-9)
    np.testing.assert_allclose(judged.axes, poses[:, 2, :3], atol=1e-9)


def test_methods_are_those_that_can_score_here_the_best_first(room: Opened) -> None:
    assert room.methods[0] == "set" and {"visible", "bins", "mlp-2d+z", "forward"} <= {*room.methods}
    assert "random" not in room.methods and room.occlusions == ("hidden-points", "none")
    with pytest.raises(ConfigError, match="unknown method"):
        room.look("nonsense")
    with pytest.raises(ConfigError, match="no such occlusion"):
        room.look("set", "mesh")


def test_a_map_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError):
        open_map(tmp_path)


def test_a_scene_of_a_dataset_has_its_labels_and_no_mesh_if_there_is_none(tmp_path: Path) -> None:
    from synthetic_dataset import CAMERA, make_dataset
    from wheretolook.view.opened import find_opened

    dataset = make_dataset(tmp_path / "set", ("test",), n_locations=4, n_directions=5)
    opened = find_opened(tmp_path, dataset.scenes[0].name, "", None, WEIGHTS, "cpu")
    assert opened.labels is not None and len(opened.labels) == 20 and opened.camera == CAMERA
    assert opened.mesh is None and opened.renderer is None and opened.photographs is None
    floor = floor_at(opened.space, opened.map_of("none").occlusion, 1.5)
    assert len(floor.cells) and floor.ground_m is None
