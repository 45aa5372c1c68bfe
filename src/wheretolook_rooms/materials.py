"""Surfaces that can be painted at any size: plaster, wood, planks, tiles, wallpaper, fabric, marble.

A painter fills a `Canvas` with albedo in display space (sRGB, 0 to 1), and crops from tileable random fields. The
contrast of plain surfaces is too low for a feature detector. Tiles and wallpaper repeat exactly, because that is what
makes real homes ambiguous.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Colour = tuple[float, float, float]
Image = NDArray[np.floating[Any]]

SIZE = 1024  # of the fields of noise


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
    """The size, scale and origin of the image that a painter makes, and the noise it can use."""

    height: int  # of the image in texels
    width: int
    texels_per_m: float
    x_m: float  # from the pattern's origin to the left edge
    y_m: float  # from the pattern's origin to the top edge
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


@dataclass(frozen=True, eq=False)
class Material:
    """How a surface looks."""

    paint: Callable[[Canvas], Image]  # fills a canvas: (height, width, 3) float32, sRGB albedo in 0 to 1
    emissive: bool = False  # shown as painted, without baked light (window panes, lamp shades)
    shared: bool = False  # all patches share one small piece of texture in a few brightness levels (leaves, covers)
    casts_shadow: bool = True


def mix(a: ArrayLike, b: ArrayLike, amount: Image) -> Image:
    """Colours (3,), or images (H, W, 3), blended by amount (H, W): 0 for `a`, 1 for `b`."""
    first = np.asarray(a, np.float32)
    second = np.asarray(b, np.float32)
    return first + (second - first) * np.asarray(amount, np.float32)[..., None]


def vary(rng: np.random.Generator, colour: ArrayLike, amount: float = 0.04) -> Colour:
    """Colour near the given one: lighter or darker, with a slight change of hue."""
    r, g, b = np.clip(np.asarray(colour, float) + amount * (rng.normal() + 0.35 * rng.normal(size=3)), 0.02, 0.96)
    return float(r), float(g), float(b)


def fill(canvas: Canvas, colour: ArrayLike) -> Image:
    """Image (height, width, 3) of one colour."""
    return np.broadcast_to(np.asarray(colour, np.float32), (*canvas.shape, 3)).copy()


def _shift(rng: np.random.Generator) -> tuple[int, int]:
    """Where to crop a noise field: a random row and column."""
    a, b = rng.integers(0, SIZE, 2)
    return int(a), int(b)


def line(distance_px: Image, width_px: float) -> Image:
    """How much of each texel a line covers, 0 to 1, from the texel's distance to the middle of the line."""
    return np.clip(width_px / 2 + 0.5 - np.abs(distance_px), 0, min(1.0, width_px))


def plain(
    rng: np.random.Generator, colour: ArrayLike, *, mottle: float = 0.003, speckle: float = 0.0, shared: bool = False
) -> Material:
    """Paint, plaster, plastic, ceramic: one colour with faint broad clouds and, if asked for, fine speckle."""
    base = np.asarray(colour, np.float32)
    first = _shift(rng)
    second = _shift(rng)

    def paint(canvas: Canvas) -> Image:
        tone = 1 + mottle * canvas.crop(canvas.noise.cloud, first)
        if speckle:
            tone = tone + speckle * canvas.crop(canvas.noise.fine, second)
        return base * tone[..., None]

    return Material(paint, shared=shared)


def wood(rng: np.random.Generator, colour: ArrayLike, contrast: float = 1.0, *, shared: bool = False) -> Material:
    """Wood with its grain along the longer edge."""
    shift = _shift(rng)
    dark = np.asarray(colour, float) * np.array([0.62, 0.55, 0.5])

    def paint(canvas: Canvas) -> Image:
        upright = canvas.height > canvas.width
        value = 0.26 * canvas.crop(canvas.noise.grain, shift, upright=upright)
        value = 0.35 + contrast * (value + 0.05 * canvas.crop(canvas.noise.fine, shift))
        return mix(colour, dark, np.clip(value, 0, 1))

    return Material(paint, shared=shared)


