"""Surfaces that repeat a strong pattern, as in games: they have many features that look alike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wheretolook.scenes.procedural import artwork
from wheretolook.scenes.procedural.atlas import AtlasPlan
from wheretolook.scenes.procedural.noise import Canvas, Image, NoiseBank

PATTERNS = 6
"""Number of patterns in one apartment; several surfaces have the same one."""

LEAST_M = 0.7
"""Surfaces narrower than this stay as they are."""


def repeat_patterns(
    plan: AtlasPlan, painted: Sequence[Image], share: float, rng: np.random.Generator, noise: NoiseBank
) -> list[Image]:
    """Albedo of each chart (height, width, 3), where a share (0 to 1) of the large surfaces repeats a pattern.

    On these surfaces it is the mean of the pattern and of what was painted, which is repeated too.
    """
    periods_m = rng.uniform(0.6, 2.0, PATTERNS)
    materials = [artwork.picture(rng) for _ in range(PATTERNS)]
    tiles: dict[tuple[int, float], Image] = {}
    covered = list(painted)
    for number, (chart, image) in enumerate(zip(plan.charts, painted, strict=True)):
        if chart.material.shared or chart.material.emissive:
            continue
        if min(chart.width, chart.height) < LEAST_M * chart.texels_per_m or rng.random() >= share:
            continue
        which = int(rng.integers(PATTERNS))
        side = max(1, round(periods_m[which] * chart.texels_per_m))
        key = (which, chart.texels_per_m)
        if key not in tiles:
            canvas = Canvas(side, side, chart.texels_per_m, 0.0, 0.0, noise)
            tiles[key] = np.asarray(materials[which].paint(canvas), np.float32)
        rows, columns = np.arange(chart.height) % side, np.arange(chart.width) % side
        at = np.ix_(rows, columns)
        covered[number] = 0.5 * image[at] + 0.5 * tiles[key][at]
    return covered
