"""Free space by landmarks and cameras."""

import numpy as np
import pytest

from wheretolook.space.config import MappedSpaceConfig
from wheretolook.space.free_space import MappedSpace
from wheretolook.utils.errors import ConfigError, MapError

WALL = np.stack(np.meshgrid([3.0], np.linspace(-2, 2, 41), np.linspace(0, 2, 21), indexing="ij"), -1).reshape(-1, 3)
CAMERAS = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [2.5, 0.0, 1.0]])


def test_free_is_near_a_camera_and_clear_of_landmarks():
    space = MappedSpace(WALL, CAMERAS, MappedSpaceConfig(max_camera_distance_m=0.5, clearance_m=0.3))
    points = [(0.1, 0, 1), (0.0, 0.49, 1), (0.0, 0.51, 1), (1.75, 0, 1), (2.65, 0, 1), (2.75, 0, 1)]
    assert space.is_free(points).tolist() == [True, True, False, False, True, False]


def test_bounds_reach_around_the_cameras_within_the_map():
    space = MappedSpace(WALL, CAMERAS, MappedSpaceConfig(max_camera_distance_m=0.75))
    np.testing.assert_allclose(space.bounds, [(0.0, -0.75, 0.25), (3.0, 0.75, 1.75)])
    outlier = np.concatenate([WALL, [(900.0, 0.0, 0.0)]])
    np.testing.assert_allclose(MappedSpace(outlier, CAMERAS).bounds, space.bounds)


def test_bad_input_is_refused():
    with pytest.raises(MapError):
        MappedSpace(np.zeros((0, 3)), CAMERAS)
    for settings in ({"max_camera_distance_m": 0.0}, {"clearance_m": -0.1}):
        with pytest.raises(ConfigError):
            MappedSpaceConfig(**settings)


def test_ways_are_free_where_every_point_of_them_is():
    rng = np.random.default_rng(0)
    cameras = rng.uniform((0, -1, 0.8), (3, 1, 1.2), (25, 3))
    landmarks = np.concatenate([WALL, rng.uniform((0, -1, 0.5), (3, 1, 1.5), (12, 3))])
    space = MappedSpace(landmarks, cameras, MappedSpaceConfig(max_camera_distance_m=0.6, clearance_m=0.2))
    a, b = rng.uniform((0, -1, 0.7), (2.7, 1, 1.3), (2, 300, 3))
    shares = np.linspace(0, 1, 2001)[:, None]
    expected = [bool(space.is_free(start + shares * (end - start)).all()) for start, end in zip(a, b, strict=True)]
    assert space.segments_are_free(a, b).tolist() == expected and 20 < sum(expected) < 280
    assert space.segments_are_free(a[:1], a[:1]).tolist() == space.is_free(a[:1]).tolist()
