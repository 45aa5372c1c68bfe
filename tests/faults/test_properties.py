"""Any numbers given as cameras, poses, grids and waypoints lead to a result or a typed error."""

from __future__ import annotations

import contextlib
import math
from typing import Any

import numpy as np
import pytest

from wheretolook.geometry.camera import camera_of, camera_of_record
from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.geometry.poses import check_poses, poses_looking_along
from wheretolook.select.waypoints import Waypoints
from wheretolook.utils.errors import ConfigError, PoseError, TableError

pytest.importorskip("hypothesis")

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

NUMBERS = st.one_of(st.integers(-3, 10), st.integers(), st.floats(), st.sampled_from([2**31, 2**64, 1e308, 5e-324]))
POINTS = st.tuples(NUMBERS, NUMBERS, NUMBERS)
VALUES = st.recursive(st.one_of(st.none(), NUMBERS, st.text(max_size=9)), lambda inner: st.lists(inner, max_size=4))
some = settings(max_examples=50, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
N_PARAMS = {"PINHOLE": 4, "OPENCV": 8, "SIMPLE_RADIAL": 4, "OPENCV_FISHEYE": 8, "FOV": 5, "EQUIRECTANGULAR": 0, "X": 1}


@some
@given(st.sampled_from(sorted(N_PARAMS)), st.data())
def test_cameras(model: str, data: st.DataObject) -> None:
    params = data.draw(st.lists(NUMBERS, min_size=N_PARAMS[model], max_size=N_PARAMS[model]))
    try:
        camera = camera_of(model, data.draw(NUMBERS), data.draw(NUMBERS), params)
    except ConfigError:
        return
    assert camera_of_record(camera.record()) == camera
    assert camera.project([[0.1, 0.2, 1.0], [0, 0, 0], [1e300, 0, 1], [0, 0, -1]]).shape == (4, 2)


@some
@given(st.lists(POINTS, min_size=1, max_size=3), POINTS)
def test_poses(locations: Any, direction: Any) -> None:
    try:
        poses = poses_looking_along(locations, [direction] * len(locations))
    except PoseError:
        assert not (np.isfinite(np.array([*locations, direction], float)).all() and 0 < math.hypot(*direction) < 1e150)
        return
    assert check_poses(poses).shape == (len(locations), 3, 4)


@some
@given(POINTS, POINTS, st.tuples(*[st.integers(-2, 50)] * 3))
def test_grids(lower: Any, upper: Any, shape: Any) -> None:
    with contextlib.suppress(ConfigError):
        grid = VoxelGrid(lower, upper, shape)
        ids = grid.location_ids([lower, upper, (0.0, 0.0, 0.0), (math.nan, 0, 0), (1e308, -1e308, 0)])
        assert ((ids >= -1) & (ids < len(grid))).all()


@some
@given(VALUES)
def test_waypoints(values: Any) -> None:
    with contextlib.suppress(TableError):
        assert np.isfinite(Waypoints.of(values).points).all()
