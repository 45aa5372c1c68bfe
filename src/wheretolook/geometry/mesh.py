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
