"""Free space from depth images, compared with that from the mesh they were rendered from."""

import numpy as np
import pytest

from depth_room import CAMERA, ROOM, depth_images, room
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.geometry.tsdf import DepthImage, TsdfConfig, TsdfVolume
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.space.config import FreeSpaceConfig
from wheretolook.space.free_space import FreeSpace, TsdfSpace, seen_through

VOXEL_M = 0.03
CLEARANCE_M = 0.2


def space_of(images):
    volume = TsdfVolume.from_images(images, TsdfConfig(voxel_size_m=VOXEL_M), progress=False)
    return TsdfSpace(volume, images, FreeSpaceConfig(clearance_m=CLEARANCE_M), progress=False)


@pytest.fixture(scope="module")
def images():
    return depth_images(room(), seed=1, n=150)  # enough to see all surfaces


def random_points(n, seed=0, beyond_m=0.5):
    return np.random.default_rng(seed).uniform(-beyond_m, ROOM + beyond_m, (n, 3))


def test_a_camera_is_free_where_it_is_by_the_mesh_but_never_near_a_surface(images):
    points = random_points(6000)
    free = space_of(images).is_free(points)
    distance = MeshRaycaster(room()).distance_to_surface(points, 1.0)
    assert not free[distance < CLEARANCE_M - VOXEL_M].any()
    by_mesh = FreeSpace(room(), FreeSpaceConfig(clearance_m=CLEARANCE_M)).is_free(points)
    away = distance > CLEARANCE_M + VOXEL_M
    assert by_mesh[away].sum() > 500 and (free[away] <= by_mesh[away]).all()
    assert free[away & by_mesh].mean() > 0.995


def test_what_no_image_saw_is_not_free(images):
    """The cameras are on one side of the wall, from where a part of the other side is hidden."""
    west = [image for image in images if -image.cam_from_world[:, :3].T[0] @ image.cam_from_world[:, 3] < 1.8]
    points = random_points(6000, beyond_m=0.0)
    seen = seen_through(points, west, 10.0, progress=False)
    by_mesh = FreeSpace(room()).is_free(points)
    hidden = by_mesh & ~seen & (points[:, 0] > 2.2)
    space = space_of(west)
    assert hidden.sum() > 50 and not space.is_free(points[hidden]).any()
    assert space.is_free(points[by_mesh & (points[:, 0] < 1.5)]).mean() > 0.8
    start = np.tile([1.0, 1.2, 1.2], (hidden.sum(), 1))
    assert space.is_free(start[:1]).all() and not space.segments_are_free(start, points[hidden]).any()


def test_an_image_sees_up_to_its_readings():
    depth = np.full((CAMERA.height, CAMERA.width), 2.0, dtype=np.float32)
    depth[:, : CAMERA.width // 2] = 0
    image = DepthImage(depth, CAMERA, poses_looking_along([[0.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])[0])
    points = np.array([[0.1, 1.9, 0], [0.1, 2.1, 0], [0.1, -1.0, 0], [-0.1, 1.0, 0], [0.5, 0.1, 0], [0.1, 1.0, 1.5]])
    np.testing.assert_array_equal(seen_through(points, [image], 10.0, False), [True, *[False] * 5])
    assert not seen_through(points, [image], 1.5, False).any()
