"""The Gaussian scale space of many images at once, on a device, and the extrema in it (Lowe, IJCV 2004)."""

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
    Pyramid,
    double_kernel,
    extrema_kernel,
    halve_kernel,
    smooth_columns_kernel,
    smooth_rows_kernel,
)

_ASSUMED_SIGMA = 0.5
"""Blur of an image as it comes, in its pixels."""


class ScaleSpace:
    """The Gaussian scale spaces of images of one size, and the list of their extrema.

    Args:
        rows: of an image. With as many columns, `octave_sizes` must not be empty.
        columns: of an image.
        n_images: for how many there is room.
        first_octave: -1 seeks keypoints in the doubled image too, 0 from the image's own size on.
        limits: `Limits`.
        device: as Warp calls it.
    """

    def __init__(self, rows: int, columns: int, n_images: int, first_octave: int, limits: Any, device: str) -> None:
        self.rows, self.columns, self.n_images, self.device = rows, columns, n_images, device
        self.first_octave, self.limits = first_octave, limits
        self.sizes = octave_sizes(rows, columns)
        starts = np.cumsum([0, *(LEVELS * r * c for r, c in self.sizes)])
        self.image_size = int(starts[-1])
        self.starts = [int(start) for start in starts[:-1]]
        self.pyramid = self._pyramid()
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

    def _pyramid(self) -> Any:
        pyramid: Any = Pyramid()
        pyramid.values = wp.empty(self.n_images * self.image_size, dtype=wp.float32, device=self.device)
        pyramid.image_size = self.image_size
        for name, numbers in (
            ("starts", self.starts),
            ("rows", [rows for rows, _ in self.sizes]),
            ("columns", [columns for _, columns in self.sizes]),
        ):
            setattr(pyramid, name, wp.array(numbers, dtype=wp.int32, device=self.device))
        return pyramid

    def fill(self, grey: Any) -> None:
        """The scale spaces of (B, H, W) uint8 images, in NumPy or Warp, B at most `n_images`."""
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
                wp.launch(
                    extrema_kernel,
                    dim=(self.filled, LAYERS, rows - 2 * BORDER, columns - 2 * BORDER),
                    inputs=[self.pyramid, octave, self.limits],
                    outputs=[self.number, self.keys],
                    device=self.device,
                )
            number = int(self.number.numpy()[0])
            if number <= len(self.keys):
                return self.keys[:number].numpy()
            self.keys = wp.empty(roomy(number), dtype=wp.int64, device=self.device)

    def _record(self) -> list[tuple[Any, tuple[int, int]]]:
        """The launches that fill the scale spaces, and how many threads of each an image has."""
        commands: list[tuple[Any, tuple[int, int]]] = []
        values, image_size = self.pyramid.values, self.image_size

        def add(kernel: Any, octave: int, *inputs: Any) -> None:
            size = self.sizes[octave]
            dim = (self.n_images, *size)
            command = wp.launch(kernel, dim=dim, inputs=list(inputs), device=self.device, record_cmd=True)
            commands.append((command, size))

        def smooth(octave: int, source: int, target: int) -> None:
            """From level to level of an octave, with the filter of the latter."""
            rows, columns = self.sizes[octave]
            start, size, half_size = self.starts[octave], rows * columns, 4 * self.rows * self.columns
            half = [self.weights, self.first_weights[target], self.radii[target]]
            add(
                smooth_rows_kernel, octave, values, image_size, start + source * size, columns, *half,
                self.half_smooth, half_size,
            )  # fmt: skip
            add(
                smooth_columns_kernel, octave, self.half_smooth, half_size, rows, columns, *half,
                values, image_size, start + target * size,
            )  # fmt: skip

        add(double_kernel, 0, self.grey, values, image_size, 0, self.sizes[0][1])
        smooth(0, 0, 0)
        for octave in range(len(self.sizes)):
            if octave > 0:
                rows, columns = self.sizes[octave - 1]
                source = self.starts[octave - 1] + LAYERS * rows * columns
                target, target_columns = self.starts[octave], self.sizes[octave][1]
                add(halve_kernel, octave, values, image_size, source, columns, target, target_columns)
            sought = octave > self.first_octave
            for level in range(1, LEVELS if sought else LAYERS + 1):
                smooth(octave, level - 1, level)
        return commands


def octave_sizes(rows: int, columns: int) -> list[tuple[int, int]]:
    """Rows and columns of the octaves in which a keypoint can be, the first of twice the image's size."""
    sizes = [(2 * rows, 2 * columns)]
    while min(sizes[-1]) > 2 * BORDER:
        sizes.append((sizes[-1][0] // 2, sizes[-1][1] // 2))
    return sizes[:-1]


def values_of_image(rows: int, columns: int) -> int:
    """How many numbers the scale space of an image has."""
    return LEVELS * sum(r * c for r, c in octave_sizes(rows, columns))


def _sigmas() -> list[float]:
    """Standard deviation that each level adds to the one before; the first, to the doubled image."""
    sigma = SIGMA
    total = [sigma * 2 ** (level / LAYERS) for level in range(LEVELS)]
    first = math.sqrt(sigma**2 - (2 * _ASSUMED_SIGMA) ** 2)
    return [first, *(math.sqrt(b**2 - a**2) for a, b in pairwise(total))]


def _half_gaussian(sigma: float) -> NDArray[np.float64]:
    """Weights of a Gaussian filter from its middle outwards, cut where `cv2.GaussianBlur` cuts them."""
    radius = (round(8 * sigma + 1) | 1) // 2
    weights = np.exp(-(np.arange(-radius, radius + 1) ** 2) / (2 * sigma**2))
    return (weights / weights.sum())[radius:]


def roomy(n: int) -> int:
    """At least n, one of few sizes."""
    return 1 << max(10, (n - 1).bit_length())
