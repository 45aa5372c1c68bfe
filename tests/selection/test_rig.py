"""`wheretolook select --rig`: all cameras of a rig at poses of the rig."""

from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from selection.room import POINTS, WEIGHTS, write_room
from wheretolook.cli import main
from wheretolook.geometry.pose_files import tum_text
from wheretolook.geometry.poses import compose_poses, poses_looking_along
from wheretolook.looks.selection import SetScoreModel, candidate_views, score_of_set
from wheretolook.mapping.map import Map
from wheretolook.select.rig import read_rig
from wheretolook.select.where_to_look import WhereToLook
from wheretolook.utils.errors import CameraError, ConfigError, TableError

PINHOLE = "PINHOLE,640,480,320,320,320,240"
AXIS = np.array([(1, 0.2, 0)]) / np.hypot(1, 0.2)
POSES = poses_looking_along(POINTS, AXIS)


def turned(degrees, x=0.0):
    """Return cam_from_rig as numbers, of a camera turned to the right."""
    return [*Rotation.from_euler("y", -degrees, degrees=True).as_quat(scalar_first=True).tolist(), x, 0.0, 0.0]


def write_rig(path, angles, camera=PINHOLE):
    """Write a rig of cameras by name, turned to the right by angles."""
    rows = [f"{name}: {{camera: '{camera}', cam_from_rig: {turned(angle)}}}\n" for name, angle in angles.items()]
    path.write_text("".join(rows))
    return path


def test_a_rig_of_one_camera_scores_as_the_camera_and_the_camera_twice_no_more(look, tmp_path):
    expected = look.report(POSES)
    detections = [
        candidate_views(look.scorer, at, AXIS, scores[None]) for at, scores in zip(POINTS, expected.score, strict=True)
    ]
    of_sets = [score_of_set(found, SetScoreModel.bundled(), [0]) for found in detections]
    for names in (["a"], ["a", "b"]):
        views = look.report_rig(write_rig(tmp_path / "rig.yaml", dict.fromkeys(names, 0.0)), POSES)
        assert views.sensor == (*names,) * 4 and views.rank.tolist() == [*range(1, len(names) + 1)] * 4
        for found in (views.score, views.any_score):
            assert_allclose(found.reshape(4, -1), np.tile(expected.score[:, None], len(names)), rtol=1e-6)
        of_rig = expected.score if len(names) == 1 else np.maximum(of_sets, expected.score)
        assert_allclose(views.set_score.reshape(4, -1), np.tile(np.c_[of_rig], len(names)), rtol=1e-5)


def test_cameras_that_see_different_landmarks_fail_independently(look, tmp_path):
    views = look.report_rig(write_rig(tmp_path / "rig.yaml", {"ahead": 0, "right": 90, "behind": 180}), POSES, "wxyz")
    assert views.waypoint_id == tuple("wwwxxxyyyzzz") and (np.diff(views.score.reshape(4, 3)) <= 0).all()
    for row in range(len(views)):
        pose = compose_poses(np.c_[Rotation.from_euler("y", -{"a": 0, "r": 90, "b": 180}[views.sensor[row][0]],
                                                       degrees=True).as_matrix(), np.zeros(3)], POSES[row // 3])  # fmt: skip
        assert_allclose(views.cam_from_world[row], pose, atol=1e-9)
        assert_allclose(views.score[row], look.score(pose)[0], rtol=1e-6)
    p_none = np.prod(1 - views.score.reshape(4, 3), axis=1)
    assert_allclose(views.any_score.reshape(4, 3), np.tile(1 - p_none[:, None], 3), atol=1e-9)
    assert (views.set_score >= views.score).all() and (views.any_score >= views.score).all()
    overlapping = look.report_rig(write_rig(tmp_path / "rig.yaml", {"ahead": 0, "right": 45}), POSES)
    bound = 1 - np.prod(1 - overlapping.score.reshape(4, 2), axis=1)
    best = overlapping.score.reshape(4, 2).max(axis=1)
    assert (
        (overlapping.any_score.reshape(4, 2)[:, 0] > best) & (overlapping.any_score.reshape(4, 2)[:, 0] < bound)
    ).all()


def test_a_rig_of_the_model_on_the_command_line(tmp_path, monkeypatch):
    """As the same rig in a file; columns are documented in docs/rigs.md."""
    monkeypatch.chdir(tmp_path)
    model = pycolmap.Reconstruction(write_room(tmp_path / "sparse"))
    rig = pycolmap.Rig(rig_id=7)
    for number, (angle, x) in enumerate(((0, 0.0), (60, -0.1), (-60, 0.1)), 2):
        model.add_camera(pycolmap.Camera(camera_id=number, model="PINHOLE", width=640, height=480,
                                         params=[320, 320, 320, 240]))  # fmt: skip
        sensor = model.cameras[number].sensor_id
        quaternion = np.roll(turned(angle)[:4], -1)
        if number == 2:
            rig.add_ref_sensor(sensor)
        else:
            rig.add_sensor(sensor, pycolmap.Rigid3d(pycolmap.Rotation3d(quaternion), [x, 0, 0]))
    rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.IMU, 1), pycolmap.Rigid3d())
    model.add_rig(rig)
    unknown = pycolmap.Rig(rig_id=8)
    unknown.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.IMU, 2))
    model.add_camera(pycolmap.Camera(camera_id=5, model="PINHOLE", width=640, height=480, params=[320, 320, 320, 240]))
    unknown.add_sensor(model.cameras[5].sensor_id, None)
    model.add_rig(unknown)
    model.write(str(tmp_path / "sparse"))
    Path("path.tum").write_text(tum_text(["1", "2", "3", "4"], POSES))
    rows = {2: turned(0), 3: turned(60, -0.1), 4: turned(-60, 0.1)}
    Path("rigs").mkdir()
    Path("rigs/cam.json").write_text('{"w": 640, "h": 480, "fl_x": 320}')
    Path("rigs/rig.yaml").write_text(
        "".join(f"{n}: {{camera: cam.json, cam_from_rig: {row}}}\n" for n, row in rows.items())
    )
    command = ["select", "--map", "sparse", "--at", "path.tum", "--weights", str(WEIGHTS), "--device", "cpu"]
    for source, out in (("7", "a.csv"), ("rigs/rig.yaml", "b.csv")):
        assert main([*command, "--rig", source, "--out", out]) == 0
    with pytest.raises(TableError, match="sensor 5 has no pose in the rig"):
        read_rig("8", Map.open("sparse"))
    table, same = (pd.read_csv(path, dtype={"sensor": str}) for path in ("a.csv", "b.csv"))
    pd.testing.assert_frame_equal(table, same)
    assert table["waypoint"].tolist() == [1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4]
    assert {*table["sensor"]} == {"2", "3", "4"} and table["rank"].tolist() == [1, 2, 3] * 4
    assert (table["any_score"] >= table["score"]).all() and table["set_score"].between(0, 1).all()
    assert_array_equal(table.groupby("waypoint")["score"].max(), table[table["rank"] == 1]["score"])
    assert_allclose(table[table["sensor"] == "2"][["x", "y", "z"]], POINTS, atol=1e-6)
    baseline = table[table["sensor"] == "3"][["x", "y", "z"]].to_numpy() - POINTS
    assert_allclose(np.linalg.norm(baseline, axis=1), 0.1, atol=1e-6)


