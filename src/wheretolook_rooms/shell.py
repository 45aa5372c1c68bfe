"""Walls, floors, ceilings, door frames, skirting and windows: a closed shell around the rooms of a plan."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from wheretolook_rooms import artwork, fixtures, materials
from wheretolook_rooms.materials import Material
from wheretolook_rooms.patches import Patch, box, move, plane, tube
from wheretolook_rooms.plan import INNER_WALL_M, Opening, Plan, Room
from wheretolook_rooms.style import ACCENTS, WALLS, Style

WALL_ENDS = ("back", "bottom", "left", "right")
REVEAL_M = 0.16  # how deep a window sits in the wall


@dataclass(frozen=True, eq=False)
class Finish:
    """Surface materials of one room: four walls, floor, ceiling."""

    walls: list[Material]
    floor: Material
    ceiling: Material


def choose_finish(style: Style, room: Room) -> Finish:
    """Paint, paper or tiles for a room of its kind."""
    rng = style.rng
    colour = materials.vary(rng, style.pick(WALLS), 0.012)
    paint = materials.plain(rng, colour)
    walls = [paint] * 4
    ceiling = materials.plain(rng, (0.92, 0.92, 0.91))
    width_m = float(rng.uniform(0.12, 0.2))
    length_m = float(rng.uniform(1.1, 1.8))
    contrast = 0.6 + 1.6 * style.richness
    along_x = room.width > room.depth
    floor = materials.planks(rng, style.floor_colour, width_m, length_m, contrast, along_x)
    if room.kind == "bathroom":
        walls = [_bathroom_tiles(style)] * 4
        second = (0.38, 0.40, 0.42) if style.bernoulli(0.4) else None
        veins = 0.8 * style.richness
        size = (0.3, 0.3)
        floor = materials.tiles(rng, (0.62, 0.62, 0.60), (0.48, 0.48, 0.47), size_m=size, veins=veins, second=second)
    elif room.kind == "kitchen":
        tile = materials.vary(rng, (0.70, 0.66, 0.60))
        second = (0.55, 0.48, 0.42) if style.bernoulli(0.3) else None
        veins = 0.9 * style.richness
        floor = materials.tiles(rng, tile, (0.52, 0.50, 0.47), size_m=(0.4, 0.4), veins=veins, second=second)
    if room.kind in ("living", "study") and style.bernoulli(0.6):
        walls[int(rng.integers(4))] = materials.plain(rng, materials.vary(rng, style.pick(ACCENTS), 0.02))
    papered = {"bedroom": 0.4, "hall": 0.2, "living": 0.15, "study": 0.15}.get(room.kind, 0.0)
    if style.bernoulli(papered + 0.3 * style.richness) and room.kind not in ("bathroom", "kitchen"):
        second = materials.vary(rng, style.pick(ACCENTS), 0.03)
        period_m = float(rng.uniform(0.12, 0.24))
        paper = materials.wallpaper(rng, colour, second, period_m=period_m, motif=style.bernoulli(0.6))
        side = int(rng.integers(4))
        if style.bernoulli(0.3):
            walls = [paper] * 4
        else:
            walls[side] = paper
    if room.kind == "bedroom" and style.bernoulli(0.4):
        floor = materials.plain(rng, materials.vary(rng, (0.62, 0.57, 0.50)), speckle=0.03 + 0.07 * style.richness)
    return Finish(walls, floor, ceiling)


def _bathroom_tiles(style: Style) -> Material:
    rng = style.rng
    richness = style.richness
    size = style.pick([(0.3, 0.6), (0.2, 0.2), (0.3, 0.3), (0.15, 0.15)])
    tile = materials.vary(rng, style.pick([(0.90, 0.91, 0.90), (0.72, 0.80, 0.82), (0.84, 0.80, 0.72)]), 0.02)
    brick = style.bernoulli(0.3)
    grout = (0.62, 0.62, 0.60)
    every = int(rng.integers(3, 8)) if style.bernoulli(0.3 + 0.6 * richness) else 0
    return materials.tiles(rng, tile, grout, size_m=size, brick=brick, veins=0.5 * richness, decor_every=every)


def _wall(room: Room, side: int, height: float, material: Material) -> Patch:
    """A wall with holes for its openings."""
    corner, right, _ = room.wall_frame(side)
    length = room.wall_length(side)
    openings = room.openings[side]
    a = np.unique([0.0, length, *(x for o in openings for x in (o.a0, o.a1))])
    z = np.unique([0.0, height, *(x for o in openings for x in (o.z0, o.z1))])[::-1]
    mask = np.ones((len(z) - 1, len(a) - 1), bool)
    for o in openings:
        columns = (a[:-1] > o.a0 - 1e-9) & (a[1:] < o.a1 + 1e-9)
        rows = (z[1:] > o.z0 - 1e-9) & (z[:-1] < o.z1 + 1e-9)
        mask[np.ix_(rows, columns)] = False
    positions = corner + a[None, :, None] * right + z[:, None, None] * np.array([0, 0, 1.0])
    s = a / length
    t = 1 - z / height
    offset = (3.1 * side, 0.0)
    return Patch(positions, s, t, (length, height), material, room=room.index, mask=mask, offset_m=offset)


def wall_items(room: Room, side: int, at: float, patches: list[Patch]) -> list[Patch]:
    """Patches of the furniture frame, moved against a wall of a room with x = 0 at wall coordinate `at`."""
    corner, right, normal = room.wall_frame(side)
    rotation = np.stack([-right, normal, [0, 0, 1]], 1)
    return [replace(p, room=room.index) for p in move(patches, rotation=rotation, shift=corner + at * right)]


def reveal(depth: float, o: Opening, material: Material, sill: Material | None) -> list[Patch]:
    """Inner faces of an opening, in the furniture frame around its middle."""
    w = (o.a1 - o.a0) / 2
    patches = [
        plane((w, 0, o.z1), (0, -depth, 0), (0, 0, o.z0 - o.z1), material),  # faces -x
        plane((-w, -depth, o.z1), (0, depth, 0), (0, 0, o.z0 - o.z1), material),
        plane((-w, -depth, o.z1), (2 * w, 0, 0), (0, depth, 0), material),  # head, faces down
    ]
    if sill is not None:
        patches.append(plane((-w, 0, o.z0), (2 * w, 0, 0), (0, -depth, 0), sill))
    return patches


def _architrave(style: Style, o: Opening) -> list[Patch]:
    """Frame around a door."""
    w = (o.a1 - o.a0) / 2
    face = 0.07
    thick = 0.018
    patches: list[Patch] = []
    for x0, x1 in ((-w - face, -w), (w, w + face)):
        patches += box((x0, 0, 0), (x1, thick, o.z1 + face), style.trim, hidden=("back", "bottom"))
    return patches + box((-w, 0, o.z1), (w, thick, o.z1 + face), style.trim, hidden=("back",))


def _window(style: Style, room: Room, o: Opening, height: float, cloth: Material) -> list[Patch]:
    """Pane that shows the view, frame, sill and, except in bathrooms and kitchens, curtains."""
    w = (o.a1 - o.a0) / 2
    y = -REVEAL_M
    bar = 0.05
    frame = style.trim
    patches = reveal(REVEAL_M, o, frame, frame)
    patches.append(plane((w, y, o.z1), (-2 * w, 0, 0), (0, 0, o.z0 - o.z1), artwork.view(style.rng), density=0.9))
    for z0, z1 in ((o.z0, o.z0 + bar), (o.z1 - bar, o.z1)):
        patches += box((-w, y + 0.004, z0), (w, y + bar, z1), frame, hidden=("back",))
    for x in np.linspace(-w + bar / 2, w - bar / 2, 2 if w < 0.45 else 3):
        low = (x - bar / 2, y + 0.004, o.z0 + bar)
        high = (x + bar / 2, y + bar, o.z1 - bar)
        patches += box(low, high, frame, hidden=("back",))
    patches += box((-w - 0.04, -0.02, o.z0 - 0.03), (w + 0.04, 0.05, o.z0 + 0.004), frame, hidden=("back",))
    if room.kind in ("bathroom", "kitchen", "large"):
        return patches
    top = min(o.z1 + 0.18, height - 0.05)
    patches += tube([(-w - 0.35, 0.1, top + 0.015), (w + 0.35, 0.1, top + 0.015)], 0.012, style.metal, sides=10)
    width, x = (w + 0.25, (w + 0.25) / 2) if room.curtains_closed else (0.38, w + 0.08)
    for sign in (-1, 1):
        patches += move(fixtures.curtain(width, top - 0.03, cloth), shift=(sign * x, 0.1, top))
    return patches


def build_shell(style: Style, plan: Plan, finishes: list[Finish] | None = None, open_air: bool = False) -> list[Patch]:
    """All surfaces of the empty apartment; without finishes, one is chosen for each room.

    In the `open_air`, there are no ceilings, and what fills the windows is left to others.
    """
    finishes = finishes or [choose_finish(style, room) for room in plan.rooms]
    patches: list[Patch] = []
    if style.bernoulli(0.25 + 0.4 * style.richness):
        cloth = style.patterned()
    else:
        cloth = materials.fabric(style.rng, materials.vary(style.rng, (0.80, 0.76, 0.68), 0.05), weave=0.02)
    for room, finish in zip(plan.rooms, finishes, strict=True):
        x0 = room.x0
        y0 = room.y0
        y1 = room.y1
        right = (room.width, 0, 0)
        up = (0, -room.depth, 0)
        down = (0, room.depth, 0)
        offset = (x0 + 20, 20 - y1)
        patches.append(plane((x0, y1, 0), right, up, finish.floor, room=room.index, offset_m=offset))
        if not open_air:
            patches.append(plane((x0, y0, plan.height), right, down, finish.ceiling, room=room.index, density=0.7))
        for side in range(4):
            patches.append(_wall(room, side, plan.height, finish.walls[side]))
            if room.kind != "bathroom":
                patches += _skirting(style, room, side)
            for o in room.openings[side]:
                parts: list[Patch] = []
                if o.kind == "window" and not open_air:
                    parts = _window(style, room, o, plan.height, cloth)
                if o.kind == "door":
                    parts = _architrave(style, o)
                if o.kind != "window" and o.owner:
                    jamb = style.trim if o.kind == "door" else finish.walls[side]
                    parts += reveal(INNER_WALL_M, o, jamb, style.second_wood)
                patches += wall_items(room, side, (o.a0 + o.a1) / 2, parts)
    return patches


def _skirting(style: Style, room: Room, side: int) -> list[Patch]:
    """Boards along the foot of a wall, between the openings that reach the floor."""
    patches: list[Patch] = []
    gaps = sorted((o.a0 - 0.07, o.a1 + 0.07) for o in room.openings[side] if o.z0 == 0)
    at = 0.0
    for low, high in [*gaps, (room.wall_length(side), 0.0)]:
        if low - at > 0.03:
            half = (low - at) / 2
            board = box((-half, 0, 0), (half, 0.012, 0.07), style.trim, hidden=WALL_ENDS, density=0.7)
            patches += wall_items(room, side, at + half, board)
        at = high
    return patches
