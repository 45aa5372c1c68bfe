"""Cameras by their options, their files and their errors; pinholes of any focal lengths against OpenCV."""

import cv2
import numpy as np
import pytest

from wheretolook.geometry.camera import (
    CameraConfig,
    ColmapCamera,
    PinholeCamera,
    camera_of_record,
    cameras_by_id,
    describe_camera,
    draw_camera,
    field_of_view_deg,
    only_camera,
    read_cameras,
    turn_camera,
    write_cameras,
)
from wheretolook.mapping.colmap_model import read_model
from wheretolook.utils.errors import ConfigError, MapError

FISHEYE = ColmapCamera("OPENCV_FISHEYE", 640, 480, (220.0, 221.0, 318.0, 242.0, 0.01, -0.002, 0.0, 0.0))
OFF_CENTER = PinholeCamera(1280, 720, 900.0, 910.0, (620.0, 371.0))
CAMERAS = (PinholeCamera(), OFF_CENTER, FISHEYE)


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_pinhole_is_colmaps(camera):
    points = np.random.default_rng(0).uniform((-1, -1, 1), (1, 1, 3), (50, 3))
    pixels = camera.project(points)
    np.testing.assert_allclose(pixels, camera.colmap.project(points), rtol=0, atol=1e-9)
    np.testing.assert_allclose(camera.unproject(pixels), points / np.linalg.norm(points, axis=1)[:, None], atol=1e-6)


@pytest.mark.parametrize("camera", CAMERAS)
def test_records_options_and_files_give_the_camera_back(camera, tmp_path):
    assert camera_of_record(camera.record()) == camera
    assert CameraConfig.of(camera).camera == camera
    write_cameras({3: camera, 7: PinholeCamera(64, 48, 50.5)}, tmp_path / "cameras.txt")
    assert read_cameras(tmp_path / "cameras.txt") == {3: camera, 7: PinholeCamera(64, 48, 50.5)}


def test_the_papers_camera_is_the_default():
    assert CameraConfig().camera == PinholeCamera(640, 480, 320.0)
    assert PinholeCamera(640, 480, 320.0, 320.0, (320.0, 240.0)) == PinholeCamera()  # one way to say it
    assert field_of_view_deg(PinholeCamera()) == pytest.approx((90.0, 73.7), abs=0.05)  # the paper's angles
    assert CameraConfig(1280, 720, fov_deg=60).camera == PinholeCamera(1280, 720, 640 / np.tan(np.pi / 6))
    assert describe_camera(PinholeCamera()) == "640 x 480 px, 90.0 x 73.7 degrees"


@pytest.mark.parametrize(
    "options",
    [
        {"width": 0},
        {"fov_deg": 180.0},
        {"fov_deg": 0.0},
        {"focal_px": 0.0035},
        {"focal_px": -320.0},
        {"focal_px": float("nan")},
        {"focal_px": 320.0, "fov_deg": 90.0},
        {"params": (320.0,)},
        {"model": "PLENOPTIC", "params": (1.0,)},
        {"model": "OPENCV", "params": (300.0, 300.0)},
        {"model": "PINHOLE", "params": (0.003, 0.003, 320.0, 240.0)},
        {"model": "SIMPLE_PINHOLE", "params": (320.0, float("inf"), 240.0)},
    ],
)
def test_invalid_cameras(options):
    with pytest.raises(ConfigError):
        _ = CameraConfig(**options).camera


@pytest.mark.parametrize(("any_lens", "narrowest_deg", "largest_px"), [(False, 40, 1280), (True, 25, 2000)])
def test_drawn_cameras_span_sizes_and_angles(any_lens, narrowest_deg, largest_px, rng):
    drawn = [draw_camera(rng, any_lens) for _ in range(400)]
    longer = np.array([max(camera.width, camera.height) for camera in drawn])
    angle = 2 * np.degrees(np.arctan(longer / 2 / [camera.fx for camera in drawn]))
    assert 320 <= longer.min() < 340 and 0.93 * largest_px < longer.max() <= largest_px
    assert narrowest_deg - 0.1 < angle.min() < narrowest_deg + 3 and 117 < angle.max() < 120.1
    assert any(camera.height > camera.width for camera in drawn)


# Cameras of COLMAP's models against pycolmap and OpenCV.


