"""What the viewer computes, against the scorers themselves."""

import numpy as np
import pytest

from selection.room import POINTS, WEIGHTS, write_room
from synthetic_dataset import CAMERA, make_dataset
from wheretolook.geometry.poses import poses_looking_along, transform
from wheretolook.mapping.config import FrameOptions
from wheretolook.select.where_to_look import WhereToLook
from wheretolook.utils.errors import TableError
from wheretolook.view import drawing
from wheretolook.view.viewed_map import FIRST_CELLS, open_map, open_scene, score_location


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return open_map(write_room(tmp_path_factory.mktemp("view") / "sparse"), weights=WEIGHTS)


def test_a_floor_has_the_best_score_of_each_free_cell(room):
    floor = room.floor("visible", "none", 1.5)
    selector = floor.selector
    assert room.space.is_free(floor.points).all() and len({*floor.cells.tolist()}) == len(floor.cells)
    assert not np.isfinite(floor.raster()).any()
    floor.score_next(FIRST_CELLS)  # spread over the floor, so that all of it has a colour
    assert np.isfinite(floor.raster()).sum() == len(floor.cells)
    while floor.score_next(50):
        pass
    for k in (0, len(floor.cells) // 2):
        poses = poses_looking_along(np.tile(floor.points[k], (len(selector.directions), 1)), selector.directions)
        scores = selector.scorer.score(poses)
        assert floor.scores[k] == scores.max()
        assert selector.scorer.score(poses_looking_along(floor.points[k], floor.axes[k])[None]) == scores.max()
    column, row = ((floor.points[7, :2] - floor.lower) / floor.cell_m).astype(int)
    assert floor.raster()[row, column] == floor.scores[7]


def test_the_best_views_of_a_location_are_those_of_select(room):
    selector = room.selector("set", "hidden-points")
    location = score_location(selector, POINTS[0], 4)
    chosen = WhereToLook(selector.scorer, selector.directions).best(POINTS[:1], 4)
    np.testing.assert_array_equal(location.best.cam_from_world, chosen.cam_from_world)
    np.testing.assert_allclose(location.scores, selector.scorer.score_directions(POINTS[:1], selector.directions)[0])
    with pytest.raises(TableError):
        score_location(selector, np.array([80.0, 0.0, 1.0]), 1)


def test_locations_are_in_the_world_whatever_the_unit_of_the_map(tmp_path):
    folder = write_room(tmp_path / "sparse", metric=False)
    halved = open_map(folder, weights=WEIGHTS, frame=FrameOptions(scale=0.5, up="z"))
    selector = halved.selector("set", "none")
    best = score_location(selector, 0.5 * POINTS[0], 4).best
    np.testing.assert_allclose(best.positions, np.tile(0.5 * POINTS[0], (4, 1)), atol=1e-9)
    np.testing.assert_allclose(best.score, selector.scorer.score(best.cam_from_world), atol=1e-6)


def test_probabilities_of_visible_landmarks_sum_to_the_expected_inliers(room):
    scorer = room.selector("set", "none").scorer
    pose = poses_looking_along(POINTS[0], (-1.0, -0.5, 0.0))
    landmarks = room.visible_landmarks("set", "none", pose)
    assert len(landmarks.points) == len(scorer.localization_map.landmarks_in_view(pose[None])[0]) > 20
    expected = scorer.report(pose[None]).expected_inliers[0]
    assert landmarks.probabilities.sum() == pytest.approx(expected, rel=1e-4)
    counted = room.visible_landmarks("visible", "none", pose)  # by the best weights, here of "set"
    np.testing.assert_array_equal(counted.probabilities, landmarks.probabilities)


def test_a_scene_of_a_dataset_has_its_labels(tmp_path):
    dataset = make_dataset(tmp_path / "set", ("test",), n_locations=4, n_directions=5)
    viewed = open_scene(tmp_path, dataset.scenes[0].name, "", None, WEIGHTS, "cpu")
    assert viewed.labels is not None and len(viewed.labels) == 20 and viewed.camera == CAMERA
    assert viewed.mesh is None
    assert len(viewed.floor("visible", "none", 1.5).cells)


def test_colours_of_scores():
    image = drawing.floor_image(np.array([[0.0, np.nan], [1.0, 0.4]]), 0, 1, 0.5)
    cell = drawing.CELL_PX
    assert image.shape == (2 * cell, 2 * cell, 4) and image[0, cell, 3] == 0 and image[0, 0, 3] > 200
    np.testing.assert_array_equal(image[cell, 0, :3], drawing.score_colors(np.array(1.0)))


def test_frustum_corners_project_to_image_corners():
    poses = poses_looking_along([[1.0, 2.0, 3.0]] * 2, [[1.0, 0, 0], [0.3, -1, 0.2]])
    corners = drawing.frustum_corners(CAMERA, poses, 0.5)
    np.testing.assert_allclose(corners[:, 0], [[1, 2, 3]] * 2)
    for pose, four in zip(poses, corners[:, 1:], strict=True):
        in_camera = transform(pose, four)
        np.testing.assert_allclose(in_camera[:, 2], 0.5)
        np.testing.assert_allclose(CAMERA.project(in_camera), [[0, 0], [160, 0], [160, 120], [0, 120]], atol=1e-9)
