"""Ray and distance queries against Open3D and closed forms."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from box_scenes import CABINET, ROOM, furnished_room, random_triangles
from twins.open3d_renderer import raycasting_scene
from wheretolook.rendering.raycasting import MeshRaycaster


def open3d_rays(origins, directions):
    import open3d as o3d

    return o3d.core.Tensor(np.concatenate([origins, directions], axis=-1).astype(np.float32))


@pytest.mark.parametrize("seed", [0, 1])
def test_cast_agrees_with_open3d(seed, device):
    rng = np.random.default_rng(seed)
    mesh = random_triangles(seed)
    origins = rng.uniform(-2, 2, (4000, 3))
    directions = rng.normal(size=(4000, 3))
    hits = MeshRaycaster(mesh, device).cast(origins, directions)
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    expected = raycasting_scene(mesh).cast_rays(open3d_rays(origins, unit))
    distance_m = expected["t_hit"].numpy()
    hit = np.isfinite(distance_m)
    assert 0.3 < hit.mean() < 1
    assert np.mean(np.isfinite(hits.distance_m) == hit) > 0.999
    hit &= np.isfinite(hits.distance_m)
    same = hits.triangle[hit] == expected["primitive_ids"].numpy()[hit]
    assert same.mean() > 0.999
    assert_allclose(hits.distance_m[hit][same], distance_m[hit][same], rtol=1e-4, atol=1e-5)
    normals = expected["primitive_normals"].numpy()[hit][same]
    facing = np.einsum("nd,nd->n", normals, unit[hit][same])
    clear = np.abs(facing) > 1e-3
    assert_array_equal(hits.front[hit][same][clear], facing[clear] < 0)
    assert (hits.triangle[~np.isfinite(hits.distance_m)] == -1).all()


def test_cast_in_a_box_in_closed_form():
    raycaster = MeshRaycaster(furnished_room())
    hits = raycaster.cast([(1, 1, 1)] * 3 + [(5, 1, 1)], [(-2, 0, 0), (1, 0, 0), (0, 0, 9), (0, 0, 1)])
    # To the wall x = 0, to the cabinet's side x = 4, to the ceiling, and from inside the cabinet to its top.
    assert_allclose(hits.distance_m, [1, 3, 2, 1], rtol=1e-6)
    assert_array_equal(hits.front, [True, True, True, False])
    outside = raycaster.cast([(-1, 1, 1)], [(-1, 0, 0)])
    assert np.isinf(outside.distance_m[0]) and outside.triangle[0] == -1 and not outside.front[0]


def test_occlusion_margin():
    raycaster = MeshRaycaster(furnished_room())
    # On the wall y = 5, a little behind it, well behind it, and behind the cabinet.
    points = [(3, 5, 1), (3, 5.01, 1), (3, 5.1, 1), (5, 0, 1)]
    origins = [(3, 3, 1), (4, 3, 1)]
    assert_array_equal(
        raycaster.occluded(origins, points, margin_m=0.02), [[False, False, True, True], [False, False, True, True]]
    )
    assert not raycaster.occluded([(3, 3, 1)], [(3, 3, 1)]).any(), "a point at the origin is unoccluded"
    assert raycaster.occluded(np.zeros((2, 3)), np.zeros((0, 3))).shape == (2, 0)


def test_distance_to_surface(device):
    import open3d as o3d

    mesh = random_triangles(0)
    points = np.random.default_rng(0).uniform(-4, 4, (500, 3))
    expected = raycasting_scene(mesh).compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()
    assert_allclose(MeshRaycaster(mesh, device).distance_to_surface(points, 100), expected, atol=1e-5)
    near = MeshRaycaster(mesh, device).distance_to_surface(points, 0.3)
    assert_array_equal(np.isfinite(near), expected < 0.3)

    room = MeshRaycaster(furnished_room())
    left = CABINET[0][0]  # 0.3 m and 0.4 m from the cabinet's vertical edge
    back = CABINET[1][1]
    assert_allclose(room.distance_to_surface([(left - 0.3, back + 0.4, 1.2)], 9), 0.5, rtol=1e-5)


def test_segments_keep_clear_as_densely_sampled_points_do(device):
    mesh = random_triangles(3, n_triangles=40)
    clearance_m = 0.2
    rng = np.random.default_rng(4)
    a, b = rng.uniform(-4, 4, (2, 400, 3))
    clear = MeshRaycaster(mesh, device).segments_are_clear(a, b, clearance_m)
    steps = np.linspace(0, 1, 800)[:, None, None]
    samples = (a * (1 - steps) + b * steps).reshape(-1, 3)
    nearest = MeshRaycaster(mesh).distance_to_surface(samples, 10).reshape(800, -1).min(axis=0)
    decided = np.abs(nearest - clearance_m) > 0.005
    assert_array_equal(clear[decided], nearest[decided] > clearance_m)
    assert 0.1 < clear.mean() < 0.9
    middle = np.array(ROOM) / 2
    room = MeshRaycaster(furnished_room())
    assert room.segments_are_clear([middle], [middle], 0.2).all()
    assert not room.segments_are_clear([middle], [middle * (1, 1, 2.5)], 0.2).any(), "through the ceiling"
