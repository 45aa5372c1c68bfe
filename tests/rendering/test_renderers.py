"""The Warp renderer against Open3D, and both against images known in closed form."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from box_scenes import furnished_room, quads_mesh, random_texture, random_triangles
from twins.open3d_renderer import Open3DRenderer
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import poses_looking_along, transform
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.utils.errors import ConfigError, SceneError

TRACING = partial(WarpRenderer, method="rays")
RENDERERS = pytest.mark.parametrize(
    "renderer", [WarpRenderer, TRACING, Open3DRenderer], ids=["raster", "rays", "open3d"]
)
METHODS = pytest.mark.parametrize("method", [None, "rays"], ids=["fastest", "rays"])
LOOK_ALONG_Y = poses_looking_along([[0.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])


def facing_wall(camera, texture, distance_m=2.0, texels_per_pixel=(1.0, 1.0), vertex_colors=None):
    """A wall across the view of LOOK_ALONG_Y on which a pixel covers a whole number of texels."""
    height, width = texture.shape[:2]
    half_x = width / texels_per_pixel[0] / 2 * distance_m / camera.focal_px
    half_z = height / texels_per_pixel[1] / 2 * distance_m / camera.focal_px
    corners = [(-half_x, -half_z), (half_x, -half_z), (half_x, half_z), (-half_x, half_z)]
    return quads_mesh([[(x, distance_m, z) for x, z in corners]], [texture], vertex_colors=vertex_colors)


def assert_same_images(a, b):
    hit_a = a.depth_m > 0
    hit_b = b.depth_m > 0
    # Rays through an edge may pass on either side of it.
    assert np.mean(hit_a == hit_b) > 0.9999
    both = hit_a & hit_b
    relative = np.abs(a.depth_m - b.depth_m)[both] / b.depth_m[both]
    assert np.mean(relative < 1e-4) > 0.9995
    error = np.abs(a.rgb.astype(int) - b.rgb)[both].max(axis=-1)
    assert np.mean(error <= 2) > 0.998
    assert error.mean() < 0.1
    assert (a.rgb[~hit_a] == 0).all() and (b.rgb[~hit_b] == 0).all()


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
@METHODS
def test_warp_agrees_with_open3d_on_random_triangles(seed, method, device):
    rng = np.random.default_rng(seed)
    mesh = random_triangles(seed)
    camera = PinholeCamera(161, 120, 90.0)
    poses = poses_looking_along(rng.uniform(-2, 2, (5, 3)), rng.normal(size=(5, 3)))
    images = WarpRenderer(mesh, device, method=method).render(camera, poses)
    assert images.rgb.shape == (5, 120, 161, 3) and images.rgb.dtype == np.uint8
    assert images.depth_m.shape == (5, 120, 161) and images.depth_m.dtype == np.float32
    assert 0.2 < np.mean(images.depth_m > 0) < 1
    assert_same_images(images, Open3DRenderer(mesh).render(camera, poses))


@RENDERERS
def test_one_texel_a_pixel_reproduces_the_texture(renderer):
    # Holds only with pixel centres at + 0.5, texel centres at + 0.5, u to the right and v down.
    camera = PinholeCamera(12, 10, 15.0)
    texture = random_texture(np.random.default_rng(0), 10, 12)
    images = renderer(facing_wall(camera, texture)).render(camera, LOOK_ALONG_Y)
    np.testing.assert_allclose(images.depth_m, 2.0, rtol=1e-6)
    np.testing.assert_array_equal(images.rgb[0], texture)


@RENDERERS
def test_stretched_footprint_is_averaged_along_its_long_side_only(renderer):
    camera = PinholeCamera(16, 12, 20.0)
    texture = random_texture(np.random.default_rng(2), 12, 64)
    wall = facing_wall(camera, texture, texels_per_pixel=(4, 1))
    expected = texture.reshape(12, 16, 4, 3).mean(axis=2)
    image = renderer(wall).render(camera, LOOK_ALONG_Y).rgb[0]
    assert np.abs(image - expected).max() <= 1


@RENDERERS
def test_depth_of_a_tilted_view_is_along_the_optical_axis(renderer):
    camera = PinholeCamera(30, 20, 15.0)
    pose = poses_looking_along([[0.3, -0.2, 1.5]], [[0.5, 0.7, -1.0]])
    floor = [(-50, -50, 0), (50, -50, 0), (50, 50, 0), (-50, 50, 0)]
    depth_m = renderer(quads_mesh([floor], [np.full((1, 1, 3), 9, np.uint8)])).render(camera, pose).depth_m[0]
    rows, columns = np.nonzero(depth_m)
    assert len(rows) > 300
    # Back-projected by K^-1 and the inverse pose, every pixel lies on the floor.
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=-1)
    in_camera = pixels @ np.linalg.inv(camera.matrix).T * depth_m[rows, columns][:, None]
    in_world = (in_camera - pose[0, :, 3]) @ pose[0, :, :3]
    np.testing.assert_allclose(in_world[:, 2], 0, atol=1e-4)
    np.testing.assert_allclose(transform(pose[0], in_world), in_camera, atol=1e-9)


@RENDERERS
def test_vertex_colors_multiply_and_both_sides_show(renderer):
    camera = PinholeCamera(12, 10, 15.0)
    texture = random_texture(np.random.default_rng(3), 10, 12)
    tint = np.tile(np.array([255, 51, 0], dtype=np.uint8), (4, 1))
    wall = facing_wall(camera, texture, vertex_colors=tint)
    front = renderer(wall).render(camera, LOOK_ALONG_Y).rgb[0]
    assert np.abs(front - texture * (1.0, 0.2, 0.0)).max() <= 0.5 + 1e-3
    behind = renderer(wall).render(camera, poses_looking_along([[0, 4, 0]], [[0, -1, 0]])).rgb[0]
    np.testing.assert_array_equal(behind, front[:, ::-1])


def test_blocks_do_not_change_the_images(device):
    mesh = random_triangles(1)
    camera = PinholeCamera(40, 30, 30.0)
    poses = poses_looking_along(np.zeros((5, 3)), np.random.default_rng(0).normal(size=(5, 3)))
    whole = WarpRenderer(mesh, device).render(camera, poses)
    blocks = WarpRenderer(mesh, device, block_bytes=2 * 40 * 30 * 7).render(camera, poses)
    np.testing.assert_array_equal(whole.rgb, blocks.rgb)
    np.testing.assert_array_equal(whole.depth_m, blocks.depth_m)
    assert WarpRenderer(mesh).render(camera, poses[:0]).rgb.shape == (0, 30, 40, 3)


def test_a_plane_through_the_camera_is_not_seen():
    # Edge-on, and in the plane of a row of pixels' rays.
    camera = PinholeCamera(41, 31, 20.0)
    wall = [(-9.0, 5.0, -9.0), (9.0, 5.0, -9.0), (9.0, 5.0, 9.0), (-9.0, 5.0, 9.0)]
    level = [(-3.0, 1.0, 0.0), (3.0, 1.0, 0.0), (3.0, 4.0, 0.0), (-3.0, 4.0, 0.0)]
    colors = [np.full((1, 1, 3), value, np.uint8) for value in (200, 50)]
    for turn in Rotation.create_group("O").as_matrix().round():
        mesh = quads_mesh([np.array(corners) @ turn.T for corners in (wall, level)], colors)
        pose = LOOK_ALONG_Y.copy()
        pose[0, :, :3] = pose[0, :, :3] @ turn.T
        assert (WarpRenderer(mesh).render(camera, pose).rgb == 200).all()


@pytest.mark.parametrize("turn", range(4))
def test_rasterizing_leaves_no_gap_on_edges_through_pixel_centres(turn):
    # A wall cut into triangles whose corners and edges lie exactly on the centres of pixels.
    camera = PinholeCamera(33, 33, 16.5)
    corners = np.arange(-40, 41, 4) / 16.5 * 2.0  # multiples of 4 pixels from the centre pixel's centre, at 2 m
    quads = [
        np.roll([(x, 2.0, z), (x + step, 2.0, z), (x + step, 2.0, z + step), (x, 2.0, z + step)], turn, axis=0)
        for step in [corners[1] - corners[0]]
        for x in corners[:-1]
        for z in corners[:-1]
    ]
    mesh = quads_mesh(quads, [np.full((1, 1, 3), 200, np.uint8)])
    for method in ("raster", "rays"):
        image = WarpRenderer(mesh, method=method).render(camera, LOOK_ALONG_Y)
        np.testing.assert_array_equal(image.rgb, 200)
        np.testing.assert_allclose(image.depth_m, 2.0, rtol=1e-6)


def test_invalid_input():
    with pytest.raises(SceneError):
        WarpRenderer(replace(furnished_room(), triangles=np.zeros((0, 3), np.int32)))
    with pytest.raises(ConfigError):
        WarpRenderer(furnished_room(), "cuda:99")
    with pytest.raises(ValueError):
        WarpRenderer(furnished_room()).render(PinholeCamera(8, 6, 4.0), np.full((1, 3, 4), np.nan))
