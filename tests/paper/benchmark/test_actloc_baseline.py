"""The released baseline, against its definition in plain loops."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wheretolook.geometry.poses import camera_centers
from wheretolook.utils.errors import MapError
from wheretolook_paper.benchmark.actloc_baseline import actloc_views


def definition(points, place):
    """The orientation (3, 3) in the world that it returns."""
    best = (-60, -180)
    most = -1
    for elevation in range(-60, 60, 20):
        for azimuth in range(-180, 180, 20):
            rotation = Rotation.from_euler("ZXZ", [azimuth, elevation, 180], degrees=True).as_matrix()
            count = 0
            for x, y, z in (points - place) @ rotation:
                if 0 < z < 3:
                    count += 0 <= 277 * x / z + 159.5 < 320 and 0 <= 277 * y / z + 159.5 < 320
            if count > most:
                best = (elevation, azimuth)
                most = count
    return Rotation.from_euler("ZXZ", [best[0], best[1], 180], degrees=True).as_matrix()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_views_are_those_of_the_definition(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform((-4, -4, -1), (4, 4, 3), (150, 3))
    places = rng.uniform(-1, 1, (3, 3))
    poses = actloc_views(points, places)
    np.testing.assert_allclose(camera_centers(poses), places, atol=1e-12)
    for pose, place in zip(poses, places, strict=True):
        np.testing.assert_allclose(pose[:, :3].T, definition(points, place), atol=1e-12)


def test_a_map_without_landmarks():
    with pytest.raises(MapError):
        actloc_views(np.zeros((0, 3)), np.zeros((1, 3)))
