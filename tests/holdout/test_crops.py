"""Narrower views of photographs: their pixels are where their cameras project the landmarks."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from wheretolook.geometry.camera import ColmapCamera, PinholeCamera, field_of_view_deg
from wheretolook.geometry.poses import transform
from wheretolook.holdout.photo_map import PANS, crop_pixels, crops_of
from wheretolook.utils.errors import ConfigError

CAMERAS = [PinholeCamera(640, 480, 320.0), ColmapCamera("SIMPLE_RADIAL", 800, 600, (500.0, 390.0, 310.0, -0.05))]


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("crop", range(len(PANS)))
def test_pixels_are_those_of_the_turned_pinhole(rng, camera, crop):
    pose = np.column_stack([Rotation.random(random_state=1).as_matrix(), rng.normal(size=3)])
    rays = camera.colmap.unproject(rng.uniform(0, (camera.width, camera.height), (500, 2)))
    points = (rays * rng.uniform(1, 9, (500, 1)) - pose[:, 3]) @ pose[:, :3]  # in the world
    pinhole, rotations = crops_of(camera, 40.0)
    assert field_of_view_deg(pinhole)[0] == pytest.approx(40, abs=0.2)
    in_crop = transform(rotations[crop] @ pose, points)
    expected = pinhole.project(np.where(in_crop[:, 2:] > 1e-6, in_crop, (0.0, 0.0, 1.0)))
    pixels, shown = crop_pixels(camera, camera.project(transform(pose, points)), 40.0, crop)
    assert_array_equal(shown, (in_crop[:, 2] > 1e-6) & pinhole.in_image(expected))
    assert_allclose(pixels[shown], expected[shown], atol=1e-3)
    assert 20 < shown.sum() < 400


def test_the_outer_crops_end_at_the_sides_of_the_photograph():
    camera = CAMERAS[0]
    pinhole, _ = crops_of(camera, 40.0)
    middle = camera.height / 2
    pixels, _ = crop_pixels(camera, np.array([[0.0, middle], [640.0, middle]]), 40.0, 1)
    other, _ = crop_pixels(camera, np.array([[0.0, middle], [640.0, middle]]), 40.0, 2)
    ends = sorted([pixels[0, 0], pixels[1, 0], other[0, 0], other[1, 0]], key=lambda x: abs(x - pinhole.width / 2))
    assert_allclose(sorted(ends[:2]), [0, pinhole.width], atol=0.6)


def test_wider_views_are_an_error():
    with pytest.raises(ConfigError, match="do not show more"):
        crops_of(CAMERAS[0], 95.0)
