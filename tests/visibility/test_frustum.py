"""What is in view: by hand, at the border, and the kernel that collects it against its plain twin."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.geometry.poses import rotation_looking_along, transform
from wheretolook.visibility import frustum
from wheretolook.visibility.counting import FrustumCounter
from wheretolook.visibility.frustum import (
    MIN_DEPTH_M,
    LandmarkSets,
    PosedViews,
    in_view,
    landmarks_in_view,
    landmarks_in_view_plain,
)
from wheretolook.visibility.occlusion import DevicePoints

IDENTITY = np.eye(3)[None]
CAMERA = PinholeCamera(640, 480, 320.0)  # in single precision its sides pass exactly through x = -z, x = z, y = -0.75 z


@pytest.mark.parametrize(
    ("point", "seen"),
    [
        ((0, 0, 1), True),
        ((0, 0, -1), False),  # behind
        ((-1, 0, 1), True),  # on the left border: pixel 0 is in the image
        ((1, 0, 1), False),  # on the right border: pixel 640 is not
        ((0, -0.75, 1), True),  # top
        ((0, 0.75, 1), False),  # bottom
        ((np.nextafter(np.float32(-1), np.float32(-2)), 0, 1), False),
        ((np.nextafter(np.float32(1), np.float32(0)), 0, 1), True),
        ((0, 0, 0), False),  # at the camera centre
        ((0, 0, MIN_DEPTH_M), False),
        ((0, 0, 1.001 * MIN_DEPTH_M), True),
        ((0.5, 0, 0), False),  # zero depth, to the side
        ((np.nan, 0, 1), False),
        ((0, 0, np.nan), False),
        ((0, 0, np.inf), False),
        ((1e300, 0, 1e300), False),
    ],
)
def test_behind_on_the_border_at_zero_depth_not_a_number(point, seen, device):
    points = np.array([point], dtype=np.float64)
    with np.errstate(over="ignore"):
        assert in_view(CAMERA, IDENTITY, points.astype(np.float32)).tolist() == [[seen]]
    everything = LandmarkSets.from_mask(np.ones((1, 1), bool))
    found = landmarks_in_view(PosedViews(CAMERA, np.eye(3, 4)[None], points, everything, np.zeros(1, int)), device)
    assert found.indices.tolist() == ([0] if seen else [])
    counter = FrustumCounter(CAMERA, IDENTITY, 1, device)
    assert counter.count(np.zeros((1, 3)), DevicePoints(points, device).double).numpy().tolist() == [[int(seen)]]


def test_the_test_is_the_projection(random_views):
    """Against `PinholeCamera.project` in double precision, but for landmarks within 1e-3 pixels of the border."""
    v = random_views
    rotations = rotation_looking_along(v.directions)
    for location in v.locations:
        seen = in_view(v.camera, rotations, (v.points - location).astype(np.float32))
        in_camera = (v.points - location) @ np.swapaxes(rotations, 1, 2)
        pixels = v.camera.project(in_camera)
        gap = np.minimum(np.abs(pixels), np.abs(pixels - (v.camera.width, v.camera.height))).min(-1)
        clear = (gap > 1e-3) & (np.abs(in_camera[..., 2] - MIN_DEPTH_M) > 1e-6)
        truth = (in_camera[..., 2] > MIN_DEPTH_M) & v.camera.in_image(pixels)
        assert clear.mean() > 0.999 and truth.any()
        assert_array_equal(seen[clear], truth[clear])


@pytest.mark.parametrize("at_once", [frustum.CANDIDATES_AT_ONCE, 1000, 1])
def test_collected_landmarks_are_those_of_the_plain_twin(random_views, at_once, device, monkeypatch):
    monkeypatch.setattr(frustum, "CANDIDATES_AT_ONCE", at_once)  # the views of a CPU in blocks
    v = random_views
    arguments = PosedViews(v.camera, v.cam_from_world, v.points, v.visible, v.location_rows)
    kernel = landmarks_in_view(arguments, device=device)
    plain = landmarks_in_view_plain(arguments)
    assert_array_equal(kernel.starts, plain.starts)
    assert_array_equal(kernel.indices, plain.indices)
    assert len(plain.indices) > 500 and len(plain) == len(v.cam_from_world)
    for view in range(len(plain)):
        assert v.mask[v.location_rows[view], plain[view]].all()


def test_a_distorted_camera_collects_what_it_projects_into_its_image(random_views):
    v = random_views
    camera = ColmapCamera("OPENCV", 640, 480, (300.0, 300.0, 330.0, 235.0, -0.2, 0.05, 1e-3, -1e-3))
    found = landmarks_in_view(PosedViews(camera, v.cam_from_world, v.points, v.visible, v.location_rows))
    for view, pose in enumerate(v.cam_from_world):
        candidates = v.visible[v.location_rows[view]]
        inside = camera.sees(transform(pose, v.points[candidates]))
        assert set(found[view]) == set(candidates[inside])
    assert len(found.indices) > 500
