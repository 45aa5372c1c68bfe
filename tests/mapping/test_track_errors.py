"""Errors of poses that a map's tracks predict, against the noise that they were made with."""

from dataclasses import replace

import numpy as np
import pytest

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import camera_centers, poses_looking_along
from wheretolook.mapping.colmap_model import ModelArrays
from wheretolook.mapping.track_errors import log_error_ratio

CAMERA = PinholeCamera(640, 480, 500.0)


def observed(noise_px: float, n_images: int = 24, n_points: int = 1500, seed: int = 0) -> ModelArrays:
    """Points before a row of cameras, at their true places, observed with normal noise."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-4, 3, -1.5), (4, 6, 1.5), (n_points, 3))
    centers = np.column_stack([np.linspace(-3, 3, n_images), rng.normal(0, 0.2, (n_images, 2))])
    poses = poses_looking_along(centers, np.tile([0.0, 1.0, 0.0], (n_images, 1)))
    in_camera = np.einsum("iab,pb->pia", poses[:, :, :3], points) + poses[:, :, 3]
    pixels = CAMERA.project(in_camera.reshape(-1, 3)).reshape(n_points, n_images, 2)
    seen = CAMERA.in_image(pixels) & (rng.random((n_points, n_images)) < 0.5)
    seen[seen.sum(1) < 2] = False
    point, image = np.nonzero(seen)
    return ModelArrays(
        point_ids=np.arange(n_points),
        points=points,
        errors_px=np.full(n_points, noise_px),
        image_ids=np.arange(n_images),
        image_names=[f"{row}.jpg" for row in range(n_images)],
        image_poses=poses,
        image_centers=camera_centers(poses),
        image_cameras=np.ones(n_images, dtype=np.int64),
        image_focal_px=np.full(n_images, 500.0),
        observation_start=np.concatenate([[0], np.cumsum(seen.sum(1))]),
        observation_image=image,
        observation_keypoint=np.zeros(len(image), dtype=np.int64),
        observation_pixels=(pixels[seen] + rng.normal(0, noise_px, (len(point), 2))).astype(np.float32),
    )


@pytest.mark.parametrize("noise_px", [0.1, 1.0])
def test_independent_noise_has_the_expected_errors(noise_px):
    # the norm of a normal vector over its root mean square has the median 0.89 in three equal axes, less in unequal ones
    assert np.exp(log_error_ratio(observed(noise_px), {1: CAMERA}, noise_px)[0]) == pytest.approx(0.85, abs=0.2)


def test_errors_scale_with_noise_that_is_larger_than_stated():
    exact, _ = log_error_ratio(observed(0.5), {1: CAMERA}, 0.5)
    assert log_error_ratio(observed(0.5), {1: CAMERA}, 0.25)[0] == pytest.approx(exact + np.log(2), abs=0.25)


def test_its_standard_error_is_its_deviation_between_draws_of_the_noise():
    drawn = [log_error_ratio(observed(0.3, seed=seed), {1: CAMERA}, 0.2) for seed in range(6)]
    ratios, errors = np.transpose(drawn)
    assert errors.mean() == pytest.approx(ratios.std(ddof=1), rel=0.5)


def test_errors_that_landmarks_of_an_image_share_are_found():
    """Images whose keypoints are all shifted one way are off by more than independent noise makes them."""
    images = observed(0.3)
    shift = np.random.default_rng(1).normal(0, 1.5, (len(images.image_ids), 2))
    shifted = replace(
        images, observation_pixels=images.observation_pixels + shift[images.observation_image].astype("f4")
    )
    alone, together = (log_error_ratio(one, {1: CAMERA}, 0.3)[0] for one in (images, shifted))
    assert together > alone + 1


def test_it_is_unknown_without_keypoints_or_with_few_images():
    images = observed(0.3)
    assert log_error_ratio(replace(images, observation_pixels=None), {1: CAMERA}, 0.3) is None
    assert log_error_ratio(observed(0.3, n_images=4), {1: CAMERA}, 0.3) is None
    assert log_error_ratio(images, {}, 0.3) is None
    one_center = replace(images, image_centers=np.tile(images.image_centers[:1], (len(images.image_ids), 1)))
    assert log_error_ratio(one_center, {1: CAMERA}, 0.3) is None  # nothing can be triangulated


def test_keypoints_without_a_ray_are_left_out_and_exact_ones_are_bounded():
    images = observed(0.3)
    pixels = images.observation_pixels.copy()
    pixels[::50] = np.nan
    expected, _ = log_error_ratio(images, {1: CAMERA}, 0.3)
    assert log_error_ratio(replace(images, observation_pixels=pixels), {1: CAMERA}, 0.3)[0] == pytest.approx(
        expected, abs=0.2
    )
    assert log_error_ratio(observed(1e-9), {1: CAMERA}, 0.3)[0] == -0.5
