"""Up, from how cameras were held."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from mapping.marker_rooms import rolled
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.mapping.map_frame import estimate_gravity

TURN = Rotation.from_euler("xyz", [40, -65, 110], degrees=True).as_matrix()
"""From the world to the arbitrary frame of a mapping."""


def looking(yaw_deg, pitch_deg, roll_deg):
    yaw = np.radians(yaw_deg)
    pitch = np.radians(pitch_deg)
    axes = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], axis=1)
    poses = poses_looking_along(np.zeros((len(yaw), 3)), axes)
    poses[:, :, :3] = rolled(poses, roll_deg)[:, :, :3] @ TURN.T
    return poses


def off_deg(up):
    return float(np.degrees(np.arccos(np.clip(up @ TURN[:, 2], -1, 1))))


def test_level_cameras_give_up_exactly_whatever_their_pitch():
    yaw = np.linspace(-60, 60, 9)
    gravity = estimate_gravity(looking(yaw, np.full(9, -35.0), np.zeros(9)))
    assert gravity.method == "level"
    assert off_deg(gravity.up) < 1e-4
    assert_allclose(gravity.residual_deg, 0, atol=1e-4)
    assert_allclose(gravity.rotation @ gravity.up, (0, 0, 1), atol=1e-12)


def test_rolled_photographs_do_not_move_it(rng):
    yaw = rng.uniform(0, 360, 20)
    roll = rng.normal(scale=1.0, size=20)
    roll[:5] = 90.0  # held upright, without saying so
    gravity = estimate_gravity(looking(yaw, rng.uniform(-20, 20, 20), roll))
    assert off_deg(gravity.up) < 1.0
    assert np.median(gravity.residual_deg) < 2 and (gravity.residual_deg[:5] > 45).all()


def test_cameras_that_do_not_turn_leave_it_to_their_mean():
    gravity = estimate_gravity(looking(np.full(6, 30.0), np.array([-2.0, -1, 0, 0, 1, 2]), np.zeros(6)))
    assert gravity.method == "mean"
    assert off_deg(gravity.up) < 0.1
    assert gravity.residual_deg.max() == pytest.approx(2, abs=0.1)


def test_up_can_be_given_in_the_camera():
    down = looking(np.linspace(0, 300, 7), np.full(7, -89.9), np.zeros(7))
    gravity = estimate_gravity(down, up_in_camera=(0.0, 0.0, -2.0))
    assert gravity.method == "given"
    assert off_deg(gravity.up) < 0.2
