"""Occlusion by fused depth images against the exact mesh they were rendered from."""

import numpy as np
import pytest

from depth_room import CAMERA, depth_images, free_points, room
from mask_agreement import MaskAgreement
from wheretolook.geometry.tsdf import DepthImage, TsdfVolume
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.utils.errors import SceneError
from wheretolook.visibility.occlusion import MeshOcclusion, TsdfOcclusion


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


def test_agrees_with_the_mesh_at_2_cm(occlusion):
    locations, points, truth = lines_of_sight(room(), seed=2)
    agreement = MaskAgreement.between(occlusion.unoccluded(locations, points), truth)
    assert 0.4 < truth.mean() < 0.8
    assert agreement.precision >= 0.98
    assert agreement.recall >= 0.98


@pytest.mark.parametrize(("wall_m", "precision", "recall"), [(0.05, 0.98, 0.98), (0.0, 0.95, 0.92)])
def test_thin_walls_seen_from_both_sides(wall_m, precision, recall):
    # Within the truncation the two sides of a wall without thickness cancel: it has some holes, and hides some of the
    # landmarks on itself. With two voxels and a half between them, they hardly touch.
    mesh = room(wall_m)
    images = depth_images(mesh, seed=3, n=50)
    locations, points, truth = lines_of_sight(mesh, seed=4)
    mask = TsdfOcclusion(TsdfVolume.from_images(images, progress=False)).unoccluded(locations, points)
    agreement = MaskAgreement.between(mask, truth)
    assert agreement.precision >= precision
    assert agreement.recall >= recall


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
