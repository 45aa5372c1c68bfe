"""Scenes generated from a seed, which need no download: the default, a furnished apartment, and other kinds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.scenes.config import ApartmentConfig, SceneKind
from wheretolook_rooms import atlas, lighting
from wheretolook_rooms.building import building
from wheretolook_rooms.court import court
from wheretolook_rooms.furnishing import furnish
from wheretolook_rooms.hall import hall
from wheretolook_rooms.large import Furnished, panes
from wheretolook_rooms.layout import Lamp, Rectangle
from wheretolook_rooms.materials import NoiseBank
from wheretolook_rooms.office import office
from wheretolook_rooms.patches import Patch, join
from wheretolook_rooms.plan import Plan, draw_plan
from wheretolook_rooms.shell import build_shell
from wheretolook_rooms.style import Style
from wheretolook_rooms.variant import changed

BRIGHTNESS = np.geomspace(0.12, 1.06, atlas.LEVELS)  # factors on the albedo of shared materials


def furnish_apartment(config: ApartmentConfig, seed: int) -> tuple[Plan, list[Patch], list[Lamp], np.random.Generator]:
    """Plan, surfaces and lamps of an apartment, and the random generator that paints it."""
    rng = np.random.default_rng(seed)
    n_rooms = int(rng.integers(4, 7)) if config.n_rooms is None else config.n_rooms
    area = 13.0 * n_rooms * rng.uniform(0.9, 1.15) if config.area_m2 is None else config.area_m2
    plan = draw_plan(rng, n_rooms, float(area), config.dark_rooms)
    style = Style(rng, config.texture_richness, config.clutter)
    patches = build_shell(style, plan)
    furniture, lamps = furnish(style, plan)
    return plan, patches + furniture, lamps, rng


def apartment(config: ApartmentConfig, seed: int) -> Furnished:
    """A furnished apartment, before it is painted and lit."""
    floor_plan, patches, lamps, rng = furnish_apartment(config, seed)
    windows = [(pane, floor_plan.rooms[pane.room].curtains_closed) for pane, _ in panes(patches)]
    return Furnished(patches, lamps, windows, rng)


def generate_apartment(config: ApartmentConfig, seed: int, device: str = "cpu") -> TexturedMesh:
    """A furnished apartment in metres, z up, floor at z = 0, centred on the origin; one texture with baked light.

    The same configuration and seed give the same bytes on the same device, "cpu" or a CUDA device for the light rays.
    Raises ConfigError if there is no such device, SceneError if the texture is too small for the apartment.
    """
    return generate_scene("apartment", config, seed, device)[0]


def generate_scene(
    kind: SceneKind, config: ApartmentConfig, seed: int, device: str = "cpu", changes: float = 0.0
) -> tuple[TexturedMesh, tuple[Rectangle, ...]]:
    """A scene of a kind, as `generate_apartment` makes them, and the floor that its map is to be made from.

    With `changes`, 0 to 1, the same scene with things moved or removed and in other light; see `variant.changed`.
    The floor is a tuple of rectangles (x0, y0, x1, y1) in metres, empty where the whole scene is to be mapped. All
    kinds but apartments draw their size and difficulty from the seed, as apartments do that `vary`.
    """
    if kind == "apartment":
        config = config.of_seed(seed)
    else:
        config = replace(replace(config, vary=True).of_seed(seed), enlarged=1.0)
    make = {"apartment": apartment, "hall": hall, "court": court, "office": office, "building": building}
    furnished = make[kind](config, seed)
    if changes:
        furnished = changed(furnished, changes, seed)
    # Light is computed more coarsely, as these scenes may have ten times the surface of an apartment.
    config = replace(config, light_spacing_m=max(config.light_spacing_m, furnished.light_spacing_m))
    return paint(furnished, config, seed, device), furnished.mapped


def paint(furnished: Furnished, config: ApartmentConfig, seed: int, device: str = "cpu") -> TexturedMesh:
    """The mesh of a furnished scene: its surfaces painted and lit."""
    patches = furnished.patches
    rng = furnished.rng
    surface = join(patches)
    plan = atlas.plan_atlas(patches, config.texels_per_m, config.texture_size)
    noise = NoiseBank(rng)
    painted = atlas.paint_charts(plan, noise)
    if config.repetition and furnished.periods_m:
        patterns = np.random.default_rng([seed, 1]), noise, furnished.periods_m, furnished.alike
        painted = atlas.repeat_patterns(plan, painted, config.repetition, *patterns)
    mean_colour = np.array([image[::2, ::2].mean((0, 1)) for image in painted])
    albedo = np.clip(mean_colour[plan.patch_chart], 0, 1) ** 2.2

    samples = lighting.place_samples(patches, config.light_spacing_m)
    lights = furnished.windows, furnished.lamps
    light = lighting.bake(patches, surface, samples, albedo, *lights, device=device, rays=config.light_rays)
    chart, factors = _light_charts(plan, patches, samples, light)
    size = np.array([(c.width, c.height) for c in plan.charts], float)[chart]
    texels = plan.corners[chart].astype(float)[surface.patch][:, None] + surface.st * size[surface.patch][:, None]
    return TexturedMesh(
        vertices=(config.enlarged * surface.vertices).astype(np.float32),
        triangles=surface.triangles.astype(np.int32),
        corner_uvs=(texels / np.array(plan.size, float)).astype(np.float32),
        triangle_texture=np.zeros(len(surface.triangles), np.int32),
        textures=(atlas.compose(plan, painted, factors),),
    )


def _light_charts(
    plan: atlas.AtlasPlan, patches: list[Patch], samples: lighting.Samples, light: lighting.Light
) -> tuple[NDArray[np.int64], list[Any]]:
    """The chart of each patch (P,), and the factor on each chart's albedo.

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
