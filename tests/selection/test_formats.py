"""Every file of views holds the poses that were selected, in the frame that it says."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from selection.room import POINTS, write_room
from wheretolook.cli import main
from wheretolook.geometry.similarity import Similarity
from wheretolook.geometry.views import check_format
from wheretolook.mapping.georeference import MapScale
from wheretolook.select.waypoints import read_waypoints
from wheretolook.utils.errors import ConfigError, StorageError

IDS = ("3", "1", "20", "7")


@pytest.fixture(scope="module")
def views(look):
    return look.best(POINTS, ids=IDS)


def poses_of(rotations, centers):
    """cam_from_world (B, 3, 4) of camera-to-world rotations and the centres of cameras (B, 3)."""
    turns = rotations.inv().as_matrix()
    return np.concatenate([turns, -turns @ centers[..., None]], axis=2)


def test_csv(look, tmp_path):
    names = ("hall, north", 'the "attic"', "a b", "c")
    views = look.best(POINTS, ids=names)
    views.save(tmp_path / "views.csv")
    table = pd.read_csv(tmp_path / "views.csv")
    centers = table[["x", "y", "z"]].to_numpy()
    rotations = Rotation.from_quat(table[["qw", "qx", "qy", "qz"]], scalar_first=True)
    np.testing.assert_allclose(poses_of(rotations, centers), views.cam_from_world, atol=1e-7)
    same = [[float(value) for value in text.split()] for text in table["quaternion_xyzw"]]
    np.testing.assert_allclose(same, rotations.as_quat(), atol=1e-7)
    yaw, pitch = np.radians(table[["yaw_deg", "pitch_deg"]].to_numpy().T)
    axes = np.column_stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    np.testing.assert_allclose(rotations.apply([0, 0, 1]), axes, atol=1e-4)
    np.testing.assert_allclose(table["score"], views.score, rtol=1e-6)
    np.testing.assert_allclose(table["expected_inliers"], views.expected_inliers, atol=0.01)
    assert (table["rank"] == 1).all() and table["in_range"].dtype == bool and (table["n_visible"] > 0).all()
    again = read_waypoints(tmp_path / "views.csv")
    np.testing.assert_array_equal(again.points.round(6), POINTS)
    assert again.ids == names
    views.save(tmp_path / "poses.txt", "benchmark")  # fields are separated by blanks
    assert np.loadtxt(tmp_path / "poses.txt", dtype=str)[2][0] == "a_b"


def test_json(views, tmp_path):
    views.save(tmp_path / "views.json")
    content = json.loads((tmp_path / "views.json").read_text())
    assert content["camera"] == {"model": "SIMPLE_PINHOLE", "width": 640, "height": 480, "params": [320, 320, 240]}
    assert content["method"] == "set" and "camera-to-world" in content["frames"]
    np.testing.assert_array_equal([view["cam_from_world"] for view in content["views"]], views.cam_from_world)
    assert [view["waypoint"] for view in content["views"]] == list(IDS)
    np.testing.assert_array_equal([view["quaternion_xyzw"] for view in content["views"]], views.quaternions_xyzw)


def test_tum(views, tmp_path):
    views.save(tmp_path / "views.tum")
    rows = np.loadtxt(tmp_path / "views.tum")
    np.testing.assert_array_equal(rows[:, 0], [3, 1, 20, 7])  # the waypoints' names are numbers
    np.testing.assert_allclose(poses_of(Rotation.from_quat(rows[:, 4:]), rows[:, 1:4]), views.cam_from_world, atol=1e-7)
    np.testing.assert_allclose(read_waypoints(tmp_path / "views.tum").points, POINTS, atol=1e-8)


def test_benchmark(views, tmp_path):
    views.save(tmp_path / "selected_poses.txt", "benchmark")
    header, *lines = (tmp_path / "selected_poses.txt").read_text().splitlines()
    assert header == "# id qw qx qy qz tx ty tz" and tuple(line.split()[0] for line in lines) == IDS
    values = np.loadtxt(tmp_path / "selected_poses.txt")[:, 1:]
    turns = Rotation.from_quat(values[:, :4], scalar_first=True).as_matrix()
    np.testing.assert_allclose(np.concatenate([turns, values[:, 4:, None]], 2), views.cam_from_world, atol=1e-7)


@pytest.mark.parametrize("n", [1, 2])
def test_colmap_reads_the_folder(look, n, tmp_path):
    views = look.best(POINTS, n)
    views.save(tmp_path / "model")
    views.save(tmp_path / "model")  # again over its own
    model = pycolmap.Reconstruction(tmp_path / "model")
    assert model.num_images() == 4 * n
    for number, expected in enumerate(views.cam_from_world, 1):
        np.testing.assert_allclose(model.images[number].cam_from_world().matrix(), expected, atol=1e-7)
    assert len({image.name for image in model.images.values()}) == 4 * n
    assert list(model.cameras[1].params) == [320, 320, 240]


def test_invalid_targets_are_rejected(views, look, sparse, tmp_path):
    (tmp_path / "file").write_text("")
    twice = look.best(POINTS, 2)
    for chosen, target, error in (
        (views, (tmp_path / "views.txt",), ConfigError),
        (views, (tmp_path / "views.csv", "xml"), ConfigError),
        (views, (sparse,), ConfigError),
        (views, (tmp_path, "csv"), ConfigError),
        (twice, (tmp_path / "views", "tum"), ConfigError),
        (twice, (tmp_path / "views", "benchmark"), ConfigError),
        (views, (tmp_path / "file" / "views.csv",), StorageError),
    ):
        with pytest.raises(error):
            chosen.save(*target)


def test_a_rosbag_holds_the_optical_frames_in_the_world(views, tmp_path, capsys, monkeypatch):
    pytest.importorskip("rosbags", reason="pip install '.[rosbag]'")
    from rosbags.highlevel import AnyReader

    turned = Similarity(2.0, Rotation.from_euler("z", 90, degrees=True).as_matrix(), np.array([1.0, 2.0, 3.0]))
    moved = replace(views, frame=replace(views.frame, world_from_map=turned))
    moved.save(tmp_path / "bag", "rosbag")
    with AnyReader([tmp_path / "bag"]) as reader:
        ((connection, _, data),) = reader.messages()
        path = reader.deserialize(data, connection.msgtype)
    assert (connection.topic, connection.msgtype) == ("/views", "nav_msgs/msg/Path")
    assert {pose.header.frame_id for pose in (path, *path.poses)} == {"map"}
    at = [(pose.pose.position.x, pose.pose.position.y, pose.pose.position.z) for pose in path.poses]
    x, y, z = POINTS.T
    np.testing.assert_allclose(at, np.column_stack([1 - 2 * y, 2 + 2 * x, 3 + 2 * z]), atol=1e-9)
    quaternions = [[getattr(pose.pose.orientation, axis) for axis in "xyzw"] for pose in path.poses]
    axes = Rotation.from_quat(quaternions).apply([0, 0, 1])
    np.testing.assert_allclose(axes, views.axes @ turned.rotation.T, atol=1e-9)
    with pytest.raises(ConfigError):  # it is a folder that exists
        moved.save(tmp_path / "bag", "rosbag")
    unknown = replace(views, frame=replace(views.frame, scale=MapScale("unknown")))
    with pytest.raises(ConfigError, match="metres"):
        unknown.save(tmp_path / "other", "rosbag")
    model = write_room(tmp_path / "unknown", metric=False)
    outside = ["--at", "1000,0,0", "--device", "cpu"]  # an error of the views would be another one
    assert main(["select", "--map", str(model), *outside, "--format", "rosbag", "--out", str(tmp_path / "new")]) == 2
    assert "metres" in capsys.readouterr().err
    monkeypatch.setattr("wheretolook.utils.package.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="rosbags"):
        check_format(tmp_path / "new", "rosbag", 1)
