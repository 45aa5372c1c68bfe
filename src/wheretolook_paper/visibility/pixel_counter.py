"""Counts distinct pixels with a landmark, the rule of the paper's released code."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera import Camera, PinholeCamera
from wheretolook.geometry.poses import Float
from wheretolook.visibility import frustum
from wheretolook.visibility.counting import FrustumCounter
from wheretolook_paper.visibility import pixel_kernel


class PixelCounter(FrustumCounter):
    """Counts the pixels on which at least one landmark falls, for use with `SurveyOptions.counter`.

    `scratch_bytes` bounds the bitmaps of pixels. COLMAP cameras are counted in NumPy, thousands of times slower.
    """

    def __init__(self, camera: Camera, rotations: Float, n_points: int, device: str = "cpu", **options: Any) -> None:
        super().__init__(camera, rotations, n_points, device, **options)
        wp.load_module(pixel_kernel, device=self.device)  # only one thread may do that

    @property
    def fixed_bytes(self) -> int:
        """Memory in bytes that `count` takes for any number of locations."""
        return self.scratch_bytes

    def count(self, locations: ArrayLike, points: Any, unoccluded: Any | None = None) -> Any:
        """Count pixels (L, D), as `FrustumCounter.count` counts landmarks."""
        if isinstance(self.camera, PinholeCamera):
            return super().count(locations, points, unoccluded)
        at = np.asarray(locations, dtype=np.float64).reshape(-1, 3)
        mask = np.ones((len(at), points.shape[0]), bool) if unoccluded is None else unoccluded.numpy()
        counts = count_pixels_plain(self.camera, self.rotations, at, points.numpy(), mask)
        return wp.array(counts, dtype=wp.int32, device=self.device)

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


def count_pixels_plain(
    camera: Camera, rotations: ArrayLike, locations: ArrayLike, points: ArrayLike, unoccluded: NDArray[np.bool_]
) -> NDArray[np.int32]:
    """Count pixels (L, D) with unoccluded (L, N) points (N, 3), in NumPy."""
    axes = np.asarray(rotations)
    positions = np.asarray(points)
    counts = np.zeros((len(unoccluded), len(axes)), dtype=np.int32)
    for row, location in enumerate(np.asarray(locations)):
        offsets = frustum.offsets_from(location, positions[unoccluded[row]])
        seen = frustum.in_view(camera, axes, offsets)
        for orientation, rotation in enumerate(axes.astype(np.float32)):
            pixels = np.floor(frustum.pixels_of(camera, frustum.rotate(rotation, offsets[seen[orientation]])))
            column, line = np.clip(pixels, 0, (camera.width - 1, camera.height - 1)).T
            counts[row, orientation] = len(np.unique(line * camera.width + column))
    return counts
