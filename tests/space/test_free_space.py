"""Free space of rooms whose free space is known."""

import numpy as np
import pytest

from box_scenes import CABINET, ROOM, TABLE_TOP, box_quads, furnished_room, quads_mesh
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.space.config import FreeSpaceConfig
from wheretolook.space.free_space import FreeSpace
from wheretolook.utils.errors import ConfigError


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
    np.testing.assert_array_equal(free, expected)
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
    np.testing.assert_array_equal(free[decided], expected[decided])


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
    np.testing.assert_array_equal(
        free_space.segments_are_free([a, a, a, a], [b, corner, (5.0, 0.4, 1.2), (3.1, 0.5, 1.2)]),
        [True, True, False, False],
    )
    # The door is 1 m wide: 0.45 m of clearance passes on its axis, and 0.1 m off it does not.
    tight = FreeSpace(house(), FreeSpaceConfig(clearance_m=0.45))
    np.testing.assert_array_equal(tight.segments_are_free([a, (1.0, 1.6, 1.2)], [b, (5.0, 1.6, 1.2)]), [True, False])


def test_floor_below():
    free_space = FreeSpace(furnished_room(), FreeSpaceConfig(max_floor_drop_m=2.5))
    above_table = (*np.mean(TABLE_TOP, axis=0)[:2], 1.5)
    points = [(3, 4, 1.0), above_table, (5, 1, 2.5), (3, 4, 2.8), (-1, 0, 1)]
    # Floor, table top, cabinet top, too high above the floor, outside.
    np.testing.assert_allclose(free_space.floor_below(points), [0, 0.75, 2, np.nan, np.nan], atol=1e-5)
    assert not free_space.is_free([(3, 4, 2.6)]).any()
    np.testing.assert_array_equal(free_space.bounds, [(0, 0, 0), ROOM])


def test_bad_config():
    with pytest.raises(ConfigError):
        FreeSpaceConfig(clearance_m=0.0)
