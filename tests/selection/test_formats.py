"""Every file of views holds the poses that were selected, in the frame that it says."""

import csv
import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from selection.room import POINTS
from wheretolook.select.views import SelectedViews
from wheretolook.select.waypoints import read_waypoints
from wheretolook.select.where_to_look import WhereToLook
from wheretolook.utils.errors import ConfigError, StorageError


@pytest.fixture(scope="module")
def views(look: WhereToLook) -> SelectedViews:
    return look.best(POINTS, ids=("3", "1", "20", "7"))


def pose(rotation: Rotation, center: np.ndarray) -> np.ndarray:
    """cam_from_world of a camera-to-world rotation and a camera's centre."""
    turn = rotation.inv().as_matrix()
    return np.column_stack([turn, -turn @ center])


def test_csv(views: SelectedViews, tmp_path: Path) -> None:
    views.save(tmp_path / "views.csv")
    rows = list(csv.DictReader((tmp_path / "views.csv").open()))
    assert [row["waypoint"] for row in rows] == ["3", "1", "20", "7"]
    for row, expected, score, inliers in zip(
        rows, views.cam_from_world, views.score, views.expected_inliers, strict=True
    ):
        center = np.array([float(row[axis]) for axis in "xyz"])
        wxyz = [float(row[f"q{axis}"]) for axis in "wxyz"]
        for rotation in (
            Rotation.from_quat(wxyz, scalar_first=True),
            Rotation.from_quat([float(value) for value in row["quaternion_xyzw"].split()]),
        ):
            np.testing.assert_allclose(pose(rotation, center), expected, atol=1e-7)
            yaw, pitch = np.radians([float(row["yaw_deg"]), float(row["pitch_deg"])])
            axis = [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)]
            np.testing.assert_allclose(rotation.apply([0, 0, 1]), axis, atol=1e-4)
        assert float(row["score"]) == pytest.approx(score, rel=1e-6)
        assert float(row["expected_inliers"]) == pytest.approx(inliers, abs=0.01)
        assert row["rank"] == "1" and row["in_range"] in ("True", "False") and int(row["n_visible"]) > 0
    np.testing.assert_array_equal(read_waypoints(tmp_path / "views.csv").points.round(6), POINTS)


def test_json(views: SelectedViews, tmp_path: Path) -> None:
    views.save(tmp_path / "views.json")
    told = json.loads((tmp_path / "views.json").read_text())
    assert told["camera"] == {"model": "SIMPLE_PINHOLE", "width": 640, "height": 480, "params": [320, 320, 240]}
    assert told["method"] == "set" and "camera-to-world" in told["frames"]
    np.testing.assert_array_equal([view["cam_from_world"] for view in told["views"]], views.cam_from_world)
    assert [view["waypoint"] for view in told["views"]] == ["3", "1", "20", "7"]
    np.testing.assert_array_equal([view["quaternion_xyzw"] for view in told["views"]], views.quaternions_xyzw)


def test_names_with_blanks_commas_and_quotes(look: WhereToLook, tmp_path: Path) -> None:
    names = ("hall, north", 'the "attic"', "a b", "c")
    views = look.best(POINTS, ids=names)
    views.save(tmp_path / "views.csv")
    assert read_waypoints(tmp_path / "views.csv").ids == names
    views.save(tmp_path / "poses.txt", "benchmark")
    rows = [line.split() for line in (tmp_path / "poses.txt").read_text().splitlines()[1:]]
    assert [len(row) for row in rows] == [8] * 4 and rows[2][0] == "a_b"


def test_tum(views: SelectedViews, tmp_path: Path) -> None:
    views.save(tmp_path / "views.tum")
    rows = np.loadtxt(tmp_path / "views.tum")
    np.testing.assert_array_equal(rows[:, 0], [3, 1, 20, 7])  # the waypoints' names are numbers
    for row, expected in zip(rows, views.cam_from_world, strict=True):
        np.testing.assert_allclose(pose(Rotation.from_quat(row[4:]), row[1:4]), expected, atol=1e-7)
    np.testing.assert_allclose(read_waypoints(tmp_path / "views.tum").points, POINTS, atol=1e-8)


def test_benchmark(views: SelectedViews, tmp_path: Path) -> None:
    views.save(tmp_path / "selected_poses.txt", "benchmark")
    lines = (tmp_path / "selected_poses.txt").read_text().splitlines()
    assert lines[0] == "# id qw qx qy qz tx ty tz"
    for line, name, expected in zip(lines[1:], views.waypoint_id, views.cam_from_world, strict=True):
        found, *numbers = line.split()
        values = np.array(numbers, dtype=float)
        turn = Rotation.from_quat(values[:4], scalar_first=True).as_matrix()
        np.testing.assert_allclose(np.column_stack([turn, values[4:]]), expected, atol=1e-7)
        assert found == name


@pytest.mark.parametrize("n", [1, 2])
def test_colmap_reads_the_folder(look: WhereToLook, n: int, tmp_path: Path) -> None:
    views = look.best(POINTS, n)
    views.save(tmp_path / "model")
    views.save(tmp_path / "model")  # again over its own
    model = pycolmap.Reconstruction(tmp_path / "model")
    assert model.num_images() == 4 * n
    for number, expected in enumerate(views.cam_from_world, 1):
        np.testing.assert_allclose(model.images[number].cam_from_world().matrix(), expected, atol=1e-7)
    assert len({image.name for image in model.images.values()}) == 4 * n
    assert (model.cameras[1].width, model.cameras[1].height, list(model.cameras[1].params)) == (
        640,
        480,
        [320, 320, 240],
    )


def test_files_that_cannot_be(views: SelectedViews, look: WhereToLook, sparse: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError):
        views.save(tmp_path / "views.txt")
    with pytest.raises(ConfigError):
        views.save(tmp_path / "views.csv", "xml")
    with pytest.raises(ConfigError):
        views.save(sparse)
    with pytest.raises(ConfigError):
        views.save(tmp_path, "csv")
    several = look.best(POINTS, 2)
    for name in ("tum", "benchmark"):
        with pytest.raises(ConfigError):
            several.save(tmp_path / "views", name)
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError):
        views.save(tmp_path / "file" / "views.csv")
