"""Occlusion by fused depth images against the exact mesh they were rendered from."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from box_scenes import box_quads, quads_mesh, random_texture
from mask_agreement import MaskAgreement
from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.rendering.types import camera_rays
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.visibility.occlusion import MeshOcclusion
from wheretolook.visibility.tsdf import DepthImage, TsdfConfig, TsdfOcclusion, TsdfVolume, estimate_blocks

ROOM = np.array([4.0, 3.0, 2.5])
CUPBOARD = np.array([[0.0, 2.2, 0.0], [1.2, 3.0, 1.6]])
CAMERA = PinholeCamera(320, 240, 160.0)


def room(wall_m: float = 0.1) -> TexturedMesh:
    """A room with a wall, open at one end, across it, and a cupboard; the wall may have no thickness."""
    wall = box_quads((2 - wall_m / 2, 0, 0), (2 + wall_m / 2, 2, 2.5))
    if wall_m == 0:
        wall = np.array([[[2, 0, 0], [2, 2, 0], [2, 2, 2.5], [2, 0, 2.5]]], dtype=np.float64)
    quads = np.concatenate([box_quads((0, 0, 0), ROOM, inward=True), wall, box_quads(*CUPBOARD)])
    return quads_mesh(quads, [random_texture(np.random.default_rng(0), 4, 4)])


def free_points(rng: np.random.Generator, n: int, clearance_m: float = 0.25) -> np.ndarray:
    """Random points in the room, clear of the wall and outside the cupboard."""
    points = rng.uniform(clearance_m, ROOM - clearance_m, (3 * n, 3))
    in_wall = (np.abs(points[:, 0] - 2) < clearance_m) & (points[:, 1] < 2 + clearance_m)
    in_cupboard = ((points > CUPBOARD[0] - clearance_m) & (points < CUPBOARD[1] + clearance_m)).all(1)
    return points[~in_wall & ~in_cupboard][:n]


def depth_images(mesh: TexturedMesh, seed: int, n: int, camera: PinholeCamera = CAMERA) -> list[DepthImage]:
    """Exact depth images from random free places in random, mostly level directions."""
    rng = np.random.default_rng(seed)
    poses = poses_looking_along(free_points(rng, n), rng.normal(size=(n, 3)) * (1, 1, 0.5))
    raycaster = MeshRaycaster(mesh)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    images = []
    for pose, center, ray_from_pixel in zip(poses, *camera_rays(camera, poses), strict=True):
        rays = pixels @ ray_from_pixel.T
        distance = raycaster.cast(np.broadcast_to(center, rays.shape), rays).distance_m
        z = (distance / np.linalg.norm(rays, axis=1)).reshape(x.shape)
        images.append(DepthImage(z.astype(np.float32), camera, pose))
    return images


def lines_of_sight(mesh: TexturedMesh, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Locations (30, 3), landmarks (3000, 3) on surfaces, 3 mm off, and which are free by the mesh."""
    rng, raycaster = np.random.default_rng(seed), MeshRaycaster(mesh)
    origins, rays = free_points(rng, 3000), rng.normal(size=(3000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    points = origins + raycaster.cast(origins, rays).distance_m[:, None] * rays
    points += rng.normal(scale=0.003, size=points.shape)
    locations = free_points(rng, 30)
    return locations, points, MeshOcclusion(raycaster).unoccluded(locations, points)


@pytest.fixture(scope="module")
def images() -> list[DepthImage]:
    return depth_images(room(), seed=1, n=70)


@pytest.fixture(scope="module")
def volume(images: list[DepthImage]) -> TsdfVolume:
    return TsdfVolume.from_images(images, progress=False)


@pytest.fixture(scope="module")
def occlusion(volume: TsdfVolume) -> TsdfOcclusion:
    return TsdfOcclusion(volume)


def test_agrees_with_the_mesh_at_2_cm(occlusion: TsdfOcclusion) -> None:
    locations, points, truth = lines_of_sight(room(), seed=2)
    agreement = MaskAgreement.between(occlusion.unoccluded(locations, points), truth)
    assert 0.4 < truth.mean() < 0.8
    assert agreement.precision >= 0.98
    assert agreement.recall >= 0.98


def test_the_surface_lies_where_the_mesh_is(volume: TsdfVolume) -> None:
    surface = volume.surface()
    distance = MeshRaycaster(room()).distance_to_surface(surface.vertices, 0.5)
    assert np.quantile(distance, 0.95) < 0.005
    again = volume.surface()  # extracting has left the volume as it was, but for rounding
    assert len(again.triangles) == pytest.approx(len(surface.triangles), rel=1e-4)
    np.testing.assert_allclose(again.vertices.mean(0), surface.vertices.mean(0), atol=1e-4)


@pytest.mark.parametrize(("wall_m", "precision", "recall"), [(0.05, 0.98, 0.98), (0.0, 0.95, 0.92)])
def test_thin_walls_seen_from_both_sides(wall_m: float, precision: float, recall: float) -> None:
    # Within the truncation the two sides of a wall without thickness cancel: it has some holes, and hides some of the
    # landmarks on itself. With two voxels and a half between them, they hardly touch.
    mesh = room(wall_m)
    images = depth_images(mesh, seed=3, n=50)
    locations, points, truth = lines_of_sight(mesh, seed=4)
    mask = TsdfOcclusion(TsdfVolume.from_images(images, progress=False)).unoccluded(locations, points)
    agreement = MaskAgreement.between(mask, truth)
    assert agreement.precision >= precision
    assert agreement.recall >= recall


def test_pixels_without_reading_neither_occlude_nor_carve(images: list[DepthImage]) -> None:
    rng = np.random.default_rng(5)
    marks = np.array([0, np.nan, np.inf, -np.inf, -1, 1e6], dtype=np.float32)
    holed = []
    for image in images:
        hole = rng.random(image.depth_m.shape) < 0.02
        top, left = rng.integers(0, 180), rng.integers(0, 240)
        hole[top : top + 60, left : left + 80] = True
        depth = np.where(hole, rng.choice(marks, image.depth_m.shape), image.depth_m)
        holed.append(DepthImage(depth, image.camera, image.cam_from_world))
    blind = DepthImage(np.full((240, 320), np.nan, np.float32), CAMERA, images[0].cam_from_world)
    volume = TsdfVolume.from_images([blind, *holed], progress=False)
    locations, points, truth = lines_of_sight(room(), seed=2)
    agreement = MaskAgreement.between(TsdfOcclusion(volume).unoccluded(locations, points), truth)
    assert agreement.precision >= 0.98
    assert agreement.recall >= 0.98


def test_what_nothing_has_seen_hides_nothing() -> None:
    wall = DepthImage(np.full((240, 320), 2.0), CAMERA, np.eye(4)[:3])  # the plane z = 2 m, about 4 m wide
    occlusion = TsdfOcclusion(TsdfVolume.from_images([wall], progress=False))
    points = np.array([[0, 0, 1.9], [0, 0, 2.03], [0, 0, 3], [0, 0, -3], [9, 0, 3.0]])
    assert occlusion.unoccluded(np.zeros((1, 3)), points).tolist() == [[True, True, False, True, True]]


def test_more_blocks_than_expected_change_nothing(images: list[DepthImage]) -> None:
    config = TsdfConfig(voxel_size_m=0.04)
    small, large = TsdfVolume(config, expected_blocks=16), TsdfVolume(config, expected_blocks=1 << 15)
    for image in images[:30]:
        small.integrate(image)
        large.integrate(image)
    assert len(small) == len(large) > 500
    locations, points, _ = lines_of_sight(room(), seed=6)
    mask = TsdfOcclusion(small).unoccluded(locations, points)
    np.testing.assert_array_equal(mask, TsdfOcclusion(large).unoccluded(locations, points))
    assert TsdfOcclusion(large).unoccluded(locations[:0], points).shape == (0, len(points))
    assert TsdfOcclusion(large).unoccluded(locations, points[:0]).shape == (len(locations), 0)


def test_moving_the_world_changes_little(images: list[DepthImage]) -> None:
    turn, shift = Rotation.from_euler("zyx", [0.7, -0.4, 0.3]).as_matrix(), np.array([12.3, -45.6, 7.8])
    moved = []
    for image in images:
        rotation = image.cam_from_world[:, :3] @ turn.T
        translation = image.cam_from_world[:, 3] - rotation @ shift
        moved.append(DepthImage(image.depth_m, CAMERA, np.column_stack([rotation, translation])))
    occlusion = TsdfOcclusion(TsdfVolume.from_images(moved, progress=False))
    locations, points, truth = lines_of_sight(room(), seed=2)
    agreement = MaskAgreement.between(occlusion.unoccluded(locations @ turn.T + shift, points @ turn.T + shift), truth)
    assert agreement.precision >= 0.98
    assert agreement.recall >= 0.98


def test_a_location_inside_geometry_is_refused(occlusion: TsdfOcclusion) -> None:
    free = free_points(np.random.default_rng(7), 200, clearance_m=0.1)
    occlusion.check(free, free)
    occlusion.check(free[:0], free)
    inside_wall, inside_cupboard, on_floor, outside = (2.0, 1.0, 1.2), (0.5, 2.6, 0.8), (1.0, 1.0, 0.0), (9.0, 1.0, 1.0)
    for location in (inside_wall, inside_cupboard, on_floor, outside, (np.nan, 1.0, 1.0)):
        with pytest.raises(SceneError, match=r"inside geometry|not finite") as caught:
            occlusion.check(np.vstack([free, location]), free)
        assert repr(tuple(np.float64(location).tolist())) in str(caught.value)


def test_a_depth_camera_may_have_two_focal_lengths_and_its_own_centre() -> None:
    depth, pose = np.random.default_rng(0).uniform(1, 2, (240, 320)), np.eye(4)[:3]
    camera = ColmapCamera("PINHOLE", 320, 240, (200.0, 210.0, 155.0, 118.0))
    points = DepthImage(depth, camera, pose).points(10.0)
    rows, columns = np.divmod(np.arange(320 * 240), 320)
    np.testing.assert_allclose(camera.project(points), np.column_stack([columns + 0.5, rows + 0.5]), atol=1e-4)
    np.testing.assert_allclose(points[:, 2], depth.ravel(), rtol=1e-6)
    same = ColmapCamera("SIMPLE_PINHOLE", 320, 240, (CAMERA.focal_px, CAMERA.cx, CAMERA.cy))
    assert (CAMERA.width, CAMERA.height) == (320, 240)
    np.testing.assert_allclose(DepthImage(depth, same, pose).points(10.0), DepthImage(depth, CAMERA, pose).points(10.0))
    with pytest.raises(ConfigError, match=r"no intrinsic matrix.*RADIAL"):
        DepthImage(depth, ColmapCamera("RADIAL", 320, 240, (200.0, 160.0, 120.0, 0.1, 0.0)), pose)


def test_voxels_larger_than_the_scene_show_no_surface(images: list[DepthImage]) -> None:
    with pytest.raises(SceneError, match="no surface"):
        TsdfOcclusion(
            TsdfVolume.from_images(images[:20], TsdfConfig(voxel_size_m=20.0, max_depth_m=20.0), progress=False)
        )


def test_a_depth_image_must_fit_its_camera() -> None:
    pose = np.eye(4)[:3]
    with pytest.raises(ConfigError, match=r"240 x 320 pixels.*\(got \(320, 240\)\)"):
        DepthImage(np.ones((320, 240)), CAMERA, pose)
    with pytest.raises(ConfigError, match="uint16"):
        DepthImage(np.ones((240, 320), np.uint16), CAMERA, pose)
    for bad in (np.eye(4), 2 * pose, np.full((3, 4), np.nan), pose * [[-1.0], [1], [1]]):
        with pytest.raises(ConfigError, match="rigid transform"):
            DepthImage(np.ones((240, 320)), CAMERA, bad)


def test_voxels_that_do_not_fit_the_memory_are_refused_before_the_fusion(
    images: list[DepthImage], volume: TsdfVolume, monkeypatch: pytest.MonkeyPatch
) -> None:
    needed = estimate_blocks(images, volume.config)
    assert 1 <= needed / len(volume) < 2
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TsdfVolume, "integrate", lambda *_: pytest.fail("fused all the same"))
        with pytest.raises(ConfigError, match=r"bytes.*voxel_size_m=0\.0005.*would fit"):
            TsdfVolume.from_images(images, TsdfConfig(voxel_size_m=0.0005), progress=False)
        limit = 50 << 20
        with pytest.raises(ConfigError, match=rf"{limit // 24576 * 24576:,} bytes.*voxel_size_m=0\.02") as caught:
            TsdfVolume.from_images(images, TsdfConfig(memory_limit_bytes=limit), progress=False)
    fitting = float(str(caught.value).split("voxel_size_m of ")[1].split()[0])
    assert 0.02 < fitting < 0.06
    TsdfVolume.from_images(images[:5], TsdfConfig(voxel_size_m=fitting, memory_limit_bytes=limit), progress=False)
    outgrown = TsdfVolume(TsdfConfig(memory_limit_bytes=5 << 20))
    with pytest.raises(ConfigError, match=r"voxel_size_m=0\.02"):
        for image in images:
            outgrown.integrate(image)


def test_settings_and_scenes_without_sense_are_refused(volume: TsdfVolume, images: list[DepthImage]) -> None:
    for setting in (
        {"voxel_size_m": 0.0},
        {"voxel_size_m": float("nan")},
        {"truncation_voxels": 0.5},
        {"max_depth_m": -1.0},
        {"memory_limit_bytes": 0},
    ):
        ((name, value),) = setting.items()
        with pytest.raises(ConfigError, match=rf"{name}.*\(got {value}\)"):
            TsdfConfig(**setting)
    with pytest.raises(ConfigError, match=r"margin.*-0\.1"):
        TsdfOcclusion(volume, margin_m=-0.1)
    with pytest.raises(SceneError, match="0 images"):
        TsdfVolume.from_images([], progress=False)
    with pytest.raises(SceneError, match=r"up to 0\.1 m"):
        TsdfVolume.from_images(images, TsdfConfig(max_depth_m=0.1), progress=False)
    with pytest.raises(SceneError, match="no surface"):
        TsdfOcclusion(TsdfVolume())
