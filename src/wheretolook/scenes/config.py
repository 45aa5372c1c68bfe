"""Options of procedural apartments."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np

from wheretolook.utils.errors import check_positive, check_range, no_option

SceneKind = Literal["apartment", "hall", "court", "office", "building"]


@dataclass(frozen=True)
class ApartmentConfig:
    """Options of the procedural apartment.

    Args:
        n_rooms: number of rooms, 3 to 6; drawn from the seed if not given.
        area_m2: floor area aimed at, in square metres; about 13 per room if not given.
        texture_richness: how rich in texture surfaces are, 0 to 1; lower is harder to localize in. The contrast of
            wood, stone and cloth, and how many pictures hang.
        clutter: how many small things there are, 0 to 1; lower is harder. Books, plants, bottles.
        repetition: share of large surfaces with a strong pattern that repeats, 0 to 1. Every 0.6 to 2 m, as in games:
            such views are full of features and yet hard to localize.
        dark_rooms: share of rooms whose lamp is off, some with their curtains closed. Higher is harder.
        enlarged: scale factor of everything, furniture and patterns included: halls with few, far landmarks.
        vary: draw area, texture, clutter, repetition, dark rooms and scale from each apartment's seed, whatever they are
            set to, so that training scenes differ in size and difficulty.
        texels_per_m: texture resolution of large surfaces; lowered if the atlas would not fit.
        texture_size: greatest width and height of the texture in texels.
        light_spacing_m: distance between light samples in metres.
        light_rays: rays per light sample over the hemisphere.
    """

    n_rooms: int | None = no_option(None)
    area_m2: float | None = no_option(None)
    texture_richness: float = no_option(0.85)
    clutter: float = no_option(0.85)
    repetition: float = no_option(0.0)
    dark_rooms: float = no_option(0.2)
    enlarged: float = no_option(1.0)
    vary: bool = False
    texels_per_m: float = no_option(125.0)
    texture_size: int = no_option(4096)
    light_spacing_m: float = no_option(0.1)
    light_rays: int = no_option(24)

    def __post_init__(self) -> None:
        if self.n_rooms is not None:
            check_range("n_rooms", self.n_rooms, 3, 6)
        if self.area_m2 is not None:
            check_range("area_m2", self.area_m2, 25, 200)
        for name in ("texture_richness", "clutter", "repetition", "dark_rooms"):
            check_range(name, getattr(self, name), 0, 1)
        for name in ("enlarged", "texels_per_m", "texture_size", "light_spacing_m", "light_rays"):
            check_positive(name, getattr(self, name))

    def key(self) -> dict[str, Any]:
        """Settings that determine an apartment apart from its seed; later options only if they are not the default."""
        later = ("repetition", "enlarged", "vary")
        default = asdict(ApartmentConfig())
        return {name: value for name, value in asdict(self).items() if name not in later or value != default[name]}

    def of_seed(self, seed: int) -> ApartmentConfig:
        """The options of the apartment of a seed: these, unless `vary` is set."""
        if not self.vary:
            return self
        rng = np.random.default_rng([seed, 2])
        return replace(
            self,
            area_m2=float(rng.uniform(35, 130)),
            texture_richness=float(rng.uniform(0.5, 1)),
            clutter=float(rng.uniform(0.3, 1)),
            repetition=float(rng.uniform(0.3, 1)) if rng.random() < 0.7 else 0.0,
            dark_rooms=float(rng.uniform(0, 0.4)),
            enlarged=float(np.exp(rng.uniform(0, np.log(3)))),
            vary=False,
        )
