"""Cameras in files of ROS, OpenCV and nerfstudio, compared with the camera and with OpenCV's rays."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from selection.room import write_room
from wheretolook.cli import main
from wheretolook.geometry.camera import camera_of
from wheretolook.geometry.camera_files import read_camera
from wheretolook.mapping.map import Map
from wheretolook.select.query_images import QueryImages
from wheretolook.utils.errors import ConfigError

SIZE = 640, 480
K = np.array([[500.0, 0, 318.5], [0, 505.0, 241.25], [0, 0, 1]])
PINHOLE = (500.0, 505.0, 319.0, 241.75)  # COLMAP's pixels begin half a pixel earlier
CASES = {
    "plumb_bob": ([-0.2, 0.05, 0.001, -0.0005, 0.0], "OPENCV", [-0.2, 0.05, 0.001, -0.0005]),
    "plumb_bob, k3": ([-0.2, 0.05, 0.001, -0.0005, 0.01], "FULL_OPENCV", [-0.2, 0.05, 0.001, -0.0005, 0.01, 0, 0, 0]),
    "plumb_bob, none": ([0.0] * 5, "PINHOLE", []),
    "plumb_bob, empty": ([], "PINHOLE", []),
    "rational_polynomial": ([0.1, 0.02, 1e-3, 2e-3, 1e-3, 0.3, 0.01, 1e-5], "FULL_OPENCV",
                            [0.1, 0.02, 1e-3, 2e-3, 1e-3, 0.3, 0.01, 1e-5]),
    "equidistant": ([-0.02, 0.003, -0.001, 0.0002], "OPENCV_FISHEYE", [-0.02, 0.003, -0.001, 0.0002]),
}  # fmt: skip


def opencv(path, name, distortion):
    """Write a calibration by OpenCV, and change its first line to what OpenCV up to 4 writes."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", SIZE[0])
    storage.write("image_height", SIZE[1])
    storage.write("fisheye_model", int(name == "equidistant"))
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", np.array(distortion))
    storage.release()
    _, _, rest = path.read_text().partition("---\n")
    path.write_text("%YAML:1.0\n---\n" + rest)


def calibration(path, name, distortion):
    """Write what ROS's camera_calibration does."""
    model = name.partition(",")[0]
    path.write_text(
        f"image_width: 640\nimage_height: 480\ncamera_name: left\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        f"  data: {K.ravel().tolist()}\ndistortion_model: {model}\ndistortion_coefficients:\n  rows: 1\n"
        f"  cols: {len(distortion)}\n  data: {distortion}\nprojection_matrix:\n  rows: 3\n  cols: 4\n  data: {[1.0] * 12}\n"
    )


def echo(path, name, distortion, k=K, names="dk", more="", binning=0):
    """Write what `ros2 topic echo` prints of two messages; K and D as ROS 1 does if `names` are upper case."""
    model = name.partition(",")[0]
    d, k_name = names
    lists = ""
    for key, values in ((d, distortion), (k_name, np.ravel(k).tolist()), ("p", [0.0] * 12)):
        lists += f"{key}:\n" + "".join(f"- {value!r}\n" for value in values) if values else f"{key}: []\n"
    head = "header:\n  stamp:\n    sec: 1\n    nanosec: 2\n  frame_id: camera\n"
    message = f"{head}height: 480\nwidth: 640\ndistortion_model: {model}\n{lists}binning_x: 0\nbinning_y: {binning}\n"
    roi = "roi:\n  x_offset: 0\n  y_offset: 0\n  height: 0\n  width: 0\n  do_rectify: false\n"
    path.write_text(f"{message}{more or roi}---\n{message}{roi}---\n")


def ros1(path, name, distortion):
    echo(path, name, distortion, names="DK")


WRITTEN = [(write, name) for name in CASES for write in (opencv, calibration, echo, ros1)]


# OpenCV writes no empty matrix
@pytest.mark.parametrize(("write", "name"), [(write, n) for write, n in WRITTEN if CASES[n][0] or write is not opencv])
def test_rays_are_those_of_the_camera_and_of_opencv(write, name, tmp_path):
    distortion, model, params = CASES[name]
    write(tmp_path / "camera.yaml", name, distortion)
    camera = read_camera(str(tmp_path / "camera.yaml"))
    expected = camera_of(model, *SIZE, (*PINHOLE, *params))
    assert type(camera) is type(expected) and camera.colmap.model == expected.colmap.model
    pixels = np.random.default_rng(0).uniform((60, 60), (580, 420), (200, 2))
    rays = camera.unproject(pixels)
    np.testing.assert_allclose(rays, expected.unproject(pixels), atol=1e-6)
    undistort = cv2.fisheye.undistortPoints if name == "equidistant" else cv2.undistortPoints
    criteria = {"criteria": (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)}
    at = undistort((pixels - 0.5)[:, None], K, np.array(distortion or [0.0] * 4), **criteria)[:, 0]
    np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], at, atol=1e-6)


