"""What every renderer takes and returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera import Camera, PinholeCamera
from wheretolook.geometry.poses import Float


@dataclass(frozen=True, eq=False)
class Rendering:
    """Images of a batch of B poses."""

    rgb: NDArray[np.uint8]  # (B, H, W, 3) sRGB; black where the ray through the pixel's centre meets nothing
    depth_m: NDArray[np.float32]  # (B, H, W) z-depth along the optical axis in metres; 0 where the ray meets nothing


class Renderer(Protocol):
    """Renders a fixed mesh.

    Images are unlit, because light is baked into the textures of scanned and generated scenes: they show the texture's
    stored colour times the vertex colour, from both sides of a triangle.
    """

    def render(self, camera: Camera, cam_from_world: ArrayLike) -> Rendering:
        """Render the poses `cam_from_world` (B, 3, 4) with one camera. Raises ValueError on another shape or NaN."""
        ...


def camera_rays(camera: PinholeCamera, cam_from_world: Float) -> tuple[Float, Float]:
    """Camera centres (B, 3) and matrices (B, 3, 3) that turn a pixel (x, y, 1) into its ray's direction in the world.

    A direction has length 1 along the optical axis, so the ray parameter of a hit is its z-depth, and the first two
    columns of the matrix are the derivatives of the direction by the pixel's x and y.
    """
    rotation = np.swapaxes(cam_from_world[:, :, :3], 1, 2)
    centers = -(rotation @ cam_from_world[:, :, 3:])[..., 0]
    return centers, rotation @ np.linalg.inv(camera.matrix)
