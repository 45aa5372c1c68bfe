"""Adds to a furnished room what every kind of room has: plants, pictures, shelves, radiators, the ceiling lamp."""

from __future__ import annotations

from dataclasses import replace

from wheretolook.scenes.procedural import decor, fixtures, furniture, materials
from wheretolook.scenes.procedural.layout import Layout, overlap
from wheretolook.scenes.procedural.patches import cylinder, lathe, move, tube
from wheretolook.scenes.procedural.style import Style


def dress(style: Style, layout: Layout, height: float) -> None:
    """Add all of it; `height` is that of the ceiling in metres."""
    _plants(style, layout)
    _wall_shelves(style, layout)
    _pictures(style, layout)
    _radiators(style, layout)
    _ceiling_lamp(style, layout, height)


def _plants(style: Style, layout: Layout) -> None:
    if layout.room.kind in ("bathroom", "hall"):
        return
    for _ in range(int(style.rng.integers(0, 2 + round(style.clutter)))):
        height = float(style.rng.uniform(0.7, 1.4))
        spot = layout.find_by_wall((0.7, 0.7, 0.8), "corner", front=0.0)
        if spot is not None:
            plant = move(decor.plant(style, height, 30, 0.35), shift=(0, 0.35, 0))
            layout.put_by_wall(plant, replace(spot, size=(0.7, 0.7, height)))


def _pictures(style: Style, layout: Layout) -> None:
    if layout.room.kind == "bathroom":
        return
    for side in range(4):
        if not style.chance(0.45 + 0.5 * style.richness):
            continue
        for _ in range(int(style.rng.integers(1, 3 + round(1.5 * style.richness)))):
            width, height = float(style.rng.uniform(0.35, 1.2)), float(style.rng.uniform(0.35, 0.85))
            middle = float(style.rng.uniform(1.45, 1.65))
            at = layout.hang(width, middle - height / 2, middle + height / 2, side)
            if at is not None:
                layout.put_on_wall(side, at, move(decor.picture_frame(style, width, height), shift=(0, 0, middle)))


def _wall_shelves(style: Style, layout: Layout) -> None:
    if layout.room.kind in ("bathroom", "hall"):
        return
    for side in range(4):
        if style.chance(0.2 + 0.5 * style.clutter):
            width, height = float(style.rng.uniform(0.7, 1.3)), float(style.rng.uniform(1.3, 1.6))
            at = layout.hang(width, height - 0.05, height + 0.4, side, depth=0.25)
            if at is not None:
                layout.put_on_wall(side, at, move(furniture.wall_shelf(style, width), shift=(0, 0, height)))


def _radiators(style: Style, layout: Layout) -> None:
    room = layout.room
    for side in range(4):
        for o in room.openings[side]:
            width = o.a1 - o.a0 - (0.2 if room.kind in ("kitchen", "bathroom") else 0.75)
            middle = (o.a0 + o.a1) / 2
            zone = layout.rectangle(side, middle - width / 2, middle + width / 2, 0, 0.2)
            free = not any(overlap(zone, f) for f in layout.footprints)
            if o.kind == "window" and o.z0 > 0.7 and width > 0.3 and free and not room.curtains_closed:
                layout.put_on_wall(side, middle, fixtures.radiator(style, width, min(0.5, o.z0 - 0.25)))


def _ceiling_lamp(style: Style, layout: Layout, top: float) -> None:
    """One lamp in the middle of the ceiling, or two in a long room."""
    room = layout.room
    lit = room.lamp_on
    x, y = room.centre
    dx, dy = (room.width / 4, 0.0) if room.width > room.depth else (0.0, room.depth / 4)
    centres = [(x - dx, y - dy), (x + dx, y + dy)] if max(room.width, room.depth) > 5.5 else [(x, y)]
    pendant = room.kind in ("living", "kitchen", "bedroom", "study") and style.chance(0.5)
    for x, y in centres:
        glass = materials.glow((1.0, 0.96, 0.87)) if lit else materials.plain(style.rng, (0.86, 0.85, 0.82))
        if pendant:
            parts = tube([(0, 0, top), (0, 0, top - 0.2), (0, 0, top - 0.4)], 0.004, style.black, sides=6)
            parts += decor.shade(style, 0.22, 0.2, top - 0.6, lit)
            parts += cylinder(0.05, top - 0.02, top, style.small_white, sides=16)
            height = top - 0.55
        else:
            profile = [(0, top), (0.2, top), (0.2, top - 0.03), (0.17, top - 0.075), (0, top - 0.085)]
            parts = lathe(profile, glass, sides=28)
            height = top - 0.16
        layout.patches += move(parts, shift=(x, y, 0))
        if lit:
            layout.add_lamp(x, y, height, (0.5 + 0.11 * room.area) / len(centres))
