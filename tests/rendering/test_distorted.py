"""Images of cameras with distortion, against OpenCV's maps of an image that a pinhole took."""

import cv2
import numpy as np
import pytest

from box_scenes import furnished_room
from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.rendering.warp_renderer import WarpRenderer

POSE = poses_looking_along([[0.2, -0.1, 1.2]], [[1.0, 0.3, -0.1]])


@pytest.fixture(scope="module")
def renderer():
    return WarpRenderer(furnished_room())


def test_without_distortion_it_is_the_pinholes_image(renderer):
    pinhole = PinholeCamera(160, 120, 90.0, 95.0, (83.0, 57.0))
    straight = renderer.render(pinhole, POSE)
    looked_up = renderer.render(pinhole.colmap, POSE)
    assert np.median(np.abs(straight.rgb.astype(int) - looked_up.rgb)) <= 3  # looked up, it is a little smoother
    off = np.abs(straight.depth_m - looked_up.depth_m) / np.maximum(straight.depth_m, 0.1)
    assert np.median(off) < 0.005 and np.mean(off < 0.05) > 0.95  # but at edges of what stands in front


def test_distortion_is_opencvs(renderer):
    """A wide image of a pinhole, distorted by OpenCV, is what the camera with distortion sees."""
    k = np.array([[110.0, 0, 80.0], [0, 112.0, 60.0], [0, 0, 1]])
    distortion = np.array([-0.12, 0.02, 0.003, -0.002])
    camera = ColmapCamera("OPENCV", 160, 120, (110.0, 112.0, 80.0, 60.0, *distortion))
    seen = renderer.render(camera, POSE).rgb[0]
    wide = PinholeCamera(1200, 1000, 440.0)
    pixels = np.stack(np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5), -1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels, k, distortion)[:, 0]
    at = (wide.project(np.column_stack([rays, np.ones(len(rays))])) - 0.5).astype(np.float32).reshape(120, 160, 2)
    expected = cv2.remap(renderer.render(wide, POSE).rgb[0], at[..., 0], at[..., 1], cv2.INTER_AREA)
    assert np.mean(np.abs(seen.astype(int) - expected)) < 8
    shifted = np.roll(expected, 3, axis=1)
    assert np.mean(np.abs(seen.astype(int) - shifted)) > 1.5 * np.mean(np.abs(seen.astype(int) - expected))


def test_a_fisheye_sees_half_a_sphere(renderer):
    """What it sees at a pixel is what a pinhole that looks along the pixel's ray sees at its centre."""
    fisheye = ColmapCamera("SIMPLE_FISHEYE", 200, 200, (60.0, 100.0, 100.0))  # 100 / 60 rad = 95 degrees off the axis
    seen = renderer.render(fisheye, POSE)
    for column, row in ((12, 100), (185, 100), (100, 30), (100, 100)):
        ray = fisheye.unproject([column + 0.5, row + 0.5])
        ahead = POSE[0, :, :3].T @ ray
        looking = poses_looking_along([[0.2, -0.1, 1.2]], [ahead])
        small = renderer.render(PinholeCamera(5, 5, 50.0), looking)
        np.testing.assert_allclose(seen.depth_m[0, row, column], small.depth_m[0, 2, 2] * ray[2], rtol=0.05, atol=0.02)
    assert not seen.rgb[0, [0, 100, 100], [0, 2, 197]].any()  # COLMAP projects nothing behind the image plane
