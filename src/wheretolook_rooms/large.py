"""What halls, offices, courts and buildings have in common: rows of windows and lamps, things here and there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from wheretolook_rooms import artwork, decor, fixtures, furniture, materials
from wheretolook_rooms.layout import Lamp, Layout, Rectangle
from wheretolook_rooms.materials import Material
from wheretolook_rooms.patches import Patch, box, movable, move, plane
from wheretolook_rooms.plan import Opening, Room
from wheretolook_rooms.style import FRONTS, WALLS, Style

SUN_M = 300.0  # distance of the lamp that is the sun


@dataclass(frozen=True, eq=False)
class Furnished:
    """A scene before it is painted and lit.

    Attributes:
        patches: all surfaces.
        lamps: that are lit.
        windows: panes that light comes through, and whether a curtain is drawn before them.
        rng: paints it.
        mapped: floor that the map is to be made from, (x0, y0, x1, y1) in metres; empty for all of it.
        periods_m: least and greatest side of patterns that repeat; None where nothing is to repeat.
        alike: whether surfaces of one material and size repeat the same pattern, as in copies of a room.
        light_spacing_m: least distance between light samples.
    """

    patches: list[Patch]
    lamps: list[Lamp]
    windows: list[tuple[Patch, bool]]
    rng: np.random.Generator
    mapped: tuple[Rectangle, ...] = ()
    periods_m: tuple[float, float] | None = (0.6, 2.0)
    alike: bool = False
    light_spacing_m: float = 0.0


def one_room(width: float, depth: float) -> Room:
    """A large room in the middle of the world, still without doors and windows."""
    return Room(0, -width / 2, -depth / 2, width / 2, depth / 2, "large")


def add_windows(room: Room, side: int, bay_m: float, width_m: float, z0: float, z1: float) -> None:
    """A row of windows in a wall, one in the middle of each of the bays of about `bay_m` that it has."""
    length = room.wall_length(side)
    count = max(1, int(length / bay_m))
    for at in (np.arange(count) + 0.5) * length / count:
        room.openings[side].append(Opening("window", at - width_m / 2, at + width_m / 2, z0, z1))


def panes(patches: list[Patch]) -> list[tuple[Patch, bool]]:
    """The window panes among some patches, without curtains."""
    return [(patch, False) for patch in patches if patch.material.emissive and patch.material.casts_shadow]


def large_pattern(style: Style) -> Material:
    """A wall or floor of large tiles or broad paper, which repeats after one to some metres."""
    rng = style.rng
    colour = materials.vary(rng, style.pick(WALLS), 0.06)
    second = materials.vary(rng, style.pick(FRONTS), 0.06)
    side = rng.uniform(0.8, 2.5)
    if style.bernoulli(0.3):
        return materials.wallpaper(rng, colour, second, period_m=side, motif=True)
    size = (side, side * rng.uniform(0.5, 1))
    every = int(rng.integers(2, 6)) if style.bernoulli(0.5) else 0
    chequered = second if style.bernoulli(0.4) else None
    veins = style.richness * rng.uniform(0.5, 2)
    brick = style.bernoulli(0.4)
    grout = (0.5, 0.49, 0.47)
    return materials.tiles(
        rng, colour, grout, size_m=size, second=chequered, veins=veins, brick=brick, decor_every=every
    )


def ceiling_lamps(style: Style, layout: Layout, height: float, pitch_m: float, dark: float) -> None:
    """Lamps in rows on the ceiling, of which a share is `dark`."""
    room = layout.room
    nx, ny = (max(1, round(extent / pitch_m)) for extent in (room.width, room.depth))
    w = 0.3
    d = 0.6
    off = materials.plain(style.rng, (0.86, 0.85, 0.82))
    for x in room.x0 + (np.arange(nx) + 0.5) * room.width / nx:
        for y in room.y0 + (np.arange(ny) + 0.5) * room.depth / ny:
            lit = not style.bernoulli(dark) or len(layout.lamps) == 0
            glass = materials.glow((1.0, 0.97, 0.9)) if lit else off
            faces = {"bottom": glass}
            layout.patches += box(
                (x - w, y - d, height - 0.06), (x + w, y + d, height), off, faces=faces, hidden=("top",)
            )
            if lit:
                layout.add_lamp(x, y, height - 0.2, 0.12 * pitch_m**2 * max(1.0, height / 3) ** 2)


def stand_on_floor(layout: Layout, patches: list[Patch], width: float, depth: float, margin: float = 0.9) -> bool:
    """Stand something centred on the origin where there is room on the floor, as it is or turned; whether there was."""
    turned = bool(layout.rng.random() < 0.5)
    w, d = (depth, width) if turned else (width, depth)
    spot = layout.find_on_floor(w, d, margin)
    if spot is None:
        return False
    layout.patches += move(patches, angle_rad=np.pi / 2 if turned else 0.0, shift=(*spot, 0))
    layout.footprints.append((spot[0] - w / 2, spot[1] - d / 2, spot[0] + w / 2, spot[1] + d / 2))
    return True


def stand_by_wall(layout: Layout, patches: list[Patch], size: tuple[float, float, float], front: float = 0.5) -> None:
    """Stand something of the furniture frame at a wall, if there is a place."""
    spot = layout.find_by_wall(size, "any", front)
    if spot is not None:
        layout.put_by_wall(patches, spot)


def hang_pictures(style: Style, layout: Layout, count: int, sizes_m: tuple[float, float], middle_m: float) -> None:
    """Hang framed pictures, as far as there is bare wall."""
    for _ in range(count):
        width, height = (float(v) for v in style.rng.uniform(*sizes_m, 2))
        height = min(height, 2 * middle_m - 0.8)
        side = int(style.rng.integers(4))
        at = layout.hang(width, middle_m - height / 2, middle_m + height / 2, side)
        if at is not None:
            layout.put_on_wall(side, at, move(decor.picture_frame(style, width, height), shift=(0, 0, middle_m)))


def hang_doors(style: Style, layout: Layout, count: int) -> None:
    """Closed doors in the walls; the floor before them stays free."""
    for _ in range(count):
        side = int(style.rng.integers(4))
        at = float(style.rng.uniform(0.9, layout.room.wall_length(side) - 0.9))
        if layout.wall_is_clear(side, at - 0.6, at + 0.6, 0, 2.2):
            layout.put_on_wall(side, at, fixtures.front_door(style, 0.95, 2.05))
            layout.add_door(side, at - 0.475, at + 0.475, 2.1)


@movable
def block(style: Style, width: float, depth: float, height: float) -> list[Patch]:
    """A closed block with pictures on its front and back: a panel of an exhibition, a stall, a container."""
    low = (-width / 2, -depth / 2, 0)
    high = (width / 2, depth / 2, height)
    return box(low, high, style.front, faces={"front": style.print(), "back": style.print()})


def mixed_furniture(style: Style) -> list[Callable[[Layout], object]]:
    """What stands in large rooms and courts, each piece to be put into a layout as often as one likes."""
    uniform = style.rng.uniform
    return [
        lambda at: stand_on_floor(at, block(style, 2.4, 0.12, float(uniform(1.9, 2.5))), 2.4, 0.12),
        lambda at: stand_on_floor(at, block(style, 1.2, 1.2, float(uniform(0.8, 2.4))), 1.2, 1.2),
        lambda at: stand_on_floor(at, decor.plant(style, float(uniform(1.2, 2.2)), 26, 0.5), 1.0, 1.0),
        lambda at: stand_on_floor(at, move(furniture.sofa(style, 3), shift=(0, -0.45, 0)), 2.3, 0.95),
        lambda at: stand_on_floor(at, _table(style), 1.7, 2.0),
        lambda at: stand_by_wall(at, furniture.bookshelf(style, 1.2, 2.0), (1.2, 0.3, 2.0)),
        lambda at: stand_by_wall(at, furniture.cabinet(style, (1.2, 0.42, 0.9), columns=3), (1.2, 0.46, 0.9)),
    ]


def _table(style: Style) -> list[Patch]:
    """A table and four chairs."""
    patches = move(furniture.table(style, 1.6, 0.8, 0.75, style.second_wood), shift=(0, -0.4, 0))
    for x in (-0.4, 0.4):
        for sign, angle in ((-1, 0.0), (1, np.pi)):
            chair = furniture.chair(style, style.wood, style.upholstery)
            patches += move(chair, angle_rad=angle, shift=(x, 0.55 * sign, 0))
    return patches + move(decor.bowl(style, 0.13, True), shift=(0, 0, 0.75))


def rectangle_of(room: Room) -> Rectangle:
    """The floor of a room."""
    return room.x0, room.y0, room.x1, room.y1


def pillar(x: float, y: float, half_m: float, height: float, material: Material) -> list[Patch]:
    """A square pillar from the floor to the ceiling."""
    low = (x - half_m, y - half_m, 0)
    high = (x + half_m, y + half_m, height)
    return box(low, high, material, hidden=("top", "bottom"))


def pool(style: Style, x: float, y: float, half_m: float) -> list[Patch]:
    """A square flower bed or basin, 0.45 m high."""
    earth = materials.plain(style.rng, style.pick([(0.30, 0.40, 0.22), (0.35, 0.27, 0.2)]), speckle=0.15)
    return box((x - half_m, y - half_m, 0), (x + half_m, y + half_m, 0.45), style.small_wood, faces={"top": earth})


def sky(width: float, depth: float, height: float) -> Patch:
    """A pane above a court that light comes through and that is not part of the scene."""
    w = width / 2 + 15
    d = depth / 2 + 15
    z = height + 12
    return plane((-w, -d, z), (2 * w, 0, 0), (0, 2 * d, 0), artwork.view(np.random.default_rng(0)))


def sun(rng: np.random.Generator) -> list[Lamp]:
    """The sun, or on half of the days none."""
    azimuth = rng.uniform(0, 2 * np.pi)
    elevation = rng.uniform(0.6, 1.3)
    if rng.random() < 0.5:
        return []
    x = SUN_M * np.cos(elevation) * np.cos(azimuth)
    y = SUN_M * np.cos(elevation) * np.sin(azimuth)
    red, green, blue = (strength * SUN_M**2 for strength in (8.0, 7.4, 6.4))
    return [Lamp((x, y, SUN_M * np.sin(elevation)), 0, (red, green, blue))]
