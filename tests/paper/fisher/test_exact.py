"""Exact information: the kernel against its plain twin and against what is known by hand."""

import numpy as np

from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.geometry.pose_information import bearing_numbers, information_matrices
from wheretolook.geometry.poses import poses_looking_along, transform
from wheretolook.visibility.frustum import LandmarkSets, PosedViews
from wheretolook_paper.fisher.exact import exact_information, exact_information_plain
from wheretolook_paper.fisher.metrics import TRACE


def test_information_is_that_of_the_plain_twin(random_views, device):
    v = random_views
    arguments = PosedViews(v.camera, v.cam_from_world, v.points, v.visible, v.location_rows)
    plain = exact_information_plain(arguments)
    np.testing.assert_allclose(exact_information(arguments, device), plain, rtol=1e-9, atol=1e-12 * np.abs(plain).max())
    assert np.sum(plain @ TRACE > 0) > 30


def test_information_by_hand(device):
    camera = PinholeCamera(100, 100, 50.0)  # sees 45 degrees to every side
    points = np.array([[2, 0, 0], [2, 1.9, 0], [2, 2.1, 0], [-2, 0, 0], [np.nan, 0, 0], [0, 0, 0]])
    poses = poses_looking_along(np.zeros((3, 3)), [[1.0, 0, 0], [-1, 0, 0], [0, 0, 1]])
    sets = LandmarkSets.from_mask(np.array([[True] * 6, [True, False, True, True, True, True]]))
    found = exact_information(PosedViews(camera, poses[[0, 0, 1, 2]], points, sets, np.array([0, 1, 0, 0])), device)
    near, wide = bearing_numbers(points[:2])
    np.testing.assert_allclose(found, [near + wide, near, bearing_numbers(points[3]), np.zeros(15)], atol=1e-12)
    # a shift along the axis changes nothing, one across it half a radian for each metre
    np.testing.assert_allclose(np.diag(information_matrices(found[1])), [0, 0.25, 0.25, 0, 1, 1], atol=1e-12)


def test_a_distorted_camera_sums_up_what_it_sees(random_views):
    v = random_views
    camera = ColmapCamera("OPENCV", 640, 480, (300.0, 300.0, 330.0, 235.0, -0.2, 0.05, 1e-3, -1e-3))
    found = exact_information(PosedViews(camera, v.cam_from_world, v.points, v.visible, v.location_rows))
    for view, pose in enumerate(v.cam_from_world):
        candidates = v.visible[v.location_rows[view]]
        seen = v.points[candidates[camera.sees(transform(pose, v.points[candidates]))]]
        expected = bearing_numbers(seen - v.locations[v.location_rows[view]]).sum(0)
        np.testing.assert_allclose(found[view], expected, rtol=1e-5, atol=1e-5)  # offsets are rounded to float32
    assert (found @ TRACE > 0).sum() > 30
