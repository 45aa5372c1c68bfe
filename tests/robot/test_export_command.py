"""`wheretolook export` from a COLMAP model to a folder that scores views."""

import numpy as np
import pycolmap
import pytest

from box_scenes import furnished_room
from selection.room import write_room
from wheretolook.cli import main
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.geometry.similarity import Similarity
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.colmap_model import write_model
from wheretolook.robot.wheretolook_robot import RobotScorer
from wheretolook.scenes.loading import save_glb
from wheretolook.scorers.weights import load_scorer
from wheretolook.select.where_to_look import WhereToLook
from wheretolook.utils.errors import MapWarning
from wheretolook.utils.package import shipped

WEIGHTS = shipped("data/release/weights/set.safetensors")


@pytest.fixture
def model(tmp_path):
    return write_room(tmp_path / "sparse")


def export(model, out, *options):
    return main(["export", "--map", str(model), "--out", str(out), "--weights", str(WEIGHTS), *options])


def test_a_mesh_and_the_camera_of_the_robot(model, tmp_path):
    mesh = tmp_path / "room.glb"
    save_glb(furnished_room(), mesh)
    camera = "PINHOLE,640,480,400,410,320,240"
    assert export(model, tmp_path / "robot", "--mesh", str(mesh), "--spacing", "1", "--camera", camera) == 0
    robot = RobotScorer(tmp_path / "robot")
    assert robot.camera["fy"] == 410 and len(robot.places) > 20
    distance = np.linalg.norm(robot.places[:, None] - robot.places, axis=2)
    assert np.isclose(distance[distance > 0].min(), 1) and (robot.places > 0).all()
    exact = LocalizationMap.from_colmap(model, mesh=mesh)
    views = poses_looking_along(robot.places, np.tile((-1.0, 0, -0.2), (len(robot.places), 1)))
    expected = load_scorer(exact.of_camera(PinholeCamera(640, 480, 400.0, 410.0)), WEIGHTS).score(views)
    np.testing.assert_allclose(robot.score(views), expected, atol=1e-5, rtol=0)


def test_the_accuracy_of_scores(model, tmp_path):
    scores = []
    for options in ((), ("--accuracy", "0.05,0.4"), ("--accuracy", "0.5,5")):
        assert export(model, tmp_path / "robot", *options) == 0
        robot = RobotScorer(tmp_path / "robot")
        scores.append(robot.score_directions([(2.5, 2.5, 1.5)], fibonacci_sphere(50))[0])
    assert robot.camera == {"width": 640, "height": 480, "fx": 320.0, "fy": 320.0, "cx": 320.0, "cy": 240.0}
    np.testing.assert_array_equal(scores[0], scores[1])
    assert (scores[2] >= scores[0]).all() and scores[2].mean() > scores[0].mean() + 0.01


@pytest.mark.parametrize(
    "options",
    [
        ("--map", "nowhere"), ("--camera", "PINHOLE 640"), ("--camera-id", "7"), ("--weights", "none.safetensors"),
        ("--mesh", "none.glb"), ("--camera", "OPENCV_FISHEYE,320,240,160,160,160,120,0,0,0,0"), ("--spacing", "-1"),
        ("--accuracy", "0,1"), ("--accuracy", "0.25"),
    ],
)  # fmt: skip
def test_invalid_options(options, model, tmp_path):
    assert export(model, tmp_path / "robot", *options) == 2
    assert not (tmp_path / "robot").exists()


def test_the_robot_gives_positions_in_the_frame_of_the_map(model, tmp_path):
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # to y down
    to_map = Similarity(20.0, turn, np.zeros(3))
    other = pycolmap.Reconstruction(model)
    to_map.transform_model(other)
    write_model(other, tmp_path / "other")
    with pytest.warns(MapWarning):  # the cameras are not level
        assert export(tmp_path / "other", tmp_path / "robot", "--scale", "0.05") == 0
    with pytest.warns(MapWarning):
        look = WhereToLook.from_colmap(
            tmp_path / "other", weights=WEIGHTS, occlusion="none", directions=100, device="cpu", scale=0.05
        )
    expected = look.best(to_map.apply((2.5, 2.5, 1.5)))
    view = RobotScorer(tmp_path / "robot").best(to_map.apply((2.5, 2.5, 1.5)), directions=100)
    np.testing.assert_allclose(view.cam_from_world, expected.cam_from_world[0], atol=1e-6)
    np.testing.assert_allclose(view.score, expected.score[0], atol=1e-4)
