"""The textured triangle mesh that every scene is, whether loaded or generated."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.similarity import Similarity


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """Triangles with textures, in metres, z up.

    Of `corner_uvs`, (0, 0) is the outer corner of the texture's top-left pixel, u right, v down (glTF); values outside
    [0, 1] repeat the texture.
    """

    vertices: NDArray[np.float32]  # (V, 3) metres from `origin`
    triangles: NDArray[np.int32]  # (T, 3), counter-clockwise seen from the front
    corner_uvs: NDArray[np.float32]  # (T, 3, 2)
    triangle_texture: NDArray[np.int32]  # (T,) index into `textures`
    textures: tuple[NDArray[np.uint8], ...]  # each (H, W, 3), sRGB
    vertex_colors: NDArray[np.uint8] | None = None  # (V, 3), multiply the texture; None for white
    # (3,) metres in the world, from which single precision measures, see `wheretolook.geometry.similarity`
    origin: NDArray[np.floating[Any]] = field(default_factory=lambda: np.zeros(3))

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner of the vertices in the world, (2, 3) metres."""
        return np.stack([self.vertices.min(0), self.vertices.max(0)]).astype(np.float64) + self.origin

    @property
    def normals(self) -> NDArray[np.float64]:
        """Normals of the triangles (T, 3), towards the front, as long as twice the triangle's area."""
        a, b, c = np.moveaxis(self.vertices[self.triangles].astype(np.float64), 1, 0)
        return np.cross(b - a, c - a)

    def transformed(self, similarity: Similarity) -> TexturedMesh:
        """The mesh in another frame."""
        vertices = (similarity.scale * self.vertices @ similarity.rotation.T).astype(np.float32)
        return replace(self, vertices=vertices, origin=similarity.apply(self.origin))

    def only(self, keep: NDArray[np.bool_]) -> TexturedMesh:
        """The mesh with only some of its triangles, (T,) bool, and the vertices that they use."""
        used, triangles = np.unique(self.triangles[keep], return_inverse=True)
        return replace(
            self,
            vertices=self.vertices[used],
            triangles=triangles.reshape(-1, 3).astype(np.int32),
            corner_uvs=self.corner_uvs[keep],
            triangle_texture=self.triangle_texture[keep],
            vertex_colors=None if self.vertex_colors is None else self.vertex_colors[used],
        )


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