def planks(
    rng: np.random.Generator, colour: ArrayLike, width_m: float, length_m: float, contrast: float, along_x: bool
) -> Material:
    """Floor of boards, each with its own tone and its own piece of grain, staggered from row to row."""
    dark = np.asarray(colour, float) * np.array([0.6, 0.53, 0.47])
    tone = rng.normal(0, 1, (64, 64)).astype(np.float32)
    jump = rng.integers(0, SIZE, (64, 64))
    stagger = rng.random(64).astype(np.float32)

    def paint(canvas: Canvas) -> Image:
        scale = canvas.texels_per_m
        along, across = (canvas.x, canvas.y) if along_x else (canvas.y, canvas.x)
        row = np.floor(across / width_m).astype(int)
        position = along / length_m + stagger[row % 64]
        column = np.floor(position).astype(int)
        cell = (row % 64, column % 64)
        a = ((along * scale).astype(int) + jump[cell]) % SIZE
        b = ((across * scale).astype(int) + 7 * jump[cell]) % SIZE
        value = 0.3 + contrast * (0.17 * canvas.noise.grain[b, a] + 0.11 * tone[cell])
        across_px = (across / width_m - np.round(across / width_m)) * width_m * scale
        along_px = (position - np.round(position)) * length_m * scale
        seam = np.maximum(line(across_px, 0.6), line(along_px, 0.6)) * min(1.0, 0.5 + 0.5 * contrast)
        return mix(colour, dark, np.clip(value, 0, 1)) * (1 - 0.45 * seam)[..., None]

    return Material(paint)


def tiles(
    rng: np.random.Generator,
    colour: ArrayLike,
    grout: ArrayLike,
    *,
    size_m: tuple[float, float],
    second: ArrayLike | None = None,
    veins: float = 0.0,
    variation: float = 0.004,
    brick: bool = False,
    decor_every: int = 0,
) -> Material:
    """Tiles with grout and the same veins on each; `second` makes a chequerboard, each `decor_every`-th has a print."""
    petals = int(rng.integers(4, 9))
    ink = vary(rng, (0.35, 0.42, 0.50), 0.12)
    shift = _shift(rng)
    tone = rng.normal(0, variation, (16, 16)).astype(np.float32)
    width, height = size_m

    def paint(canvas: Canvas) -> Image:
        scale = canvas.texels_per_m
        row_position = canvas.y / height
        row = np.floor(row_position).astype(int)
        column_position = canvas.x / width + (0.5 * (row % 2) if brick else 0)
        column = np.floor(column_position).astype(int)
        albedo = fill(canvas, colour)
        if second is not None:
            albedo = mix(colour, second, np.broadcast_to((row + column) % 2, canvas.shape))
        factor = 1 + np.broadcast_to(tone[row % 16, column % 16], canvas.shape)
        if veins:
            a = (((column_position - column) * width * scale).astype(int) + shift[1]) % SIZE
            b = (((row_position - row) * height * scale).astype(int) + shift[0]) % SIZE
            factor = factor - 0.09 * veins * np.clip(canvas.noise.veins[b, a], 0, 2.5)
            factor = factor + 0.06 * veins * canvas.noise.cloud[b, a]
        if decor_every:
            u = column_position - column - 0.5
            v = row_position - row - 0.5
            radius = np.hypot(u, v)
            flower = 0.33 + 0.1 * np.cos(petals * np.arctan2(v, u))
            print_edge = np.abs(np.abs(radius - 0.6 * flower) - 0.35 * flower)
            printed = (3 * row + column) % decor_every == 0
            stroke = np.clip(1.5 - print_edge * min(width, height) * scale, 0, 1) * printed
            albedo = mix(albedo, ink, 0.8 * stroke)
        across_px = (column_position - np.round(column_position)) * width * scale
        along_px = (row_position - np.round(row_position)) * height * scale
        gap = np.maximum(line(across_px, 0.004 * scale), line(along_px, 0.004 * scale))
        return mix(albedo * factor[..., None], grout, gap)

    return Material(paint)


