"""Distinct pixels against the plain version and by hand."""

import numpy as np
import pytest
import warp as wp

from twins.visibility import count_pixels_plain
from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.geometry.poses import rotation_looking_along
from wheretolook.utils.errors import ConfigError
from wheretolook.visibility.counting import SurveyOptions, survey
from wheretolook.visibility.occlusion import DevicePoints, NoOcclusion
from wheretolook_paper.visibility.pixel_counter import PixelCounter


@pytest.mark.parametrize("scratch", [1, 200_000, 1 << 28])
def test_pixels_are_those_of_the_plain_version(scratch, random_views, device):
    v = random_views
    points = np.concatenate([v.points, v.points[:200]])
    mask = np.random.default_rng(0).random((len(v.locations), len(points))) < 0.7
    rotations = rotation_looking_along(v.directions)
    on_device = DevicePoints(points, device)
    free = wp.array(mask[:, on_device.order], dtype=wp.bool, device=device)
    counter = PixelCounter(v.camera, rotations, len(points), device, scratch_bytes=scratch)
    counts = counter.count(v.locations, on_device.double, free).numpy()
    np.testing.assert_array_equal(counts, count_pixels_plain(v.camera, rotations, v.locations, points, mask))


def test_distinct_pixels_by_hand(device):
    # pixels (3, 1), (3, 1) from twice as far, (2, 1), (0, 0), out of view
    points = np.array([[0.6, 0.1, 1], [1.2, 0.2, 2], [0.1, 0.1, 1], [-0.9, -0.4, 1], [2, 0, 1.0]])
    arguments = (
        np.eye(3)[None],
        np.zeros((1, 3)),
        points,
        NoOcclusion(),
        SurveyOptions(counter=PixelCounter, device=device),
    )
    assert survey(PinholeCamera(4, 2, 2.0), *arguments).counts.tolist() == [[3]]
    with pytest.raises(ConfigError):
        survey(ColmapCamera("SIMPLE_PINHOLE", 4, 2, (2.0, 2.0, 1.0)), *arguments)
