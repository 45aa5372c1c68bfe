"""The texture atlas: a rectangle for every patch, painted albedo times light, padded against bleeding."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wheretolook.utils.errors import SceneError
from wheretolook_rooms import artwork
from wheretolook_rooms.materials import Canvas, Image, Material, NoiseBank
from wheretolook_rooms.patches import Patch

LEVELS = 14  # brightness steps of materials that share one piece of texture
SHARED_TEXELS = (24, 16)
PATTERNS = 6  # that repeat in one apartment; several surfaces have the same one
LEAST_M = 0.7  # surfaces narrower than this do not repeat a pattern


@dataclass(frozen=True, eq=False)
class Chart:
    """A rectangle of the atlas."""

    material: Material
    width: int  # texels, without padding
    height: int
    pad: int  # texels of replicated border on each side
    texels_per_m: float  # scale of the pattern
    offset_m: tuple[float, float]  # where the pattern starts


@dataclass(frozen=True, eq=False)
class AtlasPlan:
    """Charts, their corners and the chart of each patch."""

    charts: list[Chart]
    corners: NDArray[np.int64]  # (C, 2) x, y of the top-left texel inside the padding
    patch_chart: NDArray[np.int64]  # (P,) for shared materials the darkest of LEVELS consecutive charts
    size: tuple[int, int]  # width and height of the texture


def _charts(patches: Sequence[Patch], texels_per_m: float) -> tuple[list[Chart], NDArray[np.int64]]:
    """Charts of all patches, and the chart of each (P,)."""
    charts: list[Chart] = []
    index = np.empty(len(patches), np.int64)
    shared: dict[int, int] = {}
    for k, patch in enumerate(patches):
        if patch.material.shared:
            key = id(patch.material)
            if key not in shared:
                shared[key] = len(charts)
                height, width = SHARED_TEXELS
                charts += [Chart(patch.material, width, height, 4, 200.0, (0.0, 0.0))] * LEVELS
            index[k] = shared[key]
            continue
        scale = texels_per_m * patch.density
        width, height = (max(2, int(np.ceil(s * scale))) for s in patch.size_m)
        pad = 8 if min(width, height) > 64 else 4
        index[k] = len(charts)
        charts.append(Chart(patch.material, width, height, pad, scale, patch.offset_m))
    return charts, index


def _pack(charts: Sequence[Chart], size: int) -> tuple[NDArray[np.int64], int] | None:
    """Shelf packing, tallest first; None if it does not fit a square of `size`."""
    outer = np.array([(c.width + 2 * c.pad, c.height + 2 * c.pad) for c in charts])
    corners = np.empty((len(charts), 2), np.int64)
    x = y = shelf = 0
    for k in np.lexsort((np.arange(len(charts)), -outer[:, 0], -outer[:, 1])):
        w, h = outer[k]
        if x + w > size:
            x = 0
            y = y + shelf
            shelf = 0
        shelf = max(shelf, int(h))
        if w > size or y + shelf > size:
            return None
        corners[k] = x + charts[k].pad, y + charts[k].pad
        x += int(w)
    return corners, y + shelf


def plan_atlas(patches: Sequence[Patch], texels_per_m: float, size: int) -> AtlasPlan:
    """Place all patches; the density is lowered until they fit, SceneError if not even a quarter of it does."""
    density = texels_per_m
    while density > texels_per_m / 4:
        charts, index = _charts(patches, density)
        packed = _pack(charts, size)
        if packed is not None:
            rows = min(size, -(-packed[1] // 256) * 256)
            return AtlasPlan(charts, packed[0], index, (size, rows))
        density *= 0.95
    fix = "Raise texture_size or lower texels_per_m"
    raise SceneError("texture is too small for the apartment", value=size, fix=fix)


def paint_charts(plan: AtlasPlan, noise: NoiseBank) -> list[Image]:
    """Albedo of every chart, (height, width, 3) float32 in display space."""
    painted: dict[int, Image] = {}
    for chart in plan.charts:
        if id(chart) not in painted:  # the levels of a shared material are one chart
            canvas = Canvas(chart.height, chart.width, chart.texels_per_m, *chart.offset_m, noise)
            painted[id(chart)] = np.asarray(chart.material.paint(canvas), np.float32)
    return [painted[id(chart)] for chart in plan.charts]


def repeat_patterns(
    plan: AtlasPlan,
    painted: Sequence[Image],
    share: float,
    rng: np.random.Generator,
    noise: NoiseBank,
    periods_m: tuple[float, float] = (0.6, 2.0),
    alike: bool = False,
) -> list[Image]:
    """Albedo of each chart (height, width, 3), where a share (0 to 1) of the large surfaces repeats a pattern.

    `periods_m` are the least and the greatest side of a pattern. If `alike`, surfaces of one material and size get the
    same one.

    As in games, they have many features that look alike: the mean of the pattern and of what was painted, repeated too.
    """
    sides_m = rng.uniform(*periods_m, PATTERNS)
    materials = [artwork.picture(rng) for _ in range(PATTERNS)]
    tiles: dict[tuple[int, float], Image] = {}
    chosen: dict[tuple[int, int, int], int] = {}
    covered = list(painted)
    for number, (chart, image) in enumerate(zip(plan.charts, painted, strict=True)):
        unfit = chart.material.shared or chart.material.emissive
        if unfit or min(chart.width, chart.height) < LEAST_M * chart.texels_per_m:
            continue
        which = int(rng.integers(PATTERNS)) if rng.random() < share else -1
        if alike:
            which = chosen.setdefault((id(chart.material), chart.width, chart.height), which)
        if which < 0:
            continue
        side = max(1, round(sides_m[which] * chart.texels_per_m))
        key = (which, chart.texels_per_m)
        if key not in tiles:
            canvas = Canvas(side, side, chart.texels_per_m, 0.0, 0.0, noise)
            tiles[key] = np.asarray(materials[which].paint(canvas), np.float32)
        at = np.ix_(np.arange(chart.height) % side, np.arange(chart.width) % side)
        covered[number] = 0.5 * image[at] + 0.5 * tiles[key][at]
    return covered


def compose(
    plan: AtlasPlan, painted: Sequence[Image], light: Sequence[NDArray[np.floating[Any]] | None]
) -> NDArray[np.uint8]:
    """Albedo times light, padded, in one (H, W, 3) sRGB texture.

    `light` is each chart's factor on the albedo, (h, w, 3) on any coarser grid, or None for surfaces that glow.
    """
    width, height = plan.size
    atlas = np.zeros((height, width, 3), np.uint8)
    for chart, (x, y), albedo, factor in zip(plan.charts, plan.corners, painted, light, strict=True):
        if factor is not None:
            albedo = albedo * cv2.resize(np.asarray(factor, np.float32), (chart.width, chart.height))
        p = chart.pad
        texels = np.clip(albedo * 255 + 0.5, 0, 255).astype(np.uint8)
        padded = cv2.copyMakeBorder(texels, p, p, p, p, cv2.BORDER_REPLICATE)
        atlas[y - p : y + chart.height + p, x - p : x + chart.width + p] = padded
    return atlas
