"""The Warp renderer against Open3D, and both against images known in closed form."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from box_scenes import furnished_room, quads_mesh, random_texture, random_triangles
from twins.open3d_renderer import Open3DRenderer
from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.geometry.poses import poses_looking_along, transform
from wheretolook.rendering.warp_renderer import WarpRenderer, build_pyramids, texel_gradients
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
    assert_allclose(images.depth_m, 2.0, rtol=1e-6)
    assert_array_equal(images.rgb[0], texture)


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
    assert_allclose(in_world[:, 2], 0, atol=1e-4)
    assert_allclose(transform(pose[0], in_world), in_camera, atol=1e-9)


@RENDERERS
def test_vertex_colors_multiply_and_both_sides_show(renderer):
    camera = PinholeCamera(12, 10, 15.0)
    texture = random_texture(np.random.default_rng(3), 10, 12)
    tint = np.tile(np.array([255, 51, 0], dtype=np.uint8), (4, 1))
    wall = facing_wall(camera, texture, vertex_colors=tint)
    front = renderer(wall).render(camera, LOOK_ALONG_Y).rgb[0]
    assert np.abs(front - texture * (1.0, 0.2, 0.0)).max() <= 0.5 + 1e-3
    behind = renderer(wall).render(camera, poses_looking_along([[0, 4, 0]], [[0, -1, 0]])).rgb[0]
    assert_array_equal(behind, front[:, ::-1])


def test_blocks_do_not_change_the_images(device):
    mesh = random_triangles(1)
    camera = PinholeCamera(40, 30, 30.0)
    poses = poses_looking_along(np.zeros((5, 3)), np.random.default_rng(0).normal(size=(5, 3)))
    whole = WarpRenderer(mesh, device).render(camera, poses)
    renderer = WarpRenderer(mesh, device, block_bytes=2 * 40 * 30 * 7)
    blocks = renderer.render(camera, poses)
    assert_array_equal(whole.rgb, blocks.rgb)
    assert_array_equal(whole.rgb, np.concatenate([colors.numpy() for colors in renderer.colors(camera, poses)]))
    assert_array_equal(whole.depth_m, blocks.depth_m)
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
        assert_array_equal(image.rgb, 200)
        assert_allclose(image.depth_m, 2.0, rtol=1e-6)


def test_invalid_input():
    with pytest.raises(SceneError):
        WarpRenderer(replace(furnished_room(), triangles=np.zeros((0, 3), np.int32)))
    with pytest.raises(ConfigError):
        WarpRenderer(furnished_room(), "cuda:99")
    with pytest.raises(ValueError):
        WarpRenderer(furnished_room()).render(PinholeCamera(8, 6, 4.0), np.full((1, 3, 4), np.nan))


# Images of cameras with distortion, against OpenCV's maps of an image that a pinhole took.

POSE = poses_looking_along([[0.2, -0.1, 1.2]], [[1.0, 0.3, -0.1]])


@pytest.fixture(scope="module")
def renderer():
    return WarpRenderer(furnished_room())


def test_distortion_is_opencvs(renderer):
    """A wide image of a pinhole, distorted by OpenCV, is what the camera with distortion sees."""
    k = np.array([[110.0, 0, 80.0], [0, 112.0, 60.0], [0, 0, 1]])
    distortion = np.array([-0.12, 0.02, 0.003, -0.002])
    camera = ColmapCamera("OPENCV", 160, 120, (110.0, 112.0, 80.0, 60.0, *distortion))
    seen = renderer.render(camera, POSE).rgb[0]
    wide = PinholeCamera(1200, 1000, 440.0)
    pixels = np.stack(np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5), -1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels, k, distortion)[:, 0]
    at = (wide.project(np.column_stack([rays, np.ones(len(rays))])) - 0.5).astype(np.float32).reshape(120, 160, 2)
    expected = cv2.remap(renderer.render(wide, POSE).rgb[0], at[..., 0], at[..., 1], cv2.INTER_AREA)
    assert np.mean(np.abs(seen.astype(int) - expected)) < 8
    shifted = np.roll(expected, 3, axis=1)
    assert np.mean(np.abs(seen.astype(int) - shifted)) > 1.5 * np.mean(np.abs(seen.astype(int) - expected))


def test_a_fisheye_sees_half_a_sphere(renderer):
    """What it sees at a pixel is what a pinhole that looks along the pixel's ray sees at its centre."""
    fisheye = ColmapCamera("SIMPLE_FISHEYE", 200, 200, (60.0, 100.0, 100.0))  # 100 / 60 rad = 95 degrees off the axis
    seen = renderer.render(fisheye, POSE)
    for column, row in ((12, 100), (185, 100), (100, 30), (100, 100)):
        ray = fisheye.unproject([column + 0.5, row + 0.5])
        ahead = POSE[0, :, :3].T @ ray
        looking = poses_looking_along([[0.2, -0.1, 1.2]], [ahead])
        small = renderer.render(PinholeCamera(5, 5, 50.0), looking)
        np.testing.assert_allclose(seen.depth_m[0, row, column], small.depth_m[0, 2, 2] * ray[2], rtol=0.05, atol=0.02)
    assert not seen.rgb[0, [0, 100, 100], [0, 2, 197]].any()  # COLMAP projects nothing behind the image plane


# Mip pyramids and texel gradients against averages and differences taken by hand.


def level_of(pyramids, texture, level):
    width, height = np.maximum(1, pyramids.size[texture, :2] >> level)
    start = pyramids.level_start[texture, level]
    texels = pyramids.texels[start : start + width * height].reshape(height, width)
    return np.stack([texels >> shift & 255 for shift in (0, 8, 16)], axis=-1)


def test_pyramids_of_several_textures(rng):
    textures = (random_texture(rng, 8, 16), random_texture(rng, 1, 1), random_texture(rng, 5, 3))
    pyramids = build_pyramids(textures)
    assert_array_equal(pyramids.size, [[16, 8, 5], [1, 1, 1], [3, 5, 3]])
    for k, texture in enumerate(textures):
        assert_array_equal(level_of(pyramids, k, 0), texture)
    assert_allclose(level_of(pyramids, 0, 1), textures[0].reshape(4, 2, 8, 2, 3).mean(axis=(1, 3)), atol=0.5 + 1e-6)
    # An odd size halves to the integer below, and the average over the texture is kept.
    assert level_of(pyramids, 2, 1).shape == (2, 1, 3)
    assert_allclose(level_of(pyramids, 2, 1).mean(axis=(0, 1)), textures[2].mean(axis=(0, 1)), atol=1)


def test_texel_gradients_predict_texel_coordinates():
    mesh = random_triangles(0, n_triangles=50)
    gradients = texel_gradients(mesh).astype(np.float64)
    sizes = np.array([(t.shape[1], t.shape[0]) for t in mesh.textures])[mesh.triangle_texture]
    corners = mesh.vertices[mesh.triangles].astype(np.float64)
    rng = np.random.default_rng(1)
    for weights in rng.dirichlet((1, 1, 1), 5):
        step = np.einsum("c,tcd->td", weights, corners) - corners[:, 0]
        expected = (np.einsum("c,tcd->td", weights, mesh.corner_uvs) - mesh.corner_uvs[:, 0]) * sizes
        assert_allclose(np.einsum("tij,tj->ti", gradients, step), expected, rtol=1e-3, atol=1e-2)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across = np.einsum("tij,tj->ti", gradients, normals) / np.linalg.norm(normals, axis=1)[:, None]
    assert np.abs(across).max() < 1e-3 * np.abs(gradients).max()
