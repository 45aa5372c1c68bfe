"""A building in which one room, bay or apartment repeats around a corridor, partly mapped: as levels of games are."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.poses import Float
from wheretolook.scenes.config import ApartmentConfig
from wheretolook_rooms import decor, furniture, large, materials
from wheretolook_rooms.furnishing import arrange
from wheretolook_rooms.large import Furnished
from wheretolook_rooms.layout import Lamp, Layout, Rectangle
from wheretolook_rooms.patches import Patch, join, move
from wheretolook_rooms.plan import DOOR_HEIGHT_M, INNER_WALL_M, Opening, Plan, Room, draw_plan, draw_windows
from wheretolook_rooms.shell import Finish, build_shell
from wheretolook_rooms.style import WALLS, Style

MAX_TRIANGLES = 350_000  # of all copies together
MAX_DIFFERENCE = 0.3  # greatest share of a copy's pictures and furniture that the other copies do not have
GAP_M = 0.5  # between copies side by side: their windows stand out a little


@dataclass(frozen=True)
class Copy:
    """Where one copy of the module stands, which has its door at y = 0, facing +y."""

    quarter_turns: int  # counter-clockwise
    shift: tuple[float, float]  # metres
    mapped: bool  # whether the map has images from it

    def world(self, points: ArrayLike) -> Float:
        """Points (..., 3) of the module where this copy has them."""
        c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[self.quarter_turns]
        turned = np.asarray(points, float) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], float)
        return np.asarray(turned + np.array([*self.shift, 0.0]))

    def floor(self, module: Rectangle) -> Rectangle:
        """The floor that this copy takes."""
        (ax, ay, _), (bx, by, _) = self.world([(*module[:2], 0), (*module[2:], 0)]).tolist()
        return min(ax, bx), min(ay, by), max(ax, bx), max(ay, by)


@dataclass(frozen=True)
class Module:
    """What is repeated: rooms with a door to the corridor at y = 0, within a rectangle below it."""

    plan: Plan
    rectangle: Rectangle
    door: Opening
    door_x: float  # the middle of the door


def building(config: ApartmentConfig, seed: int) -> Furnished:
    """Two to eight copies of a module around a corridor, drawn from the seed; some of them are mapped."""
    return draw_building(config, seed)[0]


def draw_building(config: ApartmentConfig, seed: int) -> tuple[Furnished, Module, list[Copy]]:
    """The same with what is repeated and where it stands; patches of the k-th copy have the rooms of the k-th plan."""
    rng = np.random.default_rng([seed, 6])
    module = _draw_module(rng, config.dark_rooms)
    plan = module.plan
    n_rooms = len(module.plan.rooms)
    style = Style(rng, config.texture_richness, config.clutter)
    shell = build_shell(style, plan)
    layouts = arrange(style, plan)
    common = [patch for layout in layouts for patch in layout.placed(plan.height)]
    triangles = len(join([*shell, *common]).triangles)
    count = max(2, min(int(rng.integers(2, 9)), MAX_TRIANGLES // triangles))
    corridor, copies = _place(rng, module, count)

    patches: list[Patch] = []
    lamps: list[Lamp] = []
    for k, where in enumerate(copies):
        own = Style(np.random.default_rng([seed, 7, k]), config.texture_richness, config.clutter)
        share = float(own.rng.uniform(0, MAX_DIFFERENCE))
        inside = [*shell, *_repainted(own, style, common, share), *_own_furniture(own, layouts, plan.height, share)]
        first = k * n_rooms
        patches += [replace(p, positions=where.world(p.positions), room=first + p.room) for p in inside]
        for lamp in (lamp for layout in layouts for lamp in layout.lamps):
            x, y, z = where.world(lamp.position)
            lamps.append(replace(lamp, position=(x, y, z), room=first + lamp.room))
    windows = [(pane, plan.rooms[pane.room % n_rooms].curtains_closed) for pane, _ in large.panes(patches)]

    found = _furnish_corridor(style, corridor, plan.height, config)
    mapped = (_grown(large.rectangle_of(corridor)), *(c.floor(module.rectangle) for c in copies if c.mapped))
    furnished = Furnished(
        patches + found.patches, lamps + found.lamps, windows, rng, mapped, light_spacing_m=0.15, alike=True
    )
    return furnished, module, copies


def _draw_module(rng: np.random.Generator, dark_rooms: float) -> Module:
    """A room, a bay of a corridor with a wide opening, or a small apartment."""
    kind = str(rng.choice(["room", "bay", "apartment"], p=[0.5, 0.25, 0.25]))
    if kind == "apartment":
        plan = draw_plan(rng, 3, float(rng.uniform(26, 36)), dark_rooms)
    else:
        spans = ((3.4, 6.5), (3.2, 5.5)) if kind == "room" else ((2.4, 4.0), (2.4, 5.0))
        width, depth = (float(rng.uniform(*span)) for span in spans)
        use = str(rng.choice(["living", "bedroom", "study", "kitchen"])) if kind == "room" else "hall"
        room = Room(0, -width / 2, -depth / 2, width / 2, depth / 2, use)
        plan = Plan([room], [], float(rng.uniform(2.5, 3.2)))
        draw_windows(rng, [room])
    top = max(room.y1 for room in plan.rooms)
    left = min(room.x0 for room in plan.rooms)
    right = max(room.x1 for room in plan.rooms)
    low = min(room.y0 for room in plan.rooms)
    for room in plan.rooms:
        room.y0 = room.y0 - top
        room.y1 = room.y1 - top
    outer = [room for room in plan.rooms if room.y1 > -1e-9]
    for room in outer:
        room.openings[2] = [o for o in room.openings[2] if o.kind != "window"]
    front = min(outer, key=lambda room: {"hall": 0, "living": 1, "kitchen": 2}.get(room.kind, 3))
    width = min(float(rng.uniform(1.5, 2.2)), front.width - 0.8) if kind == "bay" else 0.95
    at = float(rng.uniform(0.4 + width / 2, front.width - 0.4 - width / 2))
    door = Opening("wide" if kind == "bay" else "door", at - width / 2, at + width / 2, 0.0, DOOR_HEIGHT_M)
    front.openings[2].append(door)
    return Module(plan, (left, low - top, right, 0.0), door, front.x0 + at)


def _place(rng: np.random.Generator, module: Module, count: int) -> tuple[Room, list[Copy]]:
    """The corridor, with a door for each copy, and the copies: along its sides, and one at each of its ends."""
    left, _, right, _ = module.rectangle
    along = max(1, -(-(count - 2) // 2))
    door_m = module.door.a1 - module.door.a0
    breadth = max(float(rng.uniform(2.0, 5.0)), door_m + 0.8)
    pitch = right - left + GAP_M
    length = max(along * pitch, 3.0)
    corridor = Room(count * len(module.plan.rooms), -length / 2, -breadth / 2, length / 2, breadth / 2, "large")
    slots = [(1, 0.0), (3, 0.0)]
    slots += [(side, (k - (along - 1) / 2) * pitch) for side in (0, 2) for k in range(along)]
    n_mapped = max(1, round(float(rng.uniform(0.3, 1)) * count))
    mapped = set(map(int, rng.permutation(count)[:n_mapped]))
    copies = []
    for k, slot in enumerate(sorted(map(int, rng.permutation(len(slots))[:count]))):
        side, at = slots[slot]
        where = Copy(side, (0.0, 0.0), k in mapped)
        # Just outside of the wall: at a side the middle of the module's front, at an end, which is narrow, its door.
        middle = where.world([module.door_x if side % 2 else (left + right) / 2, 0, 0])[:2]
        wall = (length if side % 2 else breadth) / 2 + INNER_WALL_M
        target = [(at, -wall), (wall, at), (at, wall), (-wall, at)][side]
        where = replace(where, shift=(float(target[0] - middle[0]), float(target[1] - middle[1])))
        copies.append(where)
        x, y, _ = where.world([module.door_x, 0, 0])
        a = corridor.along(side, float(y if side % 2 else x))
        door = replace(module.door, a0=a - door_m / 2, a1=a + door_m / 2, owner=False)
        corridor.openings[side].append(door)
    return corridor, copies


def _repainted(own: Style, style: Style, patches: list[Patch], share: float) -> list[Patch]:
    """The same surfaces, a share of the pictures among them painted again."""
    prints = set(map(id, style.prints))
    repainted = [id(p.material) in prints and own.bernoulli(share) for p in patches]
    return [replace(p, material=own.print()) if new else p for p, new in zip(patches, repainted, strict=True)]


def _own_furniture(own: Style, layouts: list[Layout], height: float, share: float) -> list[Patch]:
    """What one copy has in addition to the content of all copies."""
    patches: list[Patch] = []
    for common in layouts:
        layout = copy(common)
        layout.rng = own.rng
        layout.patches = []
        layout.lamps = []
        layout.footprints = [*common.footprints]
        layout.keep_free = [*common.keep_free]
        layout.on_wall = [[*wall] for wall in common.on_wall]
        pieces = len(common.footprints) + sum(map(len, common.on_wall))
        for _ in range(round(share * pieces)):
            draw = own.rng.random()
            if draw < 0.5:
                large.hang_pictures(own, layout, 1, (0.3, 0.9), 1.55)
            elif draw < 0.7:
                large.stand_by_wall(layout, furniture.bookshelf(own, 0.8, 1.8), (0.8, 0.3, 1.8))
            elif draw < 0.85:
                large.stand_by_wall(layout, furniture.cabinet(own, (0.8, 0.4, 0.9), columns=2), (0.8, 0.44, 0.9))
            else:
                plant = move(decor.plant(own, 1.0, 20, 0.35), shift=(0, 0.35, 0))
                large.stand_by_wall(layout, plant, (0.7, 0.7, 1.0), 0.0)
        patches += layout.placed(height)
    return patches


def _furnish_corridor(style: Style, corridor: Room, height: float, config: ApartmentConfig) -> Furnished:
    rng = style.rng
    wall = materials.plain(rng, style.pick(WALLS))
    floor = large.large_pattern(style)
    finish = Finish([wall] * 4, floor, materials.plain(rng, (0.88, 0.88, 0.87)))
    shell = build_shell(style, Plan([corridor], [], height), [finish])
    layout = Layout(corridor, rng)
    for _ in range(round(corridor.width / 5)):
        large.stand_by_wall(layout, furniture.cabinet(style, (0.9, 0.35, 0.85), columns=2), (0.9, 0.38, 0.9), 0.3)
    large.hang_pictures(style, layout, round(corridor.width * config.texture_richness / 3), (0.4, 1.0), 1.55)
    large.ceiling_lamps(style, layout, height, 3.5, config.dark_rooms)
    return Furnished(shell + layout.placed(height), layout.lamps, [], rng)


def _grown(rectangle: Rectangle) -> Rectangle:
    """A rectangle that takes the doorways around it in."""
    x0, y0, x1, y1 = rectangle
    return x0 - INNER_WALL_M, y0 - INNER_WALL_M, x1 + INNER_WALL_M, y1 + INNER_WALL_M
