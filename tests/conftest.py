"""Shared fixtures: small random maps and views."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import warp as wp

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import Float, poses_looking_along
from wheretolook.utils.warp import start_warp
from wheretolook.visibility.frustum import VisibleSets


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Tests that take a device run on the CPU, and on CUDA where there is one."""
    if "device" in metafunc.fixturenames:
        start_warp()
        metafunc.parametrize("device", ["cpu", "cuda"] if wp.is_cuda_available() else ["cpu"])


@dataclass(frozen=True)
class RandomViews:
    """Views from a few locations at random landmarks, some of them occluded at random."""

    camera: PinholeCamera
    points: Float
    locations: Float
    directions: Float
    mask: np.ndarray
    visible: VisibleSets
    location_rows: np.ndarray
    cam_from_world: Float


@pytest.fixture(params=[0, 1, 2])
def random_views(request: pytest.FixtureRequest) -> RandomViews:
    rng = np.random.default_rng(request.param)
    camera = PinholeCamera(320, 200 + 20 * request.param, 150.0 + 30 * request.param)
    points, locations = rng.uniform(-4, 4, (800, 3)), rng.uniform(-2, 2, (5, 3))
    directions = rng.normal(size=(17, 3))
    mask = rng.random((len(locations), len(points))) < 0.6
    location_rows = rng.integers(0, len(locations), 40)
    poses = poses_looking_along(locations[location_rows], rng.normal(size=(40, 3)))
    return RandomViews(camera, points, locations, directions, mask, VisibleSets.from_mask(mask), location_rows, poses)