@pytest.mark.parametrize(
    "given, model, params",
    [
        ({"fl_x": 500, "fl_y": 505, "cx": 319, "cy": 241.75}, "PINHOLE", PINHOLE),
        ({"fl_x": 500, "k1": -0.2, "p2": 1e-3}, "OPENCV", (500, 500, 320, 240, -0.2, 0, 0, 1e-3)),
        ({"fl_x": 500, "k1": 0.1, "k3": 0.01}, "FULL_OPENCV", (500, 500, 320, 240, 0.1, 0, 0, 0, 0.01, 0, 0, 0)),
        ({"fl_x": 300, "camera_model": "OPENCV_FISHEYE", "k1": 0.01, "k4": 1e-4}, "OPENCV_FISHEYE",
         (300, 300, 320, 240, 0.01, 0, 0, 1e-4)),
        ({"fl_x": 300, "is_fisheye": True, "k1": 0.01}, "OPENCV_FISHEYE", (300, 300, 320, 240, 0.01, 0, 0, 0)),
        ({"fl_x": 500, "w": 640.0, "h": 480.0, "is_fisheye": False}, "PINHOLE", (500, 500, 320, 240)),
    ],
)  # fmt: skip
def test_transforms_of_nerfstudio(given, model, params, tmp_path):
    (tmp_path / "transforms.json").write_text("\n " + json.dumps({"w": 640, "h": 480, "frames": [], **given}))
    assert read_camera(str(tmp_path / "transforms.json")) == camera_of(model, *SIZE, params)


@pytest.mark.parametrize(
    "more", ["", "roi:\n", "distortion_coefficients:\nroi: {height: 480, width: 640}\nbinning_x: 1\n"]
)
def test_without_distortion_and_region_the_camera_is_a_pinhole(more, tmp_path):
    matrix = f"camera_matrix: {{data: {K.ravel().tolist()}}}"
    (tmp_path / "camera.yaml").write_text(f"image_width: 640\nimage_height: 480\n{matrix}\n{more}")
    assert read_camera(str(tmp_path / "camera.yaml")) == camera_of("PINHOLE", *SIZE, PINHOLE)


def broken(path, **given):
    """Write a camera_info that is wrong in a way."""
    echo(path, given.pop("model", "plumb_bob"), given.pop("distortion", [0.0] * 5), **given)


@pytest.mark.parametrize(
    "write, problem",
    [
        (lambda path: broken(path, k=np.zeros((3, 3))), "not calibrated"),
        (lambda path: broken(path, model="magic"), "distortion model"),
        (lambda path: broken(path, distortion=[0.1] * 14), "COLMAP has no model"),
        (lambda path: broken(path, more="roi:\n  width: 320\n"), "region of interest"),
        (lambda path: broken(path, more="roi:\n  height: 320\n  width: 640\n"), "region of interest"),
        (lambda path: broken(path, more="roi:\n---\n", binning=2), "binning"),
        (lambda path: broken(path, k=np.ones((2, 2))), "9 numbers, not 4"),
        (lambda path: path.write_text("width: 640\nheight: 480\n"), "'camera_matrix' is missing"),
        (lambda path: path.write_text("width: 640\n"), "'image_height' is missing"),
        (lambda path: path.write_text("a list of things"), "describes no camera"),
        (lambda path: path.write_text(""), "no names with values"),
        (lambda path: path.write_bytes(b"\xff\xfe"), "describes no camera"),
        (lambda path: path.write_text('{"w": 640, "h": 480, "frames": [{"fl_x": 9}]}'), "above frames"),
        (lambda path: path.write_text('{"w": 640, "h": 480, "fl_x": 500, "k4": 1}'), "COLMAP has no model"),
        (
            lambda path: path.write_text('{"w": 640, "h": 480, "fl_x": 500, "camera_model": "EQUIRECTANGULAR"}'),
            "distortion model",
        ),
        (lambda path: path.write_text('{"w": 640, "h": 480, "fl_x": 0.004}'), "pixels"),
    ],
)
def test_what_is_no_camera_is_named_with_the_file(write, problem, tmp_path):
    write(tmp_path / "camera.yaml")
    with pytest.raises(ConfigError, match=problem) as raised:
        read_camera(str(tmp_path / "camera.yaml"))
    assert raised.value.path == tmp_path / "camera.yaml"


@pytest.mark.parametrize(("text", "problem"), [("missing.YAML", "no such file"), ("PINHOLE,640,480" * 99, "no camera")])
def test_texts_that_are_neither_a_camera_nor_a_file(text, problem):
    with pytest.raises(ConfigError, match=problem):
        read_camera(text)


def test_commands_and_python_take_the_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sparse = write_room(tmp_path / "sparse")
    echo(tmp_path / "camera_info.yaml", "plumb_bob", [0.0] * 5)
    given = ["--map", "sparse", "--camera", "camera_info.yaml", "--device", "cpu", "--directions", "20"]
    assert main(["select", *given, "--at", "2,2,1.5", "--out", "views.json"]) == 0
    assert json.loads((tmp_path / "views.json").read_text())["camera"]["params"] == list(PINHOLE)
    images = QueryImages(Map.open(sparse))
    expected = read_camera("camera_info.yaml")
    (tmp_path / "list.yaml").write_text(f"# of images\na.jpg PINHOLE 640 480 {' '.join(map(str, PINHOLE))}\n")
    (tmp_path / "camera_info.yaml").rename("camera")
    assert images.known_camera("camera") == images.known_camera(Path("camera")) == expected
    assert images.known_camera("list.yaml") == {"a.jpg": expected}
