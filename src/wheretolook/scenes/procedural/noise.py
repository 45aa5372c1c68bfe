"""Tileable random fields that every painted surface crops from, and the canvas a surface is painted on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.floating[Any]]

SIZE = 1024


class NoiseBank:
    """Zero-mean, unit-variance fields (1024, 1024) that repeat without a seam.

    `cloud` is broad (many octaves, amplitude 1/f^1.6), `fine` is white noise slightly blurred, `grain` is stretched
    along x as wood is, `veins` has thin ridges as marble has.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        fy = np.fft.fftfreq(SIZE)[:, None] * SIZE
        fx = np.fft.rfftfreq(SIZE)[None, :] * SIZE

        def field(amplitude: Image) -> Image:
            spectrum = np.fft.rfft2(rng.standard_normal((SIZE, SIZE)).astype(np.float32))
            values = np.fft.irfft2(spectrum * amplitude, s=(SIZE, SIZE))
            values -= values.mean()
            return (values / values.std()).astype(np.float32)

        radius = np.maximum(np.hypot(fx, fy), 1.0)
        stretched = np.maximum(np.hypot(20 * fx, fy), 12.0)
        low_pass = np.exp(-((radius / 330) ** 2))
        self.cloud = field(radius**-1.6)
        self.fine = field(low_pass)
        self.grain = field(stretched**-0.75 * low_pass)
        ridges = np.exp(-((field(radius**-1.9) / 0.06) ** 2))
        self.veins = ((ridges - ridges.mean()) / ridges.std()).astype(np.float32)


@dataclass(frozen=True)
class Canvas:
    """The size, scale and origin of the image that a painter makes, and the noise it can use.

    Attributes:
        height, width: of the image in texels.
        texels_per_m: texels per metre.
        x_m, y_m: metres from the pattern's origin to the left and to the top edge.
        noise: the fields to crop from.
    """

    height: int
    width: int
    texels_per_m: float
    x_m: float
    y_m: float
    noise: NoiseBank

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in texels."""
        return self.height, self.width

    @property
    def x(self) -> Image:
        """Metres right of the pattern's origin at texel centres, (1, width)."""
        return (self.x_m + (np.arange(self.width, dtype=np.float32) + 0.5) / self.texels_per_m)[None, :]

    @property
    def y(self) -> Image:
        """Metres below the pattern's origin at texel centres, (height, 1)."""
        return (self.y_m + (np.arange(self.height, dtype=np.float32) + 0.5) / self.texels_per_m)[:, None]

    @property
    def unit_x(self) -> Image:
        """0 to 1 over the surface, (1, width)."""
        return ((np.arange(self.width, dtype=np.float32) + 0.5) / self.width)[None, :]

    @property
    def unit_y(self) -> Image:
        """0 to 1 over the surface, (height, 1)."""
        return ((np.arange(self.height, dtype=np.float32) + 0.5) / self.height)[:, None]

    def crop(self, field: Image, shift: tuple[int, int] = (0, 0), step: int = 1, upright: bool = False) -> Image:
        """Window (height, width) on a field of the bank; `step` skips texels (finer), `upright` turns it by 90 deg."""
        row = round(self.y_m * self.texels_per_m) + shift[0]
        column = round(self.x_m * self.texels_per_m) + shift[1]
        rows = ((np.arange(self.height) + row) * step) % SIZE
        columns = ((np.arange(self.width) + column) * step) % SIZE
        return field[np.ix_(columns, rows)].T if upright else field[np.ix_(rows, columns)]
