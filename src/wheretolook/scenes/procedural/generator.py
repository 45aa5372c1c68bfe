"""The embedded default scene: a furnished apartment, drawn from a seed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.errors import ConfigError
from wheretolook.scenes.mesh import TexturedMesh
from wheretolook.scenes.procedural import atlas, lighting
from wheretolook.scenes.procedural.furnishing import Furnisher
from wheretolook.scenes.procedural.noise import NoiseBank
from wheretolook.scenes.procedural.patches import Patch
from wheretolook.scenes.procedural.plan import Plan, draw_plan
from wheretolook.scenes.procedural.shell import build_shell
from wheretolook.scenes.procedural.style import Style


@dataclass(frozen=True)
class ApartmentConfig:
    """Options of the procedural apartment.

    Args:
        n_rooms: number of rooms, 3 to 6; None draws it from the seed.
        area_m2: floor area aimed at, in square metres; None takes about 13 per room.
        texture_richness: 0 to 1; contrast of wood, stone and cloth, and how many pictures hang. Lower is harder to
            localize in.
        clutter: 0 to 1; books, plants, bottles and other small things. Lower is harder.
        dark_rooms: share of rooms whose lamp is off, some with their curtains closed. Higher is harder.
        texels_per_m: texture resolution of large surfaces; lowered if the atlas would not fit.
        texture_size: greatest width and height of the texture in texels.
        light_spacing_m: distance between light samples in metres.
        light_rays: rays per light sample over the hemisphere.
    """

    n_rooms: int | None = None
    area_m2: float | None = None
    texture_richness: float = 0.5
    clutter: float = 0.5
    dark_rooms: float = 0.3
    texels_per_m: float = 125.0
    texture_size: int = 4096
    light_spacing_m: float = 0.1
    light_rays: int = 24

    def __post_init__(self) -> None:
        if self.n_rooms is not None and not 3 <= self.n_rooms <= 6:
            raise ConfigError("n_rooms must be 3 to 6", value=self.n_rooms)
        if self.area_m2 is not None and not 25 <= self.area_m2 <= 200:
            raise ConfigError("area_m2 must be 25 to 200", value=self.area_m2)
        for name in ("texture_richness", "clutter", "dark_rooms"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"{name} must be between 0 and 1", value=getattr(self, name))
        for name in ("texels_per_m", "texture_size", "light_spacing_m", "light_rays"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive", value=getattr(self, name))


def furnish_apartment(config: ApartmentConfig, seed: int) -> tuple[Plan, list[Patch], Furnisher, np.random.Generator]:
    """Plan and surfaces of an apartment before painting and light; the generator continues with the painting."""
    rng = np.random.default_rng(seed)
    n_rooms = int(rng.integers(4, 7)) if config.n_rooms is None else config.n_rooms
    area = 13.0 * n_rooms * rng.uniform(0.9, 1.15) if config.area_m2 is None else config.area_m2
    plan = draw_plan(rng, n_rooms, float(area), config.dark_rooms)
    style = Style(rng, config.texture_richness, config.clutter)
    shell, _ = build_shell(style, plan)
    furnisher = Furnisher(style, plan)
    furnisher.furnish()
    return plan, shell + furnisher.patches, furnisher, rng


def generate_apartment(config: ApartmentConfig, seed: int, device: str = "cpu") -> TexturedMesh:
    """A furnished apartment with one texture atlas that holds albedo and baked light.

    The same configuration and seed give the same bytes on the same device.

    Args:
        config: size, number of rooms and how hard it is to localize in.
        seed: seed of every random choice.
        device: Warp device that casts the light rays.

    Returns:
        Mesh in metres, z up, floor at z = 0, centred on the origin.

    Raises:
        SceneError: the texture is too small for the apartment.
    """
    floor_plan, patches, furnisher, rng = furnish_apartment(config, seed)
    vertices, triangles, triangle_patch, triangle_st = _assemble(patches)

    plan = atlas.plan_atlas(patches, config.texels_per_m, config.texture_size)
    painted = atlas.paint_charts(plan, NoiseBank(rng))
    chart_albedo = np.array([image[::2, ::2].mean((0, 1)) for image in painted])
    albedo = np.clip(chart_albedo[plan.patch_chart], 0, 1) ** 2.2

    samples = lighting.place_samples(patches, config.light_spacing_m)
    lamps = np.array([(*lamp.position, *lamp.colour) for lamp in furnisher.lamps], float).reshape(-1, 6)
    lamp_room = np.array([lamp.room for lamp in furnisher.lamps], np.int32)
    panes = [p for p in patches if p.material.emissive and p.material.casts_shadow]
    covered = np.array([floor_plan.rooms[p.room].curtains_closed for p in panes])
    direct, indirect, valid = lighting.bake(patches, samples, vertices, triangles, triangle_patch, triangle_st, albedo, panes, covered, lamps, lamp_room,
                                 device=device, rays=config.light_rays)  # fmt: skip
    luminance = (direct + indirect)[valid] @ np.array([0.2126, 0.7152, 0.0722])
    reference = float(np.quantile(luminance, 0.7))

    levels = np.geomspace(0.12, 1.12, atlas.LEVELS)
    factors: list[Any] = [np.full((1, 1, 3), levels[0])] * len(plan.charts)
    chart = plan.patch_chart.copy()
    for k, grid in enumerate(lighting.light_grids(samples, direct, indirect, valid)):
        if grid is None:
            factors[chart[k]] = None
        elif patches[k].material.shared:
            tone = float(lighting.to_display(grid, reference).mean())
            chart[k] += int(np.abs(levels - tone).argmin())
        else:
            factors[chart[k]] = lighting.to_display(grid, reference)
    for k, patch in enumerate(patches):
        if patch.material.shared:
            first = plan.patch_chart[k]
            for j in range(atlas.LEVELS):
                factors[first + j] = np.full((1, 1, 3), levels[j])
    texture = atlas.compose(plan, painted, factors)

    return TexturedMesh(
        vertices=vertices.astype(np.float32),
        triangles=triangles.astype(np.int32),
        corner_uvs=_uvs(plan, chart, triangle_patch, triangle_st),
        triangle_texture=np.zeros(len(triangles), np.int32),
        textures=(texture,),
    )


def _assemble(patches: list[Patch]) -> tuple[NDArray[np.floating[Any]], NDArray[np.int64], NDArray[np.int64], NDArray[np.floating[Any]]]:
    """Vertices (V, 3), triangles (T, 3), patch of each triangle (T,), corner coordinates (T, 3, 2)."""
    vertices, triangles, owner, corners, total = [], [], [], [], 0
    for k, patch in enumerate(patches):
        t, st = patch.triangles()
        vertices.append(patch.positions.reshape(-1, 3))
        triangles.append(t + total)
        owner.append(np.full(len(t), k))
        corners.append(st)
        total += len(vertices[-1])
    return np.concatenate(vertices), np.concatenate(triangles), np.concatenate(owner), np.concatenate(corners)


def _uvs(plan: atlas.AtlasPlan, chart: NDArray[np.int64], triangle_patch: NDArray[np.int64], triangle_st: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    size = np.array([(c.width, c.height) for c in plan.charts], float)[chart]
    corner = plan.corners[chart].astype(float)
    texel = corner[triangle_patch][:, None] + triangle_st * size[triangle_patch][:, None]
    return (texel / np.array(plan.size, float)).astype(np.float32)


