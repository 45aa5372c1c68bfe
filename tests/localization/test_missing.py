"""What a pose should have found and did not, on landmarks of a wall and of two rooms that are copies."""

import numpy as np
import pytest

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import pose_error, poses_looking_along, transform
from wheretolook.localization.confidence import RIGHT_PLACE
from wheretolook.localization.estimation import PoseEstimator
from wheretolook.localization.missing import ExpectedLandmarks, cells_of
from wheretolook.localization.rig import IDENTITY, Look
from wheretolook.localization.rig_localization import JointLocalizer
from wheretolook.mapping.landmarks import MAP_ATTRIBUTES

CAMERA = PinholeCamera(600, 400, 300.0)
POSE = poses_looking_along([[0.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]])[0]


def expected_of(points):
    """Landmarks seen by six images from 3 m, along x."""
    values = dict.fromkeys(MAP_ATTRIBUTES, 0.0) | {"track_length": np.log(6), "mapped_distance": np.log(3)}
    values |= {"mapped_pixel_size": np.log(3 / 300), "direction_spread": 0.05}
    attributes = np.tile([values[name] for name in MAP_ATTRIBUTES], (len(points), 1)).astype(np.float32)
    directions = np.tile([1.0, 0.0, 0.0], (len(points), 1))
    return ExpectedLandmarks.of(points, directions, attributes, MAP_ATTRIBUTES)


def wall(rng, n, low=(-2.8, -1.9), high=(2.8, 1.9)):
    return np.column_stack([np.full(n, 3.0), rng.uniform(low, high, (n, 2))])


def look_at(points, rows, pose=POSE):
    return Look(IDENTITY, CAMERA.project(transform(pose, points[rows])), rows, CAMERA)


def test_cells_are_numbered_down_each_column():
    pixels = np.array([[0.0, 0.0], [99.9, 399.0], [100.0, 0.0], [599.0, 399.0], [250.0, 150.0]])
    assert cells_of(look_at(np.ones((1, 3)), np.zeros(0, int)), pixels).tolist() == [0, 3, 4, 23, 9]


def test_the_share_is_that_of_parts_without_inliers():
    """Inliers are left of the middle: half of what is expected of a wall of equal density is missing."""
    points = wall(np.random.default_rng(0), 4000)
    expected = expected_of(points)
    left = np.flatnonzero(points[:, 1] > 0)
    look = look_at(points, left)
    everywhere = np.ones(len(left), dtype=bool)
    share = expected.missing([look], POSE[None], [everywhere])
    _, p_detect = expected.in_image(look, POSE)
    assert len(p_detect) == len(points) and (p_detect > 0).all() and (p_detect < 1).all()
    assert share == pytest.approx(0.5, abs=0.04)
    assert expected.missing([look], POSE[None], [~everywhere]) == 1
    whole = look_at(points, np.arange(len(points)))
    assert expected.missing([whole], POSE[None], [np.ones(len(points), dtype=bool)]) == 0
    behind = poses_looking_along([[0.0, 0.0, 0.0]], [[-1.0, 0.0, 0.0]])
    assert expected.missing([look], behind, [everywhere]) == 0  # nothing is expected, so nothing is missing


def test_a_pose_in_the_mapped_copy_of_a_room_is_less_sure_where_the_rooms_differ():
    """Only one of two rooms is mapped. They differ in half of a wall, which the camera sees in the other room."""
    rng = np.random.default_rng(1)
    points = wall(rng, 3000)
    points[:, 0] += rng.uniform(0, 0.8, len(points))  # a plane leaves two poses
    localizer = JointLocalizer(PoseEstimator(points), expected=expected_of(points))
    found = {}
    for name, seen in (("here", np.ones(len(points), dtype=bool)), ("other room", points[:, 1] > 0)):
        rows = np.flatnonzero(seen & (rng.random(len(points)) < 0.1))
        result = localizer.localize([look_at(points, rows)])
        assert pose_error(result.rig_from_world, POSE)[0] < 0.01  # in the other room this is wrong
        found[name] = result.probability(RIGHT_PLACE)
    assert 1 - found["other room"] > 2 * (1 - found["here"]) and found["here"] > 0.99


def test_nothing_is_missing_where_nothing_can_be_expected():
    points = wall(np.random.default_rng(2), 300)
    result = JointLocalizer(PoseEstimator(points)).localize([look_at(points, np.arange(300))])
    assert result.missing is None and 0 < result.probability(RIGHT_PLACE) <= 1
    unknown = ExpectedLandmarks(points, np.full((300, 3), np.nan), np.full((300, 4), np.nan), 1.0)
    assert np.isfinite(unknown.in_image(look_at(points, np.arange(300)), POSE)[1]).all()
