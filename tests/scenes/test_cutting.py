"""A mesh cut by a level plane keeps what is below, with its textures."""

from dataclasses import replace

import numpy as np
import pytest

from box_scenes import box_quads, quads_mesh, random_texture, random_triangles
from wheretolook.geometry.mesh import cut_above
from wheretolook.rendering.raycasting import MeshRaycaster


def areas(mesh):
    return np.linalg.norm(mesh.normals, axis=1) / 2


def integrals(mesh):
    """Of 1, u and v over the triangles of each texture."""
    values = np.column_stack([np.ones(len(mesh.triangles)), mesh.corner_uvs.mean(axis=1)]) * areas(mesh)[:, None]
    return np.array([values[mesh.triangle_texture == texture].sum(axis=0) for texture in range(len(mesh.textures))])


def test_cutting_a_box_leaves_walls_of_the_height():
    mesh = quads_mesh(box_quads((0, 0, 0), (2, 3, 4)), [random_texture(np.random.default_rng(0), 8, 8)])
    cut = cut_above(mesh, 1.0)
    assert cut.bounds[1, 2] == pytest.approx(1.0)
    assert areas(cut).sum() == pytest.approx(2 * 3 + 2 * (2 + 3) * 1.0)
    assert len(cut.corner_uvs) == len(cut.triangles) == len(cut.triangle_texture)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_cut_changes_nothing_below_it(seed):
    mesh = random_triangles(seed)
    cut = cut_above(mesh, 0.3)
    assert cut.vertices[cut.triangles][..., 2].max() <= 0.3 + 1e-5
    assert (mesh.vertex_colors is None) == (cut.vertex_colors is None)
    assert MeshRaycaster(mesh).distance_to_surface(cut.vertices, 1.0).max() < 1e-4
    # Both sides of the cut together are the whole: the part above is the mirrored mesh's part below. Texture
    # coordinates, which are linear on each triangle, have the same integrals over each texture.
    above = cut_above(replace(mesh, vertices=mesh.vertices * np.float32([1, 1, -1])), -0.3)
    np.testing.assert_allclose(integrals(cut) + integrals(above), integrals(mesh), rtol=1e-4, atol=1e-3)
