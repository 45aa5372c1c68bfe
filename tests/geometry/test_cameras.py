"""Cameras by their options, their files and their errors; pinholes of any focal lengths against OpenCV."""

import numpy as np
import pytest

from wheretolook.geometry.camera import (
    CameraConfig,
    ColmapCamera,
    PinholeCamera,
    camera_of_record,
    describe_camera,
    draw_camera,
    field_of_view_deg,
    read_cameras,
    write_cameras,
)
from wheretolook.utils.errors import ConfigError

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


def test_drawn_cameras_span_common_sizes_and_angles():
    rng = np.random.default_rng(0)
    drawn = [draw_camera(rng) for _ in range(400)]
    longer = np.array([max(camera.width, camera.height) for camera in drawn])
    angle = 2 * np.degrees(np.arctan(longer / 2 / [camera.fx for camera in drawn]))
    assert 320 <= longer.min() < 340 and 1200 < longer.max() <= 1280
    assert 40 - 0.1 < angle.min() < 43 and 117 < angle.max() < 120.1
    assert any(camera.height > camera.width for camera in drawn)
