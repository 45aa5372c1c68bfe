"""The colours and materials that the rooms and furniture of one apartment have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from wheretolook_rooms import artwork, materials
from wheretolook_rooms.materials import Material

T = TypeVar("T")

WALLS = ((0.90, 0.88, 0.84), (0.87, 0.87, 0.86), (0.88, 0.84, 0.76), (0.80, 0.84, 0.82), (0.82, 0.85, 0.89))
ACCENTS = ((0.45, 0.55, 0.52), (0.36, 0.45, 0.56), (0.72, 0.52, 0.42), (0.62, 0.60, 0.54), (0.75, 0.67, 0.50))
WOODS = ((0.78, 0.62, 0.44), (0.68, 0.49, 0.32), (0.50, 0.34, 0.23), (0.84, 0.74, 0.60), (0.58, 0.44, 0.33))
_GREYS = (0.48, 0.52, 0.56), (0.62, 0.56, 0.48), (0.30, 0.40, 0.46)
TEXTILES = (*_GREYS, (0.70, 0.64, 0.55), (0.46, 0.50, 0.40), (0.58, 0.36, 0.32))
FRONTS = ((0.88, 0.88, 0.85), (0.52, 0.58, 0.55), (0.80, 0.76, 0.68), (0.42, 0.48, 0.56))


class Style:
    """Materials that one apartment is furnished with; its `rng` makes all random choices.

    From 0 to 1, `richness` is how much texture surfaces have and how much hangs on the walls, `clutter` how many small
    things there are.
    """

    def __init__(self, rng: np.random.Generator, richness: float, clutter: float) -> None:
        self.rng = rng
        self.richness = richness
        self.clutter = clutter
        order = rng.permutation(len(WOODS))
        contrast = 0.5 + 1.3 * richness
        self.floor_colour, wood, second_wood = (WOODS[k] for k in order[:3])
        self.wood = materials.wood(rng, wood, 0.8 * contrast)
        self.second_wood = materials.wood(rng, second_wood, 0.8 * contrast)
        self.small_wood = materials.wood(rng, wood, 0.5, shared=True)
        self.white = materials.plain(rng, (0.90, 0.90, 0.88))
        self.small_white = materials.plain(rng, (0.90, 0.90, 0.88), shared=True)
        self.ceramic = materials.plain(rng, (0.93, 0.93, 0.92))
        self.metal = materials.plain(rng, (0.62, 0.63, 0.65), shared=True)
        self.black = materials.plain(rng, (0.10, 0.10, 0.11), shared=True)
        self.paper = materials.plain(rng, (0.88, 0.85, 0.76), shared=True)
        self.screen = artwork.screen(rng)
        self.front = materials.plain(rng, materials.vary(rng, self.pick(FRONTS), 0.03))
        self.trim = materials.plain(rng, (0.93, 0.92, 0.90))
        self.upholstery = materials.fabric(rng, self.pick(TEXTILES), weave=0.03 + 0.07 * richness)
        self.leg = self.metal if rng.random() < 0.4 else self.small_wood
        self.covers = [materials.plain(rng, c, shared=True) for p in artwork.PALETTES for c in p[1:4]]
        self.cover_colours = [c for p in artwork.PALETTES for c in p]
        self.leaves = [materials.leaf(rng, materials.vary(rng, (0.22, 0.42, 0.18), 0.05)) for _ in range(3)]
        self.prints: list[Material] = []

    def pick(self, options: Sequence[T]) -> T:
        """One of the options at random."""
        return options[int(self.rng.integers(len(options)))]

    def bernoulli(self, probability: float) -> bool:
        """True with the given probability."""
        return bool(self.rng.random() < probability)

    def patterned(self) -> Material:
        """Cloth with a pattern, for pillows, throws and bed covers."""
        patterns = ["plain", "stripes", "checks", "dots", "zigzag"]
        pattern = self.pick(patterns) if self.bernoulli(self.richness + 0.35) else "plain"
        colours = self.pick(artwork.PALETTES)
        first, second = (colours[k] for k in self.rng.permutation(5)[:2])
        period_m = float(self.rng.uniform(0.05, 0.14))
        return materials.fabric(self.rng, first, second=second, pattern=pattern, period_m=period_m, weave=0.03)

    def print(self) -> Material:
        """A picture, sometimes one that already hangs in another room."""
        if self.prints and self.bernoulli(0.3):
            return self.pick(self.prints)
        material = artwork.picture(self.rng, mat=float(self.pick([0.0, 0.0, 0.1, 0.16])))
        self.prints.append(material)
        return material
