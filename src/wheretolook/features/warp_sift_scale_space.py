"""The Gaussian scale spaces of many images on a device, and their extrema (Lowe, IJCV 2004)."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from wheretolook.features.warp_sift_kernels import (
    BORDER,
    LAYERS,
    LEVELS,
    SIGMA,
    Level,
    Pyramid,
    double_kernel,
    extrema_kernel,
    halve_kernel,
    smooth_kernel,
)

_ASSUMED_SIGMA = 0.5  # blur of an input image, in its pixels


class ScaleSpace:
    """The Gaussian scale spaces of up to `n_images` images of one size, and the list of their extrema.

    Args:
        rows: of an image; its smaller side must exceed `BORDER`, so that there is an octave.
        columns: of an image.
        n_images: for how many to make room.
        first_octave: -1 looks for keypoints in the doubled image too, 0 only from the image's own size on.
        limits: `Limits`.
        device: Warp's name of a device.
    """

    def __init__(self, rows: int, columns: int, n_images: int, first_octave: int, limits: Any, device: str) -> None:
        self.rows, self.columns, self.n_images, self.device = rows, columns, n_images, device
        self.first_octave, self.limits = first_octave, limits
        self.sizes = octave_sizes(rows, columns)
        starts = np.cumsum([0, *(LEVELS * r * c for r, c in self.sizes)])
        self.image_size = int(starts[-1])
        self.starts = [int(start) for start in starts[:-1]]
        rows_of, columns_of = ([size[side] for size in self.sizes] for side in (0, 1))
        pyramid: Any = Pyramid()
        pyramid.values = wp.empty(n_images * self.image_size, dtype=wp.float32, device=device)
        pyramid.image_size = self.image_size
        for name, values in (("starts", self.starts), ("rows", rows_of), ("columns", columns_of)):
            setattr(pyramid, name, wp.array(values, dtype=wp.int32, device=device))
        self.pyramid = pyramid
        self.grey = wp.empty((n_images, rows, columns), dtype=wp.uint8, device=device)
        self.half_smooth = wp.empty(n_images * 4 * rows * columns, dtype=wp.float32, device=device)
        self.number = wp.zeros(1, dtype=wp.int32, device=device)
        self.keys = wp.empty(roomy(1000 * n_images), dtype=wp.int64, device=device)
        self.filled = 0
        filters = [_half_gaussian(sigma) for sigma in _sigmas()]
        self.radii = [len(half) - 1 for half in filters]
        self.first_weights = [int(first) for first in np.cumsum([0, *map(len, filters)])]
        self.weights: Any = wp.array(np.concatenate(filters).astype(np.float32), dtype=wp.float32, device=device)
        self._commands = self._record()

    def fill(self, grey: Any) -> None:
        """Compute the scale spaces of images (B, H, W) uint8, in NumPy or Warp, B at most `n_images`."""
        if isinstance(grey, np.ndarray):
            grey = wp.array(np.ascontiguousarray(grey), dtype=wp.uint8, device="cpu", copy=False)
        wp.copy(self.grey, grey.contiguous(), count=grey.size)
        if grey.shape[0] != self.filled:
            self.filled = grey.shape[0]
            for command, size in self._commands:
                command.set_dim((self.filled, *size))
        for command, _ in self._commands:
            command.launch()

    def find(self) -> NDArray[np.int64]:
        """Keys (K,) int64 of the extrema that pass the limits, in any order and with repetitions (see `key_of`)."""
        while True:
            self.number.zero_()
            for octave in range(1 + self.first_octave, len(self.sizes)):
                rows, columns = self.sizes[octave]
                shape = self.filled, LAYERS, rows - 2 * BORDER, columns - 2 * BORDER
                inputs, outputs = [self.pyramid, octave, self.limits], [self.number, self.keys]
                wp.launch(extrema_kernel, shape, inputs, outputs, device=self.device)
            number = int(self.number.numpy()[0])
            if number <= len(self.keys):
                return self.keys[:number].numpy()
            self.keys = wp.empty(roomy(number), dtype=wp.int64, device=self.device)

    def _record(self) -> list[tuple[Any, tuple[int, int]]]:
        """The launches that fill the scale spaces, and how many threads of each work on an image."""
        commands: list[tuple[Any, tuple[int, int]]] = []

        def add(kernel: Any, octave: int, *inputs: Any) -> None:
            size = self.sizes[octave]
            dim = (self.n_images, *size)
            command = wp.launch(kernel, dim=dim, inputs=list(inputs), device=self.device, record_cmd=True)
            commands.append((command, size))

        def level_of(octave: int, level: int, half_smooth: bool = False) -> Any:
            """A level of the pyramid, or the memory for one smoothed along its rows only."""
            found: Any = Level()
            found.rows, found.columns = self.sizes[octave]
            if half_smooth:
                found.values, found.image_size, found.start = self.half_smooth, 4 * self.rows * self.columns, 0
            else:
                found.values, found.image_size = self.pyramid.values, self.image_size
                found.start = self.starts[octave] + level * found.rows * found.columns
            return found

        def smooth(octave: int, source: int, target: int) -> None:
            """From level to level of an octave, with the filter of the latter."""
            filter_of_target = [self.weights, self.first_weights[target], self.radii[target]]
            half = level_of(octave, 0, half_smooth=True)
            add(smooth_kernel, octave, level_of(octave, source), half, True, *filter_of_target)
            add(smooth_kernel, octave, half, level_of(octave, target), False, *filter_of_target)

        add(double_kernel, 0, self.grey, level_of(0, 0))
        smooth(0, 0, 0)
        for octave in range(len(self.sizes)):
            if octave > 0:
                add(halve_kernel, octave, level_of(octave - 1, LAYERS), level_of(octave, 0))
            searched = octave > self.first_octave
            for level in range(1, LEVELS if searched else LAYERS + 1):
                smooth(octave, level - 1, level)
        return commands


def octave_sizes(rows: int, columns: int) -> list[tuple[int, int]]:
    """Rows and columns of the octaves that can hold a keypoint; the first has twice the image's size."""
    sizes = [(2 * rows, 2 * columns)]
    while min(sizes[-1]) > 2 * BORDER:
        sizes.append((sizes[-1][0] // 2, sizes[-1][1] // 2))
    return sizes[:-1]


def values_of_image(rows: int, columns: int) -> int:
    """How many values the scale space of an image has."""
    return LEVELS * sum(r * c for r, c in octave_sizes(rows, columns))


def _sigmas() -> list[float]:
    """Standard deviation of the filter that makes each level from the one before, the first from the doubled image."""
    sigma = SIGMA
    total = [sigma * 2 ** (level / LAYERS) for level in range(LEVELS)]
    first = math.sqrt(sigma**2 - (2 * _ASSUMED_SIGMA) ** 2)
    return [first, *(math.sqrt(b**2 - a**2) for a, b in pairwise(total))]


def _half_gaussian(sigma: float) -> NDArray[np.float64]:
    """Weights of a Gaussian filter from its middle outwards, truncated where `cv2.GaussianBlur` does."""
    radius = (round(8 * sigma + 1) | 1) // 2
    weights = np.exp(-(np.arange(-radius, radius + 1) ** 2) / (2 * sigma**2))
    return (weights / weights.sum())[radius:]


def roomy(n: int) -> int:
    """A power of two of at least n, so that buffers have few different sizes."""
    return 1 << max(10, (n - 1).bit_length())
