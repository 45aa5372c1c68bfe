"""Textures as one flat buffer of mip pyramids, and the texel density of each triangle."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.utils.errors import SceneError

# Up to this ratio of a pixel footprint's axes, several samples along the long axis replace a coarser mip level. 8 keeps
# floors and walls sharp that are seen at a slant.
MAX_ANISOTROPY = 8


@dataclass(frozen=True, eq=False)
class TexturePyramids:
    """The mip pyramids of all textures of a mesh.

    Each level is the box average of the level below it, taken of the stored sRGB values. Averaging linear light would
    be closer to a sensor, but Open3D and Habitat's unlit shader filter in sRGB too, and SIFT builds its scale space in
    it: a surface seen from afar then gives the same descriptor as the surface seen from near and blurred. It also needs
    no decoding per sample. Level l is max(1, width >> l) x max(1, height >> l).
    """

    texels: NDArray[np.uint32]  # (S,) red in the lowest byte, rows top to bottom, level by level, texture by texture
    level_start: NDArray[np.int32]  # (K, L) index in `texels` where level l of texture k starts
    size: NDArray[np.int32]  # (K, 3) width and height of level 0 and the number of levels


def build_pyramids(textures: tuple[NDArray[np.uint8], ...]) -> TexturePyramids:
    """Mip pyramids of textures (H, W, 3) uint8. Raises SceneError beyond 2^31 texels in all (8 GB)."""
    sizes = [
        [(max(1, t.shape[0] >> level), max(1, t.shape[1] >> level)) for level in range(max(t.shape[:2]).bit_length())]
        for t in textures
    ]
    n_texels = sum(height * width for levels in sizes for height, width in levels)
    if n_texels >= 2**31:
        raise SceneError(
            "the textures are too large", value=f"{n_texels} texels", fix="Downscale them below 2^31 in all"
        )
    texels = np.zeros((n_texels, 4), dtype=np.uint8)
    level_start = np.zeros((len(textures), max(map(len, sizes))), dtype=np.int32)
    start = 0
    for k, (image, levels) in enumerate(zip(textures, sizes, strict=True)):
        for level, (height, width) in enumerate(levels):
            if level > 0:
                image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
            level_start[k, level] = start
            texels[start : start + width * height, :3] = image.reshape(-1, 3)
            start += width * height
    size = np.array([(*levels[0][::-1], len(levels)) for levels in sizes], dtype=np.int32)
    return TexturePyramids(texels.view("<u4").reshape(-1).astype(np.uint32, copy=False), level_start, size)


def texel_gradients(mesh: TexturedMesh) -> NDArray[np.float32]:
    """Gradients of texel x and y by the position on each triangle, (T, 2, 3) float32 in texels per metre.

    A step of `d` metres (3,) within the plane of triangle t moves by `gradients[t] @ d` texels. Zero on triangles
    without area.
    """
    corners = mesh.vertices[mesh.triangles].astype(np.float64)
    edges = corners[:, 1:] - corners[:, :1]  # (T, 2 edges, 3)
    sizes = np.array([(texture.shape[1], texture.shape[0]) for texture in mesh.textures], dtype=np.float64)
    texels = mesh.corner_uvs.astype(np.float64) * sizes[mesh.triangle_texture][:, None]
    changes = texels[:, 1:] - texels[:, :1]  # (T, 2 edges, 2)
    # The gradient g is in the plane and satisfies edges @ g = changes: g = edges^T (edges edges^T)^-1 changes.
    gram = edges @ np.swapaxes(edges, 1, 2)
    determinant = gram[:, 0, 0] * gram[:, 1, 1] - gram[:, 0, 1] ** 2
    flat = determinant <= 1e-12 * (gram[:, 0, 0] + gram[:, 1, 1]) ** 2
    adjugate = gram[:, ::-1, ::-1] * ((1, -1), (-1, 1))  # of a symmetric matrix
    inverse = adjugate / np.where(flat, 1.0, determinant)[:, None, None]
    gradients = np.swapaxes(changes, 1, 2) @ inverse @ edges
    gradients[flat] = 0.0
    return gradients.astype(np.float32)
