"""Depth images fused to a surface, against the exact mesh they were rendered from."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from depth_room import depth_images, room
from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.geometry.tsdf import DepthImage, TsdfVolume, estimate_blocks
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.utils.errors import ConfigError, SceneError


@pytest.fixture(scope="module")
def images():
    return depth_images(room(), seed=1, n=70)


@pytest.fixture(scope="module")
def volume(images):
    return TsdfVolume.from_images(images, progress=False)


def test_the_surface_lies_where_the_mesh_is(volume):
    surface = volume.surface()
    distance = MeshRaycaster(room()).distance_to_surface(surface.vertices, 0.5)
    assert np.quantile(distance, 0.95) < 0.005
    again = volume.surface()  # extracting has left the volume as it was, but for rounding
    assert len(again.triangles) == pytest.approx(len(surface.triangles), rel=1e-4)
    assert_allclose(again.vertices.mean(0), surface.vertices.mean(0), atol=1e-4)


def test_a_depth_camera_may_have_two_focal_lengths_and_its_own_centre():
    depth = np.random.default_rng(0).uniform(1, 2, (240, 320))
    pose = np.eye(4)[:3]
    camera = ColmapCamera("PINHOLE", 320, 240, (200.0, 210.0, 155.0, 118.0))
    points = DepthImage(depth, camera, pose).points(10.0)
    rows, columns = np.divmod(np.arange(320 * 240), 320)
    assert_allclose(camera.project(points), np.column_stack([columns + 0.5, rows + 0.5]), atol=1e-4)
    assert_allclose(points[:, 2], depth.ravel(), rtol=1e-6)
    with pytest.raises(ConfigError):
        DepthImage(depth, ColmapCamera("RADIAL", 320, 240, (200.0, 160.0, 120.0, 0.1, 0.0)), pose)


def test_voxels_that_do_not_fit_into_memory_are_refused(images, volume, monkeypatch):
    assert 1 <= estimate_blocks(images, volume.voxel_size_m, volume.max_depth_m) / len(volume) < 2
    monkeypatch.setattr("wheretolook.geometry.tsdf.fitting", lambda bytes_each: (5 << 20) // bytes_each)
    with pytest.raises(ConfigError):
        TsdfVolume.from_images(images, progress=False)
    small = TsdfVolume()
    with pytest.raises(ConfigError):
        for image in images:
            small.integrate(image)


@pytest.mark.parametrize("options", [{"voxel_size_m": 0.0}, {"voxel_size_m": float("nan")}, {"max_depth_m": -1.0}])
def test_invalid_options(options):
    with pytest.raises(ConfigError):
        TsdfVolume(**options)


def test_scenes_without_a_surface(images):
    for seen in ([], images):
        with pytest.raises(SceneError):
            TsdfVolume.from_images(seen, max_depth_m=0.1, progress=False)
    with pytest.raises(SceneError):
        TsdfVolume().surface()
    one_reading = np.zeros((48, 64))
    one_reading[0, 0] = 1.0
    volume = TsdfVolume()
    volume.integrate(DepthImage(one_reading, PinholeCamera(64, 48, 40.0), np.eye(4)[:3]))
    with pytest.raises(SceneError):
        volume.surface()
