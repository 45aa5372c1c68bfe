"""The taste of one household: the colours and materials its rooms and furniture have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from wheretolook.scenes.procedural import artwork, materials
from wheretolook.scenes.procedural.materials import Colour, Material

T = TypeVar("T")

WALLS: Sequence[Colour] = (
    (0.90, 0.88, 0.84),
    (0.87, 0.87, 0.86),
    (0.88, 0.84, 0.76),
    (0.80, 0.84, 0.82),
    (0.82, 0.85, 0.89),
)
ACCENTS: Sequence[Colour] = (
    (0.45, 0.55, 0.52),
    (0.36, 0.45, 0.56),
    (0.72, 0.52, 0.42),
    (0.62, 0.60, 0.54),
    (0.75, 0.67, 0.50),
)
WOODS: Sequence[Colour] = (
    (0.78, 0.62, 0.44),
    (0.68, 0.49, 0.32),
    (0.50, 0.34, 0.23),
    (0.84, 0.74, 0.60),
    (0.58, 0.44, 0.33),
)
TEXTILES: Sequence[Colour] = (
    (0.48, 0.52, 0.56),
    (0.62, 0.56, 0.48),
    (0.30, 0.40, 0.46),
    (0.70, 0.64, 0.55),
    (0.46, 0.50, 0.40),
    (0.58, 0.36, 0.32),
)


class Style:
    """Materials one apartment is furnished with.

    Args:
        rng: source of all choices.
        richness: 0 to 1, how much texture surfaces have and how much hangs on the walls.
        clutter: 0 to 1, how many small things lie about.
    """

    def __init__(self, rng: np.random.Generator, richness: float, clutter: float) -> None:
        self.rng, self.richness, self.clutter = rng, richness, clutter
        order = rng.permutation(len(WOODS))
        contrast = 0.5 + 1.3 * richness
        self.floor_colour = WOODS[order[0]]
        self.wood_colour, self.dark_wood_colour = WOODS[order[1]], WOODS[order[2]]
        self.wood = materials.wood(rng, self.wood_colour, 0.8 * contrast)
        self.second_wood = materials.wood(rng, self.dark_wood_colour, 0.8 * contrast)
        self.small_wood = materials.wood(rng, self.wood_colour, 0.5, shared=True)
        self.white = materials.plain(rng, (0.90, 0.90, 0.88))
        self.small_white = materials.plain(rng, (0.90, 0.90, 0.88), shared=True)
        self.ceramic = materials.plain(rng, (0.93, 0.93, 0.92))
        self.metal = materials.plain(rng, (0.62, 0.63, 0.65), shared=True)
        self.black = materials.plain(rng, (0.10, 0.10, 0.11), shared=True)
        self.paper = materials.plain(rng, (0.88, 0.85, 0.76), shared=True)
        self.screen = artwork.screen(rng)
        self.front_colour = materials.vary(
            rng, self.pick([(0.88, 0.88, 0.85), (0.52, 0.58, 0.55), (0.80, 0.76, 0.68), (0.42, 0.48, 0.56)]), 0.03
        )
        self.front = materials.plain(rng, self.front_colour)
        self.trim = materials.plain(rng, (0.93, 0.92, 0.90))
        self.textile = self.pick(TEXTILES)
        self.upholstery = materials.fabric(rng, self.textile, weave=0.03 + 0.07 * richness)
        self.metal_legs = bool(rng.random() < 0.4)
        self.covers = [materials.plain(rng, c, shared=True) for p in artwork.PALETTES for c in p[1:4]]
        self.cover_colours = [c for p in artwork.PALETTES for c in p]
        self.leaves = [materials.leaf(rng, materials.vary(rng, (0.22, 0.42, 0.18), 0.05)) for _ in range(3)]
        self.prints: list[Material] = []

    def pick(self, options: Sequence[T]) -> T:
        """One of them at random."""
        return options[int(self.rng.integers(len(options)))]

    def chance(self, probability: float) -> bool:
        """True with the given probability."""
        return bool(self.rng.random() < probability)

    def patterned(self) -> Material:
        """Cloth with a pattern, for pillows, throws and bed covers."""
        kind = (
            self.pick(["plain", "stripes", "checks", "dots", "zigzag"])
            if self.chance(self.richness + 0.35)
            else "plain"
        )
        colours = self.pick(artwork.PALETTES)
        first, second = self.rng.permutation(5)[:2]
        return materials.fabric(
            self.rng,
            colours[first],
            second=colours[second],
            pattern=kind,
            period_m=float(self.rng.uniform(0.05, 0.14)),
            weave=0.03,
        )

    def leg(self) -> Material:
        """Metal or wood, the same everywhere."""
        return self.metal if self.metal_legs else self.small_wood

    def print(self) -> Material:
        """A picture; now and then one that already hangs in another room."""
        if self.prints and self.chance(0.3):
            return self.pick(self.prints)
        material = artwork.picture(self.rng, mat=float(self.pick([0.0, 0.0, 0.1, 0.16])))
        self.prints.append(material)
        return material
