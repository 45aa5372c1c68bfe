"""A bare office: plain walls, the same desk again and again, next to nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wheretolook.scenes.config import ApartmentConfig
from wheretolook_rooms import furniture, large, materials
from wheretolook_rooms.large import Furnished
from wheretolook_rooms.layout import Layout
from wheretolook_rooms.patches import move
from wheretolook_rooms.plan import Plan
from wheretolook_rooms.shell import Finish, build_shell
from wheretolook_rooms.style import TEXTILES, WALLS, Style


def office(config: ApartmentConfig, seed: int) -> Furnished:
    """An office of 8 to 24 m, 2.6 to 3.3 m high, drawn from the seed."""
    rng = np.random.default_rng([seed, 4])
    config = replace(config, texture_richness=0.3 * config.texture_richness, clutter=0.2 * config.clutter)
    width, depth, height = (rng.uniform(*span) for span in ((8, 24), (6, 14), (2.6, 3.3)))
    room = large.one_room(width, depth)
    style = Style(rng, config.texture_richness, config.clutter)
    for side in map(int, rng.permutation(4)[: rng.integers(1, 3)]):
        bay = rng.uniform(1.8, 3)
        large.add_windows(room, side, bay, bay - 0.4, 0.9, 2.2)
    paint = materials.plain(rng, materials.vary(rng, style.pick(WALLS), 0.02))
    carpet = materials.plain(rng, materials.vary(rng, style.pick(TEXTILES), 0.03), speckle=0.02)
    ceiling = materials.tiles(rng, (0.9, 0.9, 0.89), (0.8, 0.8, 0.79), size_m=(0.6, 0.6))
    shell = build_shell(style, Plan([room], [], height), [Finish([paint] * 4, carpet, ceiling)])

    layout = Layout(room, rng)
    large.hang_doors(style, layout, 2)
    _desks(style, layout)
    cabinet = furniture.cabinet(style, (0.9, 0.42, 1.2), columns=2, rows=2)
    for _ in range(int(rng.integers(0, 5))):
        large.stand_by_wall(layout, cabinet, (0.9, 0.46, 1.2), 0.3)
    large.hang_pictures(style, layout, int(rng.integers(0, 4)), (0.4, 0.9), 1.55)
    large.ceiling_lamps(style, layout, height, 3.0, config.dark_rooms)
    patches = shell + layout.placed(height)
    return Furnished(patches, layout.lamps, large.panes(patches), rng, periods_m=None, light_spacing_m=0.15)


def _desks(style: Style, layout: Layout) -> None:
    """Blocks of the same desk, in two rows back to back, evenly over the floor."""
    room = layout.room
    count = int(style.rng.integers(2, 4))
    width = 1.4
    chair = furniture.chair(style, style.wood, style.upholstery)
    desk = furniture.desk(style, width) + move(chair, angle_rad=np.pi, shift=(0.05, 0.85, 0))
    size = count * width, 2.5
    nx, ny = (max(1, int((e - 1.2) / (s + 1.3))) for e, s in zip((room.width, room.depth), size, strict=True))
    for x in room.x0 + (np.arange(nx) + 0.5) * room.width / nx:
        for y in room.y0 + (np.arange(ny) + 0.5) * room.depth / ny:
            footprint = x - size[0] / 2, y - size[1] / 2, x + size[0] / 2, y + size[1] / 2
            if not layout.is_clear(footprint):
                continue
            layout.footprints.append(footprint)
            for k in range(count):
                at = (k - (count - 1) / 2) * width
                for angle in (0.0, np.pi):
                    if style.bernoulli(0.92):
                        layout.patches += move(move(desk, angle_rad=angle, shift=(at, 0, 0)), shift=(x, y, 0))