FISHEYE = "OPENCV_FISHEYE,640,480,150,150,320,240,0,0,0,0"


@pytest.mark.parametrize(
    ("content", "error", "message"),
    [
        (f"wide: {{camera: '{FISHEYE}', cam_from_rig: {turned(0)}}}", CameraError, "camera wide of the rig"),
        (f"a: {{camera: '{PINHOLE}'}}", TableError, "cam_from_rig"),
        (f"a: {{cam_from_rig: {turned(0)}}}", TableError, "camera"),
        (f"a: {{camera: '{PINHOLE}', cam_from_rig: [1, 2]}}", TableError, "no rig"),
        ("- a", TableError, "no rig"),
        ("{}", TableError, "no camera"),
        (None, ConfigError, "unknown rig_id"),
    ],
)
def test_rigs_that_cannot_be_scored(look, tmp_path, content, error, message):
    source = "99"
    if content is not None:
        source = tmp_path / "rig.yaml"
        source.write_text(content)
    with pytest.raises(error, match=message):
        look.report_rig(source, POSES)


@pytest.mark.parametrize(
    ("command", "options"),
    [
        (("select", "--at"), ["--n", "2"]),
        (("select", "--at"), ["--fov", "90"]),
        (("score", "--poses"), ["--accuracy", "0.25,2"]),
        (("score", "--poses"), ["--skip"]),
        (("score", "--poses"), ["--format", "tum"]),
        (("select", "--at"), ["--format", "colmap"]),
        (("extend", "--targets"), []),
    ],
)
def test_a_rig_takes_no_limits_of_views_and_no_camera(sparse, tmp_path, command, options, capsys):
    rig = write_rig(tmp_path / "rig.yaml", {"a": 0})
    given = ["path.tum", "--map", str(sparse), "--rig", str(rig), "--out", str(tmp_path / "a.csv")]
    assert main([*command, *given, *options]) == 2
    assert "rig" in capsys.readouterr().err


def test_a_method_that_predicts_no_detections_scores_no_rig(sparse, tmp_path):
    look = WhereToLook.from_colmap(sparse, method="visible", device="cpu")
    with pytest.raises(CameraError, match="visible does not predict"):
        look.report_rig(write_rig(tmp_path / "rig.yaml", {"a": 0}), POSES)


def test_a_rig_is_scored_at_the_accuracy_of_the_weights(look, tmp_path):
    with pytest.raises(ConfigError, match="accuracy"):
        look.at_accuracy((0.25, 2)).report_rig(write_rig(tmp_path / "rig.yaml", {"a": 0}), POSES)