def wallpaper(
    rng: np.random.Generator, colour: ArrayLike, second: ArrayLike, *, period_m: float = 0.16, motif: bool = True
) -> Material:
    """Vertical stripes, with the same small flower repeated on them if `motif`."""
    petals = int(rng.integers(4, 8))
    phase = float(rng.uniform(0, 6))

    def paint(canvas: Canvas) -> Image:
        u = canvas.x / period_m
        stripe = np.clip((np.abs(u - np.floor(u) - 0.5) - 0.25) * period_m * canvas.texels_per_m + 0.5, 0, 1)
        albedo = mix(colour, second, np.broadcast_to(0.35 * stripe, canvas.shape))
        if motif:
            cell_x = (u - np.floor(u) - 0.5) * period_m
            v = canvas.y / (1.6 * period_m) + 0.5 * (np.floor(u) % 2)
            cell_y = (v - np.floor(v) - 0.5) * 1.6 * period_m
            radius = np.hypot(cell_x, cell_y) / period_m
            lobes = 0.2 * (0.75 + 0.25 * np.cos(petals * np.arctan2(cell_y, cell_x) + phase))
            inside = np.clip((lobes - radius) * period_m * canvas.texels_per_m + 0.5, 0, 1)
            albedo = mix(albedo, second, 0.8 * inside)
        return albedo

    return Material(paint)


def fabric(
    rng: np.random.Generator,
    colour: ArrayLike,
    *,
    weave: float = 0.02,
    second: ArrayLike | None = None,
    pattern: str = "plain",
    period_m: float = 0.12,
    shared: bool = False,
) -> Material:
    """Cloth: `plain`, `stripes`, `checks`, `dots` or `zigzag` in a second colour."""
    shift = _shift(rng)
    other = np.asarray(colour if second is None else second, np.float32)

    def paint(canvas: Canvas) -> Image:
        x = canvas.x / period_m
        y = canvas.y / period_m
        sharp = period_m * canvas.texels_per_m
        if pattern == "stripes":
            amount = np.clip((np.abs(y % 1 - 0.5) - 0.25) * sharp + 0.5, 0, 1) + 0 * x
        elif pattern == "checks":
            amount = 0.5 * (np.abs(x % 1 - 0.5) > 0.25) + 0.5 * (np.abs(y % 1 - 0.5) > 0.25)
        elif pattern == "dots":
            amount = np.clip((0.27 - np.hypot(x % 1 - 0.5, y % 1 - 0.5)) * sharp + 0.5, 0, 1)
        elif pattern == "zigzag":
            amount = np.clip((np.abs((y + np.abs(x % 1 - 0.5)) % 1 - 0.5) - 0.25) * sharp + 0.5, 0, 1)
        else:
            amount = np.zeros((1, 1), np.float32)
        tone = 1 + weave * canvas.crop(canvas.noise.fine, shift) + 0.4 * weave * canvas.crop(canvas.noise.cloud, shift)
        return mix(colour, other, np.broadcast_to(amount, canvas.shape)) * tone[..., None]

    return Material(paint, shared=shared)


def marble(rng: np.random.Generator, colour: ArrayLike, vein: ArrayLike, amount: float = 0.5) -> Material:
    """Stone worktops: veins and speckle."""
    shift = _shift(rng)

    def paint(canvas: Canvas) -> Image:
        veins = 0.3 * np.maximum(canvas.crop(canvas.noise.veins, shift), 0)
        value = 0.12 * canvas.crop(canvas.noise.cloud, shift) + veins
        value = value + 0.1 * canvas.crop(canvas.noise.fine, shift)
        return mix(colour, vein, np.clip(amount * value, 0, 1))

    return Material(paint)


def glow(colour: ArrayLike) -> Material:
    """A lit lamp shade: bright, and no obstacle to the light inside it."""
    return Material(lambda canvas: fill(canvas, colour), emissive=True, casts_shadow=False)


def leaf(rng: np.random.Generator, colour: ArrayLike) -> Material:
    """A leaf with its veins, stem at the bottom."""
    tip = vary(rng, np.asarray(colour) * 1.25, 0.02)
    veins = int(rng.integers(5, 9))

    def paint(canvas: Canvas) -> Image:
        x = canvas.unit_x - 0.5
        y = canvas.unit_y
        albedo = mix(tip, colour, np.broadcast_to(y, canvas.shape))
        rib = np.clip(1 - np.abs(x) * canvas.width / 1.5, 0, 1) + 0 * y
        side = np.clip(1 - np.abs(((y + np.abs(x)) * veins) % 1 - 0.5) * canvas.height / veins / 1.5, 0, 1)
        return albedo * (1 + 0.25 * np.maximum(rib, 0.5 * side))[..., None]

    return Material(paint, shared=True)
