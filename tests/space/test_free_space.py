"""Free space of rooms whose free space is known."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from box_scenes import CABINET, ROOM, TABLE_TOP, box_quads, furnished_room, quads_mesh
from depth_room import CAMERA, ROOM as DEPTH_ROOM, depth_images, room
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.geometry.tsdf import DepthImage, TsdfVolume
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.space.config import FreeSpaceConfig, MappedSpaceConfig
from wheretolook.space.free_space import FreeSpace, TsdfSpace, seen_through
from wheretolook.space.mapped_space import MappedSpace
from wheretolook.utils.errors import ConfigError, MapError


def box_distance(points, low, high):
    """Distance from points outside a solid box to it, 0 inside."""
    return np.linalg.norm(np.maximum(np.maximum(np.subtract(low, points), np.subtract(points, high)), 0), axis=1)


def inside(points, low, high):
    return ((points > low) & (points < high)).all(axis=1)


def expected_free(points, clearance_m):
    """The room of `furnished_room`: inside it, off the walls, the cabinet and the table top."""
    free = inside(points, (clearance_m,) * 3, np.array(ROOM) - clearance_m)
    for low, high in (CABINET, TABLE_TOP):
        free &= box_distance(points, low, high) >= clearance_m
    return free


def with_winding(mesh, flip):
    """The mesh with the winding of the triangles in the mask reversed."""
    triangles = mesh.triangles.copy()
    uvs = mesh.corner_uvs.copy()
    triangles[flip] = triangles[flip][:, ::-1]
    uvs[flip] = uvs[flip][:, ::-1]
    return TexturedMesh(mesh.vertices, triangles, uvs, mesh.triangle_texture, mesh.textures)


@pytest.mark.parametrize("clearance_m", [0.15, 0.3])
def test_room_with_cabinet_and_table(clearance_m):
    points = np.random.default_rng(0).uniform((-1, -1, -1), np.array(ROOM) + 1, (4000, 3))
    free_space = FreeSpace(furnished_room(), FreeSpaceConfig(clearance_m=clearance_m))
    assert not free_space.two_sided, "the walls face in and the furniture out"
    free = free_space.is_free(points)
    expected = expected_free(points, clearance_m)
    assert expected.sum() > 300
    assert_array_equal(free, expected)
    assert not free[inside(points, *CABINET)].any()


@pytest.mark.parametrize("winding", ["reversed", "random"])
def test_unreliable_winding_is_found_out(winding):
    mesh = furnished_room()
    flip = np.ones(len(mesh.triangles), bool) if winding == "reversed" else np.random.default_rng(3).random(36) < 0.5
    free_space = FreeSpace(with_winding(mesh, flip))
    assert free_space.two_sided
    points = np.random.default_rng(0).uniform((-1, -1, -1), np.array(ROOM) + 1, (3000, 3))
    free = free_space.is_free(points)
    expected = expected_free(points, 0.25)
    # The inside of the cabinet, 1.8 x 1.6 x 2 m, cannot be distinguished from a small room.
    decided = ~inside(points, *CABINET)
    assert_array_equal(free[decided], expected[decided])


def test_closet_is_not_free_even_if_two_sided():
    closet = box_quads((2, 2, 0), (2.7, 4, 2.2))
    room = box_quads((0, 0, 0), ROOM, inward=True)
    mesh = quads_mesh(np.concatenate([room, closet]), [np.zeros((1, 1, 3), np.uint8)])
    free_space = FreeSpace(mesh, FreeSpaceConfig(two_sided=True))
    assert free_space.is_free([(1, 1, 1.5)]).all()
    assert not free_space.is_free([(2.35, 3, 1.1)]).any()


def house(ceiling=True):
    """Two rooms of 3 m joined by a door, walls 0.2 m thick, a ground that reaches 3 m beyond, and a roof slab."""
    ground = [[(-3, -3, 0), (9.4, -3, 0), (9.4, 6, 0), (-3, 6, 0)]]
    walls = [((-0.2, -0.2, 0), (0, 3.2, 2.5)), ((6.2, -0.2, 0), (6.4, 3.2, 2.5))]
    walls += [((0, -0.2, 0), (6.2, 0, 2.5)), ((0, 3, 0), (6.2, 3.2, 2.5))]
    walls += [((3, 0, 0), (3.2, 1, 2.5)), ((3, 2, 0), (3.2, 3, 2.5)), ((3, 1, 2.1), (3.2, 2, 2.5))]
    if ceiling:
        walls.append(((-0.2, -0.2, 2.5), (6.4, 3.2, 2.7)))
    mast = [((8, 5, 0), (8.05, 5.05, 4.5))]  # so that the bounds reach above the roof
    quads = np.concatenate([ground, *(box_quads(*box) for box in walls + mast)])
    return quads_mesh(quads, [np.zeros((1, 1, 3), np.uint8)])


@pytest.mark.parametrize("ceiling", [True, False])
@pytest.mark.parametrize("two_sided", [True, None])
def test_outside_and_above_a_house_are_not_free(ceiling, two_sided):
    free_space = FreeSpace(house(ceiling), FreeSpaceConfig(two_sided=two_sided))
    points = np.random.default_rng(0).uniform((-3, -3, 0), (9.4, 6, 4.5), (4000, 3))
    in_a_room = inside(points, (0.25, 0.25, 0.25), (2.75, 2.75, 2.2)) | inside(
        points, (3.45, 0.25, 0.25), (5.95, 2.75, 2.2)
    )
    in_the_house = inside(points, (0, 0, 0), (6.2, 3, 2.5))
    free = free_space.is_free(points)
    assert in_a_room.sum() > 100
    assert free[in_a_room].all()
    assert not free[~in_the_house].any()


def test_segments():
    free_space = FreeSpace(house())
    a = (1.0, 1.5, 1.2)  # through the middle of the door
    b = (5.0, 1.5, 1.2)
    corner = (1.0, 0.4, 1.2)
    assert_array_equal(
        free_space.segments_are_free([a, a, a, a], [b, corner, (5.0, 0.4, 1.2), (3.1, 0.5, 1.2)]),
        [True, True, False, False],
    )
    # The door is 1 m wide: 0.45 m of clearance passes on its axis, and 0.1 m off it does not.
    tight = FreeSpace(house(), FreeSpaceConfig(clearance_m=0.45))
    assert_array_equal(tight.segments_are_free([a, (1.0, 1.6, 1.2)], [b, (5.0, 1.6, 1.2)]), [True, False])


def test_floor_below():
    free_space = FreeSpace(furnished_room(), FreeSpaceConfig(max_floor_drop_m=2.5))
    above_table = (*np.mean(TABLE_TOP, axis=0)[:2], 1.5)
    points = [(3, 4, 1.0), above_table, (5, 1, 2.5), (3, 4, 2.8), (-1, 0, 1)]
    # Floor, table top, cabinet top, too high above the floor, outside.
    assert_allclose(free_space.floor_below(points), [0, 0.75, 2, np.nan, np.nan], atol=1e-5)
    assert not free_space.is_free([(3, 4, 2.6)]).any()
    assert_array_equal(free_space.bounds, [(0, 0, 0), ROOM])


# Free space from depth images, compared with that from the mesh they were rendered from.

VOXEL_M = 0.03
CLEARANCE_M = 0.2


def space_of(images):
    volume = TsdfVolume.from_images(images, VOXEL_M, progress=False)
    return TsdfSpace(volume, images, FreeSpaceConfig(clearance_m=CLEARANCE_M), progress=False)


@pytest.fixture(scope="module")
def images():
    return depth_images(room(), seed=1, n=150)  # enough to see all surfaces


def random_points(n, seed=0, beyond_m=0.5):
    return np.random.default_rng(seed).uniform(-beyond_m, DEPTH_ROOM + beyond_m, (n, 3))


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


# Free space by landmarks and cameras.

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


def test_landmarks_are_needed():
    with pytest.raises(MapError):
        MappedSpace(np.zeros((0, 3)), CAMERAS)


@pytest.mark.parametrize(
    ("config", "name", "value"),
    [
        (FreeSpaceConfig, "clearance_m", 0.0),
        (MappedSpaceConfig, "max_camera_distance_m", 0.0),
        (MappedSpaceConfig, "clearance_m", -0.1),
    ],
)
def test_invalid_options(config, name, value):
    with pytest.raises(ConfigError):
        config(**{name: value})


def test_ways_are_free_where_every_point_of_them_is(rng):
    cameras = rng.uniform((0, -1, 0.8), (3, 1, 1.2), (25, 3))
    landmarks = np.concatenate([WALL, rng.uniform((0, -1, 0.5), (3, 1, 1.5), (12, 3))])
    space = MappedSpace(landmarks, cameras, MappedSpaceConfig(max_camera_distance_m=0.6, clearance_m=0.2))
    a, b = rng.uniform((0, -1, 0.7), (2.7, 1, 1.3), (2, 300, 3))
    shares = np.linspace(0, 1, 2001)[:, None]
    expected = [bool(space.is_free(start + shares * (end - start)).all()) for start, end in zip(a, b, strict=True)]
    assert space.segments_are_free(a, b).tolist() == expected and 20 < sum(expected) < 280
    assert space.segments_are_free(a[:1], a[:1]).tolist() == space.is_free(a[:1]).tolist()
