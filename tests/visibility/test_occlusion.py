"""Occlusion by a mesh against a closed form, and what is stored of it."""

import numpy as np
import pytest

from box_scenes import quads_mesh
from depth_room import CAMERA, depth_images, free_points, room
from wheretolook.geometry.tsdf import DepthImage, TsdfVolume
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.utils.errors import SceneError, TableError
from wheretolook.visibility.occlusion import MeshOcclusion, StoredOcclusion, TsdfOcclusion


def screen():
    """A square of 1 m in the plane x = 1, centred on the x axis."""
    corners = [(1, -0.5, -0.5), (1, 0.5, -0.5), (1, 0.5, 0.5), (1, -0.5, 0.5)]
    return quads_mesh([corners], [np.zeros((1, 1, 3), np.uint8)])


def test_a_screen_hides_what_lies_in_its_shadow(rng):
    locations = np.array([[0.0, 0, 0], [0, 0.3, -0.2], [3, 0, 0]])
    points = rng.uniform([-1, -2, -2], [4, 2, 2], (2000, 3))
    seen = MeshOcclusion(MeshRaycaster(screen()), margin_m=0.0).unoccluded(locations, points)
    for row, location in enumerate(locations):
        along = (1 - location[0]) / (points[:, 0] - location[0])  # where the line crosses the plane x = 1
        crossing = location + along[:, None] * (points - location)
        hidden = (along > 0) & (along < 1) & (np.abs(crossing[:, 1:]) < 0.5).all(1)
        np.testing.assert_array_equal(seen[row], ~hidden)
        assert 20 < hidden.sum() < 1000


def test_a_landmark_on_a_surface_is_not_hidden_by_it():
    points = np.array([[1.0, 0, 0], [1.03, 0.1, 0.1], [1.3, 0, 0]])
    seen = MeshOcclusion(MeshRaycaster(screen()), margin_m=0.05).unoccluded(np.zeros((1, 3)), points)
    assert seen.tolist() == [[True, True, False]]


def test_stored_occlusion_comes_back_by_location(tmp_path):
    rng = np.random.default_rng(1)
    locations = rng.normal(size=(6, 3))
    mask = rng.random((6, 21)) < 0.5
    points = np.zeros((21, 3))
    path = tmp_path / "occlusion.npz"
    StoredOcclusion.from_mask(locations, mask).save(path)
    stored = StoredOcclusion.load(path)
    order = np.array([4, 0, 4, 2])
    np.testing.assert_array_equal(stored.unoccluded(locations[order] + 1e-7, points), mask[order])
    with pytest.raises(TableError):
        stored.unoccluded(locations[:1] + 0.01, points)
    with pytest.raises(TableError):
        stored.unoccluded(locations, points[:20])
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(TableError):
        StoredOcclusion.load(path)


# Occlusion by fused depth images against the exact mesh they were rendered from.


def lines_of_sight(mesh, seed):
    """Locations (30, 3), landmarks (3000, 3) on surfaces, 3 mm off, and which are free by the mesh."""
    rng = np.random.default_rng(seed)
    raycaster = MeshRaycaster(mesh)
    origins = free_points(rng, 3000)
    rays = rng.normal(size=(3000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    points = origins + raycaster.cast(origins, rays).distance_m[:, None] * rays
    points += rng.normal(scale=0.003, size=points.shape)
    locations = free_points(rng, 30)
    return locations, points, MeshOcclusion(raycaster).unoccluded(locations, points)


@pytest.fixture(scope="module")
def images():
    return depth_images(room(), seed=1, n=70)


@pytest.fixture(scope="module")
def volume(images):
    return TsdfVolume.from_images(images, progress=False)


@pytest.fixture(scope="module")
def occlusion(volume):
    return TsdfOcclusion(volume)


@pytest.mark.parametrize(("wall_m", "precision", "recall"), [(0.1, 0.98, 0.98), (0.05, 0.98, 0.98), (0.0, 0.95, 0.92)])
def test_agrees_with_the_mesh_though_walls_are_thin(wall_m, precision, recall):
    # Within the truncation the two sides of a wall without thickness cancel: it has some holes, and hides some of the
    # landmarks on itself. With two voxels and a half between them, they hardly touch.
    mesh = room(wall_m)
    images = depth_images(mesh, seed=3, n=50)
    locations, points, truth = lines_of_sight(mesh, seed=4)
    free = TsdfOcclusion(TsdfVolume.from_images(images, progress=False)).unoccluded(locations, points)
    assert truth[free].mean() >= precision and free[truth].mean() >= recall


def test_what_nothing_has_seen_hides_nothing():
    wall = DepthImage(np.full((240, 320), 2.0), CAMERA, np.eye(4)[:3])  # the plane z = 2 m, about 4 m wide
    occlusion = TsdfOcclusion(TsdfVolume.from_images([wall], progress=False))
    points = np.array([[0, 0, 1.9], [0, 0, 2.03], [0, 0, 3], [0, 0, -3], [9, 0, 3.0]])
    assert occlusion.unoccluded(np.zeros((1, 3)), points).tolist() == [[True, True, False, True, True]]


def test_a_location_inside_geometry_is_refused(occlusion):
    free = free_points(np.random.default_rng(7), 200, clearance_m=0.1)
    occlusion.check(free, free)
    occlusion.check(free[:0], free)
    # in a wall, in the cupboard, on the floor, outside, nowhere
    for location in ((2.0, 1.0, 1.2), (0.5, 2.6, 0.8), (1.0, 1.0, 0.0), (9.0, 1.0, 1.0), (np.nan, 1.0, 1.0)):
        with pytest.raises(SceneError):
            occlusion.check(np.vstack([free, location]), free)