def test_opencv_model_projects_as_opencv():
    params = (300.0, 310.0, 330.0, 235.0, -0.2, 0.05, 1e-3, -1e-3)
    camera = ColmapCamera("OPENCV", 640, 480, params)
    points = np.random.default_rng(0).uniform((-1, -0.7, 1), (1, 0.7, 2), (200, 3))
    matrix = np.array([[params[0], 0, params[2]], [0, params[1], params[3]], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(params[4:]))
    seen = camera.sees(points)
    assert seen.mean() > 0.9
    np.testing.assert_allclose(camera.project(points)[seen], expected[seen, 0], atol=1e-9)


def test_distortion_that_turns_back_does_not_bring_the_side_into_view():
    """With k1 = -0.25 the image of a ray 61 degrees off the axis falls left of the image's edge again."""
    import pycolmap

    params = [320.0, 320.0, 240.0, -0.25, 0.0]
    ray = np.array([[np.tan(np.radians(61)), 0, 1]])
    raw = pycolmap.Camera(model="RADIAL", width=640, height=480, params=params).img_from_cam(ray)
    camera = ColmapCamera("RADIAL", 640, 480, tuple(params))
    assert 0 < raw[0, 0] < 640 and not camera.sees(ray)[0]
    assert camera.sees(np.array([[np.tan(np.radians(45)), 0, 1]]))[0]


def test_a_panorama_sees_everything_and_a_fisheye_what_is_in_its_image():
    directions = np.random.default_rng(0).normal(size=(1000, 3))
    assert ColmapCamera("EQUIRECTANGULAR", 640, 320, (640.0, 320.0)).sees(directions).all()
    fisheye = ColmapCamera("SIMPLE_FISHEYE", 400, 400, (200 / np.radians(70), 200.0, 200.0))
    off_axis = np.degrees(np.arccos(directions[:, 2] / np.linalg.norm(directions, axis=1)))
    along_x = np.array([[np.sin(np.radians(a)), 0, np.cos(np.radians(a))] for a in (0, 69.9, 70.1)])
    assert fisheye.sees(along_x).tolist() == [True, True, False]
    assert not fisheye.sees(directions[off_axis > 100]).any()


def test_not_a_number_and_the_centre_are_not_seen():
    camera = ColmapCamera("OPENCV", 640, 480, (300.0, 300.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0))
    assert camera.sees(np.array([[0, 0, 0], [np.nan, 0, 1], [0, 0, np.inf], [0, 0, -1], [0, 0, 1.0]])).tolist() == [
        False, False, False, False, True,
    ]  # fmt: skip


def test_the_camera_of_a_map(tmp_path):
    import pycolmap

    model = pycolmap.Reconstruction()
    model.add_camera(
        pycolmap.Camera(model="RADIAL", width=640, height=480, params=[500, 320, 240, 0.1, 0.01], camera_id=1)
    )
    model.write(tmp_path)
    camera = ColmapCamera("RADIAL", 640, 480, (500.0, 320.0, 240.0, 0.1, 0.01))
    assert only_camera(cameras_by_id(read_model(tmp_path).cameras, tmp_path), tmp_path) == camera
    model.add_camera(pycolmap.Camera(model="SIMPLE_PINHOLE", width=64, height=48, params=[50, 32, 24], camera_id=2))
    model.write(tmp_path)
    assert cameras_by_id(read_model(tmp_path).cameras, tmp_path) == {1: camera, 2: PinholeCamera(64, 48, 50.0)}
    with pytest.raises(MapError):
        only_camera(cameras_by_id(read_model(tmp_path).cameras, tmp_path), tmp_path)
    with pytest.raises(MapError):
        read_model(tmp_path / "nowhere")


TANGENTIAL = (220.0, 225.0, 310.0, 245.0, 0.02, -0.01, 0.003, -0.004)


@pytest.mark.parametrize(
    "camera",
    [
        OFF_CENTER,
        FISHEYE,
        ColmapCamera("SIMPLE_RADIAL", 640, 480, (500.0, 310.0, 245.0, -0.05)),
        ColmapCamera("OPENCV", 640, 480, TANGENTIAL),
        ColmapCamera("FULL_OPENCV", 640, 480, (*TANGENTIAL, 0.001, 0.01, 0.0, 0.0)),
        ColmapCamera("THIN_PRISM_FISHEYE", 640, 480, (*TANGENTIAL, 0.001, 0.0, 0.002, -0.003)),
    ],
)
def test_a_camera_turned_with_its_image_sees_a_turned_scene(camera):
    points = np.random.default_rng(0).uniform((-0.4, -0.3, 1), (0.4, 0.3, 2), (20, 3))
    x, y = camera.colmap.project(points).T
    turned = turn_camera(camera, 1)  # to the left: the right side is at the top
    assert (turned.width, turned.height) == (camera.height, camera.width)
    seen = turned.colmap.project(points @ [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(seen, np.column_stack([y, camera.width - x]), rtol=0, atol=1e-6)
    assert turn_camera(turned, 3) == camera
