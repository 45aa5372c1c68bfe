"""The embedded default scene: a furnished apartment, drawn from a seed."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.scenes.procedural import atlas, lighting
from wheretolook.scenes.procedural.furnishing import furnish
from wheretolook.scenes.procedural.layout import Lamp
from wheretolook.scenes.procedural.noise import NoiseBank
from wheretolook.scenes.procedural.patches import Patch, Surface, join
from wheretolook.scenes.procedural.plan import Plan, draw_plan
from wheretolook.scenes.procedural.repetition import repeat_patterns
from wheretolook.scenes.procedural.shell import build_shell
from wheretolook.scenes.procedural.style import Style
from wheretolook.utils.errors import ConfigError


@dataclass(frozen=True)
class ApartmentConfig:
    """Options of the procedural apartment.

    Args:
        n_rooms: number of rooms, 3 to 6; None draws it from the seed.
        area_m2: floor area aimed at, in square metres; None takes about 13 per room.
        texture_richness: 0 to 1; contrast of wood, stone and cloth, and how many pictures hang. Lower is harder to
            localize in.
        clutter: 0 to 1; books, plants, bottles and other small things. Lower is harder.
        repetition: 0 to 1; share of large surfaces that repeat a strong pattern every 0.6 to 2 m, as in games. Such
            views are full of features and yet hard to localize.
        dark_rooms: share of rooms whose lamp is off, some with their curtains closed. Higher is harder.
        enlarged: how many times as large everything is, furniture and patterns too: halls with few, far landmarks.
        vary: every apartment draws its area and the five numbers above from its seed, whatever they are set to: rooms
            unlike each other, to learn from.
        texels_per_m: texture resolution of large surfaces; lowered if the atlas would not fit.
        texture_size: greatest width and height of the texture in texels.
        light_spacing_m: distance between light samples in metres.
        light_rays: rays per light sample over the hemisphere.
    """

    n_rooms: int | None = None
    area_m2: float | None = None
    texture_richness: float = 0.85
    clutter: float = 0.85
    repetition: float = 0.0
    dark_rooms: float = 0.2
    enlarged: float = 1.0
    vary: bool = False
    texels_per_m: float = 125.0
    texture_size: int = 4096
    light_spacing_m: float = 0.1
    light_rays: int = 24

    def __post_init__(self) -> None:
        if self.n_rooms is not None and not 3 <= self.n_rooms <= 6:
            raise ConfigError("n_rooms must be 3 to 6", value=self.n_rooms)
        if self.area_m2 is not None and not 25 <= self.area_m2 <= 200:
            raise ConfigError("area_m2 must be 25 to 200", value=self.area_m2)
        for name in ("texture_richness", "clutter", "repetition", "dark_rooms"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"{name} must be between 0 and 1", value=getattr(self, name))
        for name in ("enlarged", "texels_per_m", "texture_size", "light_spacing_m", "light_rays"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"{name} must be a positive number", value=getattr(self, name))

    def key(self) -> dict[str, Any]:
        """What decides an apartment, but for its seed; options that came later only where they are not the default."""
        later = ("repetition", "enlarged", "vary")
        default = ApartmentConfig()
        return {
            name: value for name, value in asdict(self).items() if name not in later or value != getattr(default, name)
        }

    def of_seed(self, seed: int) -> ApartmentConfig:
        """What the apartment of a seed is like: this, unless it is to `vary`."""
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


def furnish_apartment(config: ApartmentConfig, seed: int) -> tuple[Plan, list[Patch], list[Lamp], np.random.Generator]:
    """Plan, surfaces and lamps of an apartment before paint and light; the random generator goes on with the paint."""
    rng = np.random.default_rng(seed)
    n_rooms = int(rng.integers(4, 7)) if config.n_rooms is None else config.n_rooms
    area = 13.0 * n_rooms * rng.uniform(0.9, 1.15) if config.area_m2 is None else config.area_m2
    plan = draw_plan(rng, n_rooms, float(area), config.dark_rooms)
    style = Style(rng, config.texture_richness, config.clutter)
    patches = build_shell(style, plan)
    furniture, lamps = furnish(style, plan)
    return plan, patches + furniture, lamps, rng


def generate_apartment(config: ApartmentConfig, seed: int, device: str = "cpu") -> TexturedMesh:
    """A furnished apartment with one texture atlas that holds albedo and baked light.

    The same configuration and seed give the same bytes on the same device.

    Args:
        config: size, number of rooms and how hard it is to localize in.
        seed: seed of every random choice.
        device: Warp device that casts the light rays, "cpu" or a CUDA device.

    Returns:
        Mesh in metres, z up, floor at z = 0, centred on the origin.

    Raises:
        ConfigError: there is no such device.
        SceneError: the texture is too small for the apartment.
    """
    config = config.of_seed(seed)
    floor_plan, patches, lamps, rng = furnish_apartment(config, seed)
    surface = join(patches)
    plan = atlas.plan_atlas(patches, config.texels_per_m, config.texture_size)
    noise = NoiseBank(rng)
    painted = atlas.paint_charts(plan, noise)
    if config.repetition:
        painted = repeat_patterns(plan, painted, config.repetition, np.random.default_rng([seed, 1]), noise)
    mean_colour = np.array([image[::2, ::2].mean((0, 1)) for image in painted])
    albedo = np.clip(mean_colour[plan.patch_chart], 0, 1) ** 2.2

    samples = lighting.place_samples(patches, config.light_spacing_m)
    windows = [
        (p, floor_plan.rooms[p.room].curtains_closed)
        for p in patches
        if p.material.emissive and p.material.casts_shadow
    ]
    light = lighting.bake(patches, surface, samples, albedo, windows, lamps, device=device, rays=config.light_rays)
    chart, factors = _light_charts(plan, patches, samples, light)
    return TexturedMesh(
        vertices=(config.enlarged * surface.vertices).astype(np.float32),
        triangles=surface.triangles.astype(np.int32),
        corner_uvs=_uvs(plan, chart, surface),
        triangle_texture=np.zeros(len(surface.triangles), np.int32),
        textures=(atlas.compose(plan, painted, factors),),
    )


def _light_charts(
    plan: atlas.AtlasPlan, patches: list[Patch], samples: lighting.Samples, light: lighting.Light
) -> tuple[NDArray[np.int64], list[Any]]:
    """The chart each patch uses, and the factor on each chart's albedo.

    A patch of a shared material takes the chart whose brightness is nearest to its light.
    """
    reference = float(np.quantile(light.luminance, 0.7))
    chart = plan.patch_chart.copy()
    factors: list[Any] = [None] * len(plan.charts)
    for k, (patch, grid) in enumerate(zip(patches, lighting.light_grids(samples, light), strict=True)):
        if grid is None:
            continue
        factor = lighting.to_display(grid, reference)
        if patch.material.shared:
            first = chart[k]
            factors[first : first + atlas.LEVELS] = [np.full((1, 1, 3), level) for level in BRIGHTNESS]
            chart[k] = first + int(np.abs(BRIGHTNESS - factor.mean()).argmin())
        else:
            factors[chart[k]] = factor
    return chart, factors


BRIGHTNESS = np.geomspace(0.12, 1.06, atlas.LEVELS)
"""Factors on the albedo of shared materials."""


def _uvs(plan: atlas.AtlasPlan, chart: NDArray[np.int64], surface: Surface) -> NDArray[np.float32]:
    size = np.array([(c.width, c.height) for c in plan.charts], float)[chart]
    texel = plan.corners[chart].astype(float)[surface.patch][:, None] + surface.st * size[surface.patch][:, None]
    return (texel / np.array(plan.size, float)).astype(np.float32)
