"""Cut a mesh by a horizontal plane."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.mesh import TexturedMesh


def cut_above(mesh: TexturedMesh, height_m: float) -> TexturedMesh:
    """Return the part of a mesh at or below a world height; triangles that reach above it are cut."""
    height_m -= float(mesh.origin[2])
    below = mesh.vertices[mesh.triangles][..., 2] <= height_m
    n_below = below.sum(1)
    whole = n_below == 3
    rows = np.flatnonzero((n_below == 1) | (n_below == 2))
    # In each cut triangle, the corner that is the only one on its side of the plane comes first.
    lone = np.where(n_below[rows] == 1, below[rows].argmax(1), (~below[rows]).argmax(1))
    order = (lone[:, None] + np.arange(3)) % 3
    corners = np.take_along_axis(mesh.triangles[rows], order, axis=1)
    uvs = np.take_along_axis(mesh.corner_uvs[rows], order[:, :, None], axis=1)

    # Where the two edges from that corner meet the plane, as shares of their lengths (2, n, 1).
    z = mesh.vertices[corners, 2].astype(np.float64)
    along = ((height_m - z[:, :1]) / (z[:, 1:] - z[:, :1])).T[..., None]
    cut_uvs = (1 - along) * uvs[:, 0] + along * uvs[:, 1:].swapaxes(0, 1)
    on_second, on_third = len(mesh.vertices) + np.arange(2 * len(rows)).reshape(2, -1)

    def with_cuts(values: NDArray[Any]) -> NDArray[Any]:
        """Append the values of the new vertices on the plane."""
        new = (1 - along) * values[corners[:, 0]] + along * values[corners[:, 1:].T]
        return np.concatenate([values, new.reshape(-1, values.shape[1]).astype(values.dtype)])

    first, second, third = corners.T
    tip = n_below[rows] == 1
    trunk = n_below[rows] == 2
    pieces = [
        (tip, (first, on_second, on_third), (uvs[:, 0], cut_uvs[0], cut_uvs[1])),
        (trunk, (second, third, on_third), (uvs[:, 1], uvs[:, 2], cut_uvs[1])),
        (trunk, (second, on_third, on_second), (uvs[:, 1], cut_uvs[1], cut_uvs[0])),
    ]
    triangles = [mesh.triangles[whole], *(np.stack(at, axis=1)[keep] for keep, at, _ in pieces)]
    corner_uvs = [mesh.corner_uvs[whole], *(np.stack(at, axis=1)[keep] for keep, _, at in pieces)]
    texture = [mesh.triangle_texture[whole], *(mesh.triangle_texture[rows[keep]] for keep, _, _ in pieces)]
    cut = TexturedMesh(
        with_cuts(mesh.vertices),
        np.concatenate(triangles).astype(np.int32),
        np.concatenate(corner_uvs).astype(np.float32),
        np.concatenate(texture),
        mesh.textures,
        None if mesh.vertex_colors is None else with_cuts(mesh.vertex_colors),
        mesh.origin,
    )
    return cut.only(np.full(len(cut.triangles), True))
