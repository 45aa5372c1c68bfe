"""The textured triangle mesh that every scene is, whether loaded or generated."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """Triangles with textures, in metres, z up.

    Attributes:
        vertices: (V, 3) float32, world coordinates in metres.
        triangles: (T, 3) int32, counter-clockwise seen from the front.
        corner_uvs: (T, 3, 2) float32. (0, 0) is the outer corner of the texture's top-left pixel, u right, v down
            (glTF); values outside [0, 1] repeat the texture.
        triangle_texture: (T,) int32, index into `textures`.
        textures: each (H, W, 3) uint8, sRGB.
        vertex_colors: (V, 3) uint8 that multiply the texture, or None for white.
    """

    vertices: NDArray[np.float32]
    triangles: NDArray[np.int32]
    corner_uvs: NDArray[np.float32]
    triangle_texture: NDArray[np.int32]
    textures: tuple[NDArray[np.uint8], ...]
    vertex_colors: NDArray[np.uint8] | None = None

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner of the vertices, (2, 3) metres."""
        return np.stack([self.vertices.min(0), self.vertices.max(0)]).astype(np.float64)

    @property
    def normals(self) -> NDArray[np.float64]:
        """Normals of the triangles (T, 3), towards the front, as long as twice the triangle's area."""
        a, b, c = np.moveaxis(self.vertices[self.triangles].astype(np.float64), 1, 0)
        return np.cross(b - a, c - a)

    def only(self, keep: NDArray[np.bool_]) -> TexturedMesh:
        """The mesh with only some of its triangles, (T,) bool, and all of its vertices."""
        return replace(
            self,
            triangles=self.triangles[keep],
            corner_uvs=self.corner_uvs[keep],
            triangle_texture=self.triangle_texture[keep],
        )
