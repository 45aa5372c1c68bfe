"""Depth images fused to a surface, against the exact mesh they were rendered from."""

from __future__ import annotations

import numpy as np
import pytest

from depth_room import CAMERA, depth_images, room
from wheretolook.geometry.camera import ColmapCamera
from wheretolook.geometry.tsdf import DepthImage, TsdfConfig, TsdfVolume, estimate_blocks
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.utils.errors import ConfigError, SceneError


@pytest.fixture(scope="module")
def images() -> list[DepthImage]:
    return depth_images(room(), seed=1, n=70)


@pytest.fixture(scope="module")
def volume(images: list[DepthImage]) -> TsdfVolume:
    return TsdfVolume.from_images(images, progress=False)


def test_the_surface_lies_where_the_mesh_is(volume: TsdfVolume) -> None:
    surface = volume.surface()
    distance = MeshRaycaster(room()).distance_to_surface(surface.vertices, 0.5)
    assert np.quantile(distance, 0.95) < 0.005
    again = volume.surface()  # extracting has left the volume as it was, but for rounding
    assert len(again.triangles) == pytest.approx(len(surface.triangles), rel=1e-4)
    np.testing.assert_allclose(again.vertices.mean(0), surface.vertices.mean(0), atol=1e-4)


def test_a_depth_camera_may_have_two_focal_lengths_and_its_own_centre() -> None:
    depth = np.random.default_rng(0).uniform(1, 2, (240, 320))
    pose = np.eye(4)[:3]
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


def test_settings_and_scenes_without_sense_are_refused(images: list[DepthImage]) -> None:
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
    with pytest.raises(SceneError, match="0 images"):
        TsdfVolume.from_images([], progress=False)
    with pytest.raises(SceneError, match=r"up to 0\.1 m"):
        TsdfVolume.from_images(images, TsdfConfig(max_depth_m=0.1), progress=False)
    with pytest.raises(SceneError, match="no surface"):
        TsdfVolume().surface()
