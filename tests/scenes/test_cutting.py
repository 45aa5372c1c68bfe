"""A mesh cut by a level plane keeps what is below, with its textures."""

from dataclasses import replace

import numpy as np
import pytest

from box_scenes import box_quads, quads_mesh, random_texture, random_triangles
from wheretolook.geometry.mesh import cut_above
from wheretolook.rendering.raycasting import MeshRaycaster


def areas(mesh):
    return np.linalg.norm(mesh.normals, axis=1) / 2


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
    # both sides of the cut together are the whole: the part above is the mirrored mesh's part below
    mirrored = replace(mesh, vertices=mesh.vertices * np.float32([1, 1, -1]))
    assert areas(cut).sum() + areas(cut_above(mirrored, -0.3)).sum() == pytest.approx(areas(mesh).sum(), rel=1e-5)
    # texture coordinates go along: linear in the position on each triangle, as they were
    rng = np.random.default_rng(0)
    rows = rng.integers(0, len(cut.triangles), 60)
    weights = rng.dirichlet(np.ones(3), 60)
    points = np.einsum("nc,ncd->nd", weights, cut.vertices[cut.triangles[rows]])
    uvs = np.einsum("nc,ncd->nd", weights, cut.corner_uvs[rows])
    whole = MeshRaycaster(mesh)
    assert whole.distance_to_surface(points, 1.0).max() < 1e-4
    for point, uv, texture in zip(points, uvs, cut.triangle_texture[rows], strict=True):
        candidates = np.flatnonzero(mesh.triangle_texture == texture)
        assert min(_uv_error(mesh, number, point, uv) for number in candidates) < 1e-3


def _uv_error(mesh, number, point, uv):
    a, b, c = mesh.vertices[mesh.triangles[number]].astype(np.float64)
    solved, *_ = np.linalg.lstsq(np.column_stack([b - a, c - a]), point - a, rcond=None)
    off_plane = np.linalg.norm(a + np.column_stack([b - a, c - a]) @ solved - point)
    u0, u1, u2 = mesh.corner_uvs[number]
    return float(np.abs(u0 + solved[0] * (u1 - u0) + solved[1] * (u2 - u0) - uv).max() + off_plane)
