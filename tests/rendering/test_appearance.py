"""Each operation on images whose result follows from a formula; sRGB 137 and 188 are a quarter and half of white."""

from dataclasses import astuple, replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.rendering.appearance import PERSON_M, READ_NOISE, Appearance

NONE = Appearance.draw(0.0, np.random.default_rng(0))
CAMERA = PinholeCamera()
"""320 px of focal length at 640 x 480: 45 degrees to the left and right side."""


def plain(value, camera=CAMERA):
    return np.full((camera.height, camera.width, 3), value, np.uint8)


def in_light(image):
    values = image / 255
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def test_strength_0_is_the_identity():
    image = np.random.default_rng(1).integers(0, 256, (480, 640, 3)).astype(np.uint8)
    assert len(np.unique(image)) == 256
    assert_array_equal(NONE.apply(image, CAMERA), image)


def test_exposure_multiplies_linear_light_and_saturates():
    gains = (2.0, 1.0, 0.25)
    changed = replace(NONE, gains=gains).apply(plain(137), CAMERA)
    assert (changed == [188, 137, 71]).all()  # a sixteenth of white is sRGB 71
    assert (replace(NONE, gains=(3.0, 3.0, 3.0)).apply(plain(188), CAMERA) == 255).all()


@pytest.mark.parametrize("noise", [0.02, 0.08])
def test_variance_of_noise_is_in_proportion_to_light(noise):
    for value in (99, 188):
        image = plain(value)
        changed = in_light(replace(NONE, noise=noise).apply(image, CAMERA))
        light = in_light(image).mean()
        assert changed.mean() == pytest.approx(light, rel=0.01)
        assert changed.var() == pytest.approx(noise**2 * (light + READ_NOISE**2), rel=0.03)


def test_blur_of_a_point_keeps_its_light_and_has_the_moments_of_a_line_and_a_gaussian():
    """The variance of a line of length L is L^2 / 12."""
    image = plain(0)
    image[240, 320] = 255
    for pitch, yaw, defocus in ((0, 1.5, 0), (2, 0, 0), (0, 0, 0.4), (1, 1, 0.2)):
        blurred = replace(NONE, rotation_deg=(pitch, yaw), defocus_deg=defocus)
        kernel = blurred.blur_kernel(1000.0)
        assert kernel.sum() == pytest.approx(1, abs=1e-5)
        down, right, deviation = 1000 * np.tan(np.radians([pitch, yaw, defocus]))
        at = np.indices(kernel.shape) - len(kernel) // 2
        variance = (at**2 * kernel).sum((1, 2))
        expected = np.square([down, right]) / 12 + deviation**2
        assert_allclose(variance, expected, rtol=0.06, atol=0.1)
        light = in_light(blurred.apply(image, CAMERA))
        assert light[..., 1].sum() == pytest.approx(1, rel=0.03)
        assert light[[0, -1]].sum() == light[:, [0, -1]].sum() == 0


@pytest.mark.parametrize(
    "camera", [CAMERA, ColmapCamera("OPENCV", 640, 480, (320.0, 320.0, 320.0, 240.0, -0.1, 0.02, 0.0, 0.0))]
)
def test_vignetting_falls_off_from_the_principal_point(camera):
    """By cos^4 of the angle from the axis: a quarter at 45 degrees."""
    light = in_light(replace(NONE, vignetting=2.0).apply(plain(255), camera))
    assert light[239:241, 319:321].min() == 1
    assert light[240, 0, 0] == pytest.approx(0.25, abs=0.005) == light[240, -1, 0]
    assert light[0, 320, 0] == pytest.approx(np.cos(np.arctan(240 / 320)) ** 4, abs=0.005)


def test_jpeg_keeps_a_constant_image_constant():
    for value in (0, 100, 255):
        changed = replace(NONE, jpeg_quality=30).apply(plain(value), CAMERA)
        assert len(np.unique(changed)) == 1 and abs(int(changed[0, 0, 0]) - value) <= 2


def test_occluders_have_a_persons_size_and_hide_only_what_is_further():
    """In this camera all of a box between 1 and 4 m can be seen, unless it is at the image's side."""
    camera = PinholeCamera(400, 400, 100.0)
    whole = 0
    for seed in range(20):
        one = replace(NONE, occluders=1, seed=seed)
        hidden = (one.apply(plain(255, camera), camera) != 255).any(-1)
        rows, columns = (np.flatnonzero(hidden.any(axis)) for axis in (1, 0))
        assert hidden.sum() == len(rows) * len(columns)  # a box
        distance = 100 * PERSON_M[0] / len(rows)
        assert 0.98 < distance < 4.1
        assert 1 / distance - 0.01 < (rows[-1] + 1 - 200) / 100 < 1.7 / distance + 0.01  # it stands 1 to 1.7 m below
        if columns[0] > 0 and columns[-1] < 399:
            whole += 1
            assert len(columns) == pytest.approx(100 * PERSON_M[1] / distance, abs=1.5)
        for depth, expected in ((0.95 * distance, 0), (1.05 * distance, hidden.sum())):
            depth_m = np.full((400, 400), depth, np.float32)
            assert (one.apply(plain(255, camera), camera, depth_m) != 255).any(-1).sum() == expected
    assert whole > 10


def test_parameters_grow_with_the_strength():
    half, full = (Appearance.draw(strength, np.random.default_rng(7)) for strength in (0.5, 1.0))
    for one, two in zip(np.hstack(astuple(half)[:6]), np.hstack(astuple(full)[:6]), strict=True):
        assert one == pytest.approx(two / 2) or one == pytest.approx(np.sqrt(two))  # gains are powers
    assert 101 - half.jpeg_quality == pytest.approx((101 - full.jpeg_quality) / 4, abs=1)


def test_a_views_appearance_follows_from_its_pose_and_the_seed():
    poses = np.random.default_rng(2).normal(size=(300, 3, 4))
    views = Appearance.of_views(poses, 0.6, 3)
    assert Appearance.of_views(poses[::-1] + 1e-12, 0.6, 3) == views[::-1]
    assert len({view.seed for view in views} | {view.seed for view in Appearance.of_views(poses, 0.6, 4)}) == 600
    strengths = np.array([view.strength for view in views])
    assert strengths.max() <= 0.6 and strengths.mean() == pytest.approx(0.3, abs=0.03)
    doubled = [view.strength for view in Appearance.of_views(poses, 0.3, 3)]
    assert_allclose(doubled, strengths / 2)
