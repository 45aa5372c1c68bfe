"""One large hall, sparsely furnished, whose walls and floor repeat large patterns."""

from __future__ import annotations

import numpy as np

from wheretolook.scenes.config import ApartmentConfig
from wheretolook_rooms import large, materials
from wheretolook_rooms.large import Furnished
from wheretolook_rooms.layout import Layout
from wheretolook_rooms.plan import Plan
from wheretolook_rooms.shell import Finish, build_shell
from wheretolook_rooms.style import WALLS, Style


def hall(config: ApartmentConfig, seed: int) -> Furnished:
    """A hall of 14 to 40 m, 4 to 9 m high, drawn from the seed."""
    rng = np.random.default_rng([seed, 3])
    width = rng.uniform(14, 40)
    height = rng.uniform(4, 9)
    room = large.one_room(width, rng.uniform(0.35, 0.8) * width)
    style = Style(rng, config.texture_richness, config.clutter)
    for side in map(int, rng.permutation(4)[: rng.integers(1, 3)]):
        bay = rng.uniform(3, 5)
        large.add_windows(room, side, bay, bay * rng.uniform(0.4, 0.7), 0.45 * height, 0.85 * height)

    plain = materials.plain(rng, materials.vary(rng, style.pick(WALLS), 0.03))
    walls = [large.large_pattern(style) if style.bernoulli(0.4 + 0.4 * style.richness) else plain for _ in range(4)]
    finish = Finish(walls, large.large_pattern(style), materials.plain(rng, (0.85, 0.85, 0.84)))
    shell = build_shell(style, Plan([room], [], height), [finish])

    layout = Layout(room, rng)
    large.hang_doors(style, layout, 3)
    if style.bernoulli(0.6):
        _pillars(style, layout, height)
    pieces = large.mixed_furniture(style)
    for _ in range(round(room.area / 60 * (0.5 + config.clutter)) + 3):
        style.pick(pieces)(layout)
    large.hang_pictures(style, layout, round(width / 3 * config.texture_richness), (0.8, 3.0), 2.0)
    large.ceiling_lamps(style, layout, height, max(4.0, height), config.dark_rooms)
    patches = shell + layout.placed(height)
    return Furnished(patches, layout.lamps, large.panes(patches), rng, periods_m=(1.0, 6.0), light_spacing_m=0.25)


def _pillars(style: Style, layout: Layout, height: float) -> None:
    room = layout.room
    half = style.rng.uniform(0.2, 0.45)
    material = style.pick([large.large_pattern(style), style.front])
    nx = round(room.width / 7)
    ny = max(2, round(room.depth / 7))
    for x in room.x0 + np.arange(1, nx) * room.width / nx:
        for y in room.y0 + np.arange(1, ny) * room.depth / ny:
            footprint = x - half, y - half, x + half, y + half
            if layout.is_clear(footprint):
                layout.patches += large.pillar(x, y, half, height, material)
                layout.footprints.append(footprint)
