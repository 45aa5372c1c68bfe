"""Mip pyramids and texel gradients against averages and differences taken by hand."""

import numpy as np

from box_scenes import random_texture, random_triangles
from wheretolook.rendering.warp_renderer import build_pyramids, texel_gradients


def level_of(pyramids, texture, level):
    width, height = np.maximum(1, pyramids.size[texture, :2] >> level)
    start = pyramids.level_start[texture, level]
    texels = pyramids.texels[start : start + width * height].reshape(height, width)
    return np.stack([texels >> shift & 255 for shift in (0, 8, 16)], axis=-1)


def test_pyramids_of_several_textures():
    rng = np.random.default_rng(0)
    textures = (random_texture(rng, 8, 16), random_texture(rng, 1, 1), random_texture(rng, 5, 3))
    pyramids = build_pyramids(textures)
    np.testing.assert_array_equal(pyramids.size, [[16, 8, 5], [1, 1, 1], [3, 5, 3]])
    for k, texture in enumerate(textures):
        np.testing.assert_array_equal(level_of(pyramids, k, 0), texture)
    np.testing.assert_allclose(
        level_of(pyramids, 0, 1), textures[0].reshape(4, 2, 8, 2, 3).mean(axis=(1, 3)), atol=0.5 + 1e-6
    )
    # An odd size halves to the integer below, and the average over the texture is kept.
    assert level_of(pyramids, 2, 1).shape == (2, 1, 3)
    np.testing.assert_allclose(level_of(pyramids, 2, 1).mean(axis=(0, 1)), textures[2].mean(axis=(0, 1)), atol=1)


def test_texel_gradients_predict_texel_coordinates():
    mesh = random_triangles(0, n_triangles=50)
    gradients = texel_gradients(mesh).astype(np.float64)
    sizes = np.array([(t.shape[1], t.shape[0]) for t in mesh.textures])[mesh.triangle_texture]
    corners = mesh.vertices[mesh.triangles].astype(np.float64)
    rng = np.random.default_rng(1)
    for weights in rng.dirichlet((1, 1, 1), 5):
        step = np.einsum("c,tcd->td", weights, corners) - corners[:, 0]
        expected = (np.einsum("c,tcd->td", weights, mesh.corner_uvs) - mesh.corner_uvs[:, 0]) * sizes
        np.testing.assert_allclose(np.einsum("tij,tj->ti", gradients, step), expected, rtol=1e-3, atol=1e-2)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across = np.einsum("tij,tj->ti", gradients, normals) / np.linalg.norm(normals, axis=1)[:, None]
    assert np.abs(across).max() < 1e-3 * np.abs(gradients).max()
