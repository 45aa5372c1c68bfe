"""Counts distinct pixels with a landmark, the rule of the paper's released code."""

from __future__ import annotations

from typing import Any

import warp as wp

from wheretolook.geometry.camera import Camera, PinholeCamera
from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import ConfigError
from wheretolook.visibility import frustum
from wheretolook.visibility.counting import FrustumCounter
from wheretolook_paper.visibility import pixel_kernel


class PixelCounter(FrustumCounter):
    """Counts the pixels on which at least one landmark falls, for use with `SurveyOptions.counter`.

    `scratch_bytes` bounds the bitmaps of pixels. Raises ConfigError for a camera that is not a pinhole.
    """

    def __init__(self, camera: Camera, rotations: Float, n_points: int, device: str = "cpu", **options: Any) -> None:
        super().__init__(camera, rotations, n_points, device, **options)
        if not isinstance(camera, PinholeCamera):
            raise ConfigError("pixels are counted of pinhole cameras only", value=camera)
        wp.load_module(pixel_kernel, device=self.device)  # only one thread may do that

    @property
    def fixed_bytes(self) -> int:
        """Memory in bytes that `count` takes for any number of locations."""
        return self.scratch_bytes

    def _count_sorted(self, landmarks: Any, counts: Any) -> Any:
        camera = self.camera
        assert isinstance(camera, PinholeCamera)
        n_views = counts.shape[0] * counts.shape[1]
        words = (camera.width * camera.height + 31) // 32
        block = min(n_views, max(1, self.scratch_bytes // (words * 4)))
        bits: Any = wp.empty((block, words), dtype=wp.uint32, device=self.device)
        pinhole = [wp.vec2d(camera.fx, camera.fy), wp.vec2d(camera.cx, camera.cy)]
        inputs = [self._sides, self._axes, landmarks, *pinhole, camera.width, camera.height, frustum.MIN_DEPTH_M]
        for first in range(0, n_views, block):
            bits.zero_()
            shape = (min(block, n_views - first), self.lanes)
            views = [*inputs, first, self.lanes]
            wp.launch(pixel_kernel.count_pixels_kernel, shape, views, [bits, counts], device=self.device)
        return counts
