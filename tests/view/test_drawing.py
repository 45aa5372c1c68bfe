"""Frusta of cameras as the viewer and figures draw them."""

from __future__ import annotations

import numpy as np

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import poses_looking_along, transform
from wheretolook.view.drawing import frustum_corners, frustum_segments


def test_frustum_corners_project_to_image_corners() -> None:
    camera = PinholeCamera(64, 48, 32.0)
    poses = poses_looking_along([[1.0, 2.0, 3.0]] * 2, [[1.0, 0, 0], [0.3, -1, 0.2]])
    corners = frustum_corners(camera, poses, 0.5)
    np.testing.assert_allclose(corners[:, 0], [[1, 2, 3]] * 2)
    for pose, four in zip(poses, corners[:, 1:], strict=True):
        in_camera = transform(pose, four)
        np.testing.assert_allclose(in_camera[:, 2], 0.5)
        np.testing.assert_allclose(camera.project(in_camera), [[0, 0], [64, 0], [64, 48], [0, 48]], atol=1e-9)
    assert frustum_segments(camera, poses, 0.5).shape == (2, 8, 2, 3)
