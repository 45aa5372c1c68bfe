"""An open court between facades, lit by the sky and on some days by the sun."""

from __future__ import annotations

import numpy as np

from wheretolook.scenes.config import ApartmentConfig
from wheretolook_rooms import decor, furniture, large, materials
from wheretolook_rooms.large import Furnished
from wheretolook_rooms.layout import Layout
from wheretolook_rooms.materials import Material
from wheretolook_rooms.patches import Patch, box, move, plane
from wheretolook_rooms.plan import Opening, Plan
from wheretolook_rooms.shell import REVEAL_M, Finish, build_shell, reveal, wall_items
from wheretolook_rooms.style import ACCENTS, WALLS, Style


def court(config: ApartmentConfig, seed: int) -> Furnished:
    """A court of 12 to 40 m between facades of two to four storeys, drawn from the seed."""
    rng = np.random.default_rng([seed, 5])
    width = rng.uniform(12, 40)
    storey = rng.uniform(2.9, 3.6)
    n_storeys = int(rng.integers(2, 5))
    height = storey * n_storeys
    room = large.one_room(width, rng.uniform(0.5, 1) * width)
    style = Style(rng, config.texture_richness, config.clutter)
    stone = materials.plain(rng, (0.78, 0.76, 0.71), shared=True)
    ground = (
        materials.plain(rng, (0.5, 0.48, 0.44), speckle=0.05) if style.bernoulli(0.2) else large.large_pattern(style)
    )
    finish = Finish([_facade(style) for _ in range(4)], ground, stone)

    windows: list[Patch] = []
    glass = [materials.plain(rng, colour, mottle=0.04) for colour in ((0.1, 0.12, 0.15), (0.2, 0.23, 0.26))]
    glass.append(materials.fabric(rng, (0.75, 0.72, 0.65), second=(0.6, 0.58, 0.5), pattern="stripes"))
    for side in range(4):
        bay = rng.uniform(2.6, 4.5)
        opening = rng.uniform(0.3, 0.5) * bay
        for floor in range(0 if style.bernoulli(0.5) else 1, n_storeys):
            large.add_windows(room, side, bay, opening, floor * storey + 0.9, (floor + 0.8) * storey)
        for o in room.openings[side]:
            windows += wall_items(room, side, (o.a0 + o.a1) / 2, _window(style, o, stone, style.pick(glass)))
        for z in storey * np.arange(1, n_storeys + 1):
            half = room.wall_length(side) / 2
            windows += wall_items(room, side, half, box((-half, 0, z - 0.2), (half, 0.08, z - 0.05), stone))
    shell = build_shell(style, Plan([room], [], height), [finish], open_air=True)

    layout = Layout(room, rng)
    large.hang_doors(style, layout, 6)
    bench = [lambda at: large.stand_on_floor(at, furniture.table(style, 1.7, 0.5, 0.45, style.wood), 1.7, 1.0)]
    beds = [lambda at: large.stand_on_floor(at, _bed(style), 2.0, 2.0)]
    pieces = [*large.mixed_furniture(style), *bench, *beds * 3]
    for _ in range(round(room.area / 60 * (0.4 + config.clutter)) + 3):
        style.pick(pieces)(layout)
    large.hang_pictures(style, layout, round(width / 4 * config.texture_richness), (0.8, 2.5), 1.8)
    patches = shell + windows + layout.placed(height)
    sky = large.sky(room.width, room.depth, height)
    return Furnished(patches, large.sun(rng), [(sky, False)], rng, periods_m=(1.0, 6.0), light_spacing_m=0.3)


def _facade(style: Style) -> Material:
    """Plaster, brick or large stones."""
    rng = style.rng
    colour = materials.vary(rng, style.pick((*WALLS, *ACCENTS)), 0.04)
    if style.bernoulli(0.3):
        return materials.plain(rng, colour, mottle=0.02, speckle=0.02)
    if style.bernoulli(0.5):
        brick = materials.vary(rng, (0.58, 0.36, 0.28), 0.04)
        return materials.tiles(rng, brick, (0.7, 0.68, 0.64), size_m=(0.4, 0.14), variation=0.08, brick=True)
    return large.large_pattern(style)


def _window(style: Style, o: Opening, stone: Material, glass: Material) -> list[Patch]:
    """A window without light behind it, in the furniture frame around its middle."""
    w = (o.a1 - o.a0) / 2
    y = -REVEAL_M
    patches = reveal(REVEAL_M, o, stone, stone)
    patches.append(plane((w, y, o.z1), (-2 * w, 0, 0), (0, 0, o.z0 - o.z1), glass))
    middle = (o.z0 + o.z1) / 2
    for low, high in (((-0.03, o.z0), (0.03, o.z1)), ((-w, middle - 0.03), (w, middle + 0.03))):
        patches += box((low[0], y + 0.004, low[1]), (high[0], y + 0.05, high[1]), style.small_white, hidden=("back",))
    return patches + box((-w - 0.1, -0.02, o.z0 - 0.08), (w + 0.1, 0.09, o.z0 + 0.004), stone, hidden=("back",))


def _bed(style: Style) -> list[Patch]:
    """A raised flower bed with a tall plant."""
    plant = decor.plant(style, style.rng.uniform(1.5, 3), 30, 0.9)
    return large.pool(style, 0, 0, 1.0) + move(plant, shift=(0, 0, 0.45))
