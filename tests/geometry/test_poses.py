"""Poses, projection and errors against SciPy, pycolmap and closed forms."""

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from wheretolook.geometry import poses as geo
from wheretolook.utils.errors import PoseError


def random_poses(n, seed=0):
    rng = np.random.default_rng(seed)
    return np.concatenate([Rotation.random(n, rng=rng).as_matrix(), rng.normal(size=(n, 3, 1))], axis=-1)


def test_inverse_and_centres():
    poses = random_poses(20)
    points = np.random.default_rng(1).normal(size=(7, 3))
    there = geo.transform(poses, points)
    back = np.stack([geo.transform(inverse, x) for inverse, x in zip(geo.invert_poses(poses), there, strict=True)])
    assert_allclose(back, np.broadcast_to(points, back.shape), atol=1e-12)
    centers = geo.camera_centers(poses)
    assert_allclose(np.einsum("bij,bj->bi", poses[..., :3], centers) + poses[..., 3], 0, atol=1e-12)


def test_quaternions_agree_with_pycolmap_and_scipy():
    rotation = random_poses(50)[..., :3]
    quaternion = geo.quaternion_from_rotation(rotation)
    for q, r in zip(quaternion, rotation, strict=True):
        assert_allclose(pycolmap.Rotation3d(np.roll(q, -1)).matrix(), r, atol=1e-12)
    assert (quaternion[:, 0] >= 0).all()
    assert_allclose(geo.rotation_from_quaternion(2 * quaternion), rotation, atol=1e-12)


def test_looking_along_keeps_the_horizon_level_and_down_down():
    directions = np.random.default_rng(2).normal(size=(200, 3))
    directions[:2, :2] = 0  # straight up or down
    rotation = geo.rotation_looking_along(directions)
    assert_allclose(rotation @ np.swapaxes(rotation, 1, 2), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-12)
    assert_allclose(np.linalg.det(rotation), 1)
    assert_allclose(rotation[:, 2], directions / np.linalg.norm(directions, axis=1, keepdims=True), atol=1e-12)
    assert_allclose(rotation[:, 0, 2], 0, atol=1e-12)
    assert (rotation[2:, 1, 2] < 0).all()


@pytest.mark.parametrize("angle_deg", [0.0, 1e-6, 0.4, 30.0, 179.999])
def test_rotation_angle_is_exact_even_when_tiny(angle_deg):
    base = Rotation.random(rng=np.random.default_rng(3))
    turned = Rotation.from_rotvec(np.radians(angle_deg) * np.array([0.6, 0, 0.8])) * base
    assert geo.rotation_angle_deg(base.as_matrix(), turned.as_matrix()) == pytest.approx(angle_deg, abs=1e-7, rel=1e-6)


def test_pose_error_is_between_centres_not_translations():
    rotation = Rotation.random(rng=np.random.default_rng(4)).as_matrix()
    center = np.array([10.0, -20, 3])
    true = np.concatenate([rotation, -rotation @ center[:, None]], axis=1)
    turned = Rotation.from_euler("z", 5, degrees=True).as_matrix() @ rotation
    moved = center + np.array([0.03, 0.04, 0])
    estimate = np.concatenate([turned, -turned @ moved[:, None]], axis=1)
    error_m, error_deg = geo.pose_error(estimate, true)
    assert (error_m, error_deg) == (pytest.approx(0.05), pytest.approx(5))


@pytest.mark.parametrize("invalid", [(0, 0, 0), (np.nan, 0, 1), (np.inf, 0, 1), (1e300, 1e300, 0)])
def test_invalid_directions(invalid):
    with pytest.raises(PoseError):
        geo.rotation_looking_along([[(1, 0, 0)], [invalid]])
    with pytest.raises(PoseError):
        geo.poses_looking_along((0, 0, 1), invalid)


def test_rigid_transforms_of_any_shape_and_no_others():
    poses = random_poses(2)
    square = np.concatenate([poses, np.broadcast_to([0.0, 0, 0, 1], (2, 1, 4))], axis=1)
    for given, expected in ((poses, poses), (square, poses), (poses[1], poses[1:]), (square[1], poses[1:])):
        assert_array_equal(geo.rigid_poses(given), expected)
    mirrored = poses * np.array([-1, 1, 1])[:, None]
    sheared = poses + np.eye(3, 4, 1) * 0.1
    for invalid in (
        1.01 * poses,
        mirrored,
        sheared,
        square * 2,
        square[:, [0, 1, 3, 2]],
        poses * np.nan,
        poses[:, :2],
        1,
    ):
        with pytest.raises(PoseError):
            geo.rigid_poses(invalid)


def test_invalid_locations_and_poses():
    with pytest.raises(PoseError):
        geo.poses_looking_along([(0, 0, 1), (0, np.nan, 1)], (1, 0, 0))
    for locations in ([], [(0, 0, 1), (0, 1, 1)], [("a", 0, 1)] * 3, [(1j, 0, 1)] * 3, [(0, 1)] * 3):
        with pytest.raises(PoseError):
            geo.poses_looking_along(locations, [(1, 0, 0)] * 3)
    for given in (np.stack([np.eye(3, 4), np.full((3, 4), 1e300)]), "a", {"a": 1}, [[1, 2], [3]], np.eye(4) + 0j):
        with pytest.raises(PoseError):
            geo.rigid_poses(given)
    same = geo.poses_looking_along([(0, 0, 1), (0, 1, 1)], [(1, 0, 0)] * 2)
    assert_array_equal(geo.poses_looking_along([(0, 0, 1), (0, 1, 1)], (1, 0, 0)), same)
    for poses in (np.stack([np.eye(3, 4), np.full((3, 4), np.nan)]), np.eye(4)):
        with pytest.raises(PoseError):
            geo.check_poses(poses)
    assert geo.poses_looking_along(np.empty((0, 3)), np.empty((0, 3))).shape == (0, 3, 4)
