"""What every renderer takes and returns."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera import Camera, PinholeCamera
from wheretolook.geometry.poses import Float


class Rendering:
    """Images of a batch of B poses.

    Attributes:
        rgb: (B, H, W, 3) uint8 sRGB; black where the ray through the pixel's centre meets nothing.
        depth_m: (B, H, W) float32 z-depth along the optical axis in metres; 0 where the ray meets nothing. May be given
            as a function, which copies it from a GPU when it is first used.
    """

    def __init__(
        self, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32] | Callable[[], NDArray[np.float32]]
    ) -> None:
        self.rgb = rgb
        self._depth_m = depth_m

    @cached_property
    def depth_m(self) -> NDArray[np.float32]:
        return self._depth_m() if callable(self._depth_m) else self._depth_m


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
