"""Puts furniture into rooms according to their kind, then plants, pictures, shelves, radiators and lamps into all."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from wheretolook_rooms import artwork, decor, fixtures, furniture, materials
from wheretolook_rooms.layout import Lamp, Layout, Size, Spot, overlap
from wheretolook_rooms.patches import Patch, box, cylinder, lathe, move, tube
from wheretolook_rooms.plan import Plan, outside_spans
from wheretolook_rooms.style import Style


def furnish(style: Style, plan: Plan) -> tuple[list[Patch], list[Lamp]]:
    """Everything in the rooms of a plan, and the lamps that are lit. The front door is in the hall if there is one."""
    layouts = arrange(style, plan)
    patches = [patch for layout in layouts for patch in layout.placed(plan.height)]
    return patches, [lamp for layout in layouts for lamp in layout.lamps]


def arrange(style: Style, plan: Plan) -> list[Layout]:
    """What stands and hangs in each room of a plan; see `furnish`."""
    furnisher = Furnisher(style, plan)
    entrance = min(plan.rooms, key=lambda room: {"hall": 0, "living": 1}.get(room.kind, 2))
    layouts = []
    for room in plan.rooms:
        layout = Layout(room, style.rng)
        if room is entrance:
            furnisher.front_door(layout)
        furnisher.fill(layout)
        dress(style, layout, plan.height)
        layouts.append(layout)
    return layouts


class Furnisher:
    """Furnishes the rooms of one apartment, each according to its kind."""

    def __init__(self, style: Style, plan: Plan) -> None:
        self.style = style
        self.plan = plan
        self.dining_chair = (style.wood, style.patterned() if style.bernoulli(0.4) else style.upholstery)

    def fill(self, layout: Layout) -> None:
        """Put the furniture of its kind into a room."""
        wet = {"kitchen": self._kitchen, "bathroom": self._bathroom}
        dry = {"living": self._living, "bedroom": self._bedroom, "hall": self._hall, "study": self._study}
        (wet | dry)[layout.room.kind](layout)

    def _stand(self, layout: Layout, patches: list[Patch], size: Size, place: str = "any", *where: Any) -> Spot | None:
        """Stand a piece of furniture at a wall, if there is a place; see `Layout.find_by_wall`."""
        spot = layout.find_by_wall(size, place, *where)
        if spot is not None:
            layout.put_by_wall(patches, spot)
        return spot

    def _bookshelf(self, layout: Layout, width: float, height: float, place: str = "any") -> None:
        self._stand(layout, furniture.bookshelf(self.style, width, height), (width, 0.3, height), place)

    def _rug(self, layout: Layout, centre: tuple[float, float], size: tuple[float, float], turned: bool) -> None:
        """Lay a rug of a size in x and y, or the other way round if turned, cut off near the walls."""
        room = layout.room
        (x, y) = centre
        (width, depth) = size[::-1] if turned else size
        x0 = max(x - width / 2, room.x0 + 0.15)
        x1 = min(x + width / 2, room.x1 - 0.15)
        y0 = max(y - depth / 2, room.y0 + 0.15)
        y1 = min(y + depth / 2, room.y1 - 0.15)
        if min(x1 - x0, y1 - y0) > 0.4:
            layout.patches += box((x0, y0, 0), (x1, y1, 0.008), artwork.rug(self.style.rng, self.style.richness))

    def front_door(self, layout: Layout) -> None:
        """Closed door to the outside; without a free outer wall there is none."""
        width = 0.95
        half = 0.95 / 2
        for side in map(int, self.style.rng.permutation(4)):
            for low, high in outside_spans(layout.room, self.plan.rooms, side):
                if high - low <= width + 0.4:
                    continue
                at = float(self.style.rng.uniform(low + half + 0.15, high - half - 0.15))
                if layout.wall_is_clear(side, at - half - 0.1, at + half + 0.1, 0, 2.2):
                    layout.put_on_wall(side, at, fixtures.front_door(self.style, width, 2.05))
                    layout.add_door(side, at - half, at + half, 2.1)
                    return

    def _dining(self, layout: Layout, seats: int) -> None:
        """Table with chairs on the floor, with fewer seats where it does not fit."""
        style = self.style
        for count in range(seats, 1, -2):
            length = {2: 0.75, 4: 1.2, 6: 1.7}[count]
            depth = 0.8
            turned = style.bernoulli(0.5)
            w, d = (depth + 1.0, length + 0.1) if turned else (length + 0.1, depth + 1.0)
            spot = layout.find_on_floor(w, d, 0.25)
            if spot is None:
                continue
            patches = move(furniture.table(style, length, depth, 0.75, style.second_wood), shift=(0, -depth / 2, 0))
            for k in range(count // 2):
                x = (k - (count / 2 - 1) / 2) * length / (count / 2)
                for sign, angle in ((-1, 0.0), (1, np.pi)):
                    y = sign * (depth / 2 + 0.08 + float(style.rng.uniform(0.0, 0.12)))
                    patches += move(furniture.chair(style, *self.dining_chair), angle_rad=angle, shift=(x, y, 0))
            patches += self._on_table(length, depth, 0.75)
            layout.patches += move(patches, angle_rad=np.pi / 2 if turned else 0.0, shift=(*spot, 0))
            layout.footprints.append((spot[0] - w / 2, spot[1] - d / 2, spot[0] + w / 2, spot[1] + d / 2))
            return

    def _on_table(self, length: float, depth: float, height: float) -> list[Patch]:
        style = self.style
        patches: list[Patch] = []
        for x in np.arange(-length / 2 + 0.2, length / 2 - 0.15, 0.3):
            if not style.bernoulli(0.25 + 0.6 * style.clutter):
                continue
            item = [
                lambda: decor.bowl(style, 0.13, True),
                lambda: decor.vase(style, 0.26),
                lambda: decor.book_stack(style, 2),
                lambda: decor.plant(style, 0.3, 16, 0.2),
            ][int(style.rng.integers(4))]()
            patches += move(item, shift=(x, style.rng.uniform(-0.15, 0.15) * depth, height))
        return patches

    def _living(self, layout: Layout) -> None:
        style = self.style
        room = layout.room
        if not any(r.kind == "kitchen" for r in self.plan.rooms):
            self._kitchen(layout)
        spot = None
        for seats in (3, 2) if max(room.width, room.depth) > 4.2 else (2,):
            size = (0.62 * seats + 0.36, 0.92, 0.85)
            spot = spot or self._stand(layout, furniture.sofa(style, seats), size, "middle", 0.42)
        tv = float(style.rng.uniform(1.4, 1.8))
        opposite = None if spot is None else [(spot.side + 2) % 4, (spot.side + 1) % 4, (spot.side + 3) % 4]
        self._stand(layout, furniture.media_unit(style, tv), (tv, 0.45, 1.3), "middle", 0.7, opposite)
        if spot is not None:
            self._before_sofa(layout, spot)
        for _ in range(1 + round(1.5 * style.clutter)):
            width = float(style.rng.choice([0.8, 1.0, 1.4]))
            height = float(style.rng.uniform(1.7, 2.15))
            self._bookshelf(layout, width, height, "corner" if style.bernoulli(0.5) else "any")
        if room.area > 15:
            self._dining(layout, 6)
        self._stand(layout, furniture.sofa(style, 1), (0.98, 0.92, 0.85), "any")
        self._floor_lamp(layout)

    def _before_sofa(self, layout: Layout, sofa: Spot) -> None:
        """Rug and coffee table."""
        self._rug(layout, layout.point(sofa.side, sofa.at, 1.65), (2.3, 1.6), bool(sofa.side % 2))
        footprint = layout.rectangle(sofa.side, sofa.at - 0.52, sofa.at + 0.52, 1.36, 1.93)
        # The table may stand where the sofa and the television keep the floor free, but not before a door.
        occupied = layout.footprints + layout.keep_free[: len(layout.doors)]
        if (
            layout.contains(footprint)
            and not any(overlap(footprint, f) for f in occupied)
            and layout.passable(footprint)
        ):
            table = furniture.table(self.style, 1.0, 0.55, 0.42, self.style.second_wood)
            table += move(self._on_table(1.0, 0.55, 0.42), shift=(0, 0.275, 0))
            layout.put_on_wall(sofa.side, sofa.at, move(table, shift=(0, 1.37, 0)))
            layout.footprints.append(footprint)

    def _floor_lamp(self, layout: Layout) -> None:
        lit = layout.room.lamp_on and self.style.bernoulli(0.7)
        spot = layout.find_by_wall((0.46, 0.46, 1.7), "corner", front=0.0)
        if spot is not None:
            layout.put_by_wall(move(decor.floor_lamp(self.style, lit), shift=(0, 0.23, 0)), spot)
            if lit:
                layout.add_lamp(*layout.point(spot.side, spot.at, 0.23), 1.52, 0.5)

    def _kitchen(self, layout: Layout) -> None:
        style = self.style
        for width, height in product((3.6, 3.0, 2.4, 1.8), (2.2, 0.92)):
            spot = layout.find_by_wall((width, 0.64, height), "corner", front=0.8)
            if spot is not None:
                below_window = height < 1
                layout.put_by_wall(fixtures.kitchen_run(style, width, self.plan.height, below_window), spot)
                self._splashback(layout, spot, width, below_window)
                break
        self._stand(layout, fixtures.fridge(style), (0.64, 0.66, 1.9), "corner", 0.6)
        if layout.room.kind == "kitchen":
            if style.bernoulli(0.5):
                self._stand(layout, fixtures.washing_machine(style), (0.62, 0.6, 0.88), "corner")
            self._dining(layout, 4)
            self._bookshelf(layout, 0.8, 1.6)

    def _splashback(self, layout: Layout, spot: Spot, width: float, below_window: bool) -> None:
        """Tiles between the worktop and the wall units or the window."""
        rng = self.style.rng
        style = self.style
        size = style.pick([(0.1, 0.1), (0.2, 0.1), (0.15, 0.15)])
        colour = materials.vary(rng, style.pick([(0.92, 0.92, 0.9), (0.55, 0.66, 0.66), (0.8, 0.74, 0.6)]), 0.03)
        brick = size[0] != size[1]
        variation = 0.02 + 0.05 * style.richness
        tile = materials.tiles(rng, colour, (0.6, 0.6, 0.58), size_m=size, brick=brick, variation=variation)
        low = min((o.z0 for o in layout.room.openings[spot.side] if o.kind == "window"), default=1.2)
        top = min(1.2, low - 0.035) if below_window else 1.45
        tiled = box((-width / 2, 0, 0.9), (width / 2, 0.006, top), tile, hidden=("back", "bottom"))
        layout.put_on_wall(spot.side, spot.at, tiled)

    def _bedroom(self, layout: Layout) -> None:
        style = self.style
        for width in (1.6, 1.4, 1.0):
            spot = self._stand(layout, furniture.bed(style, width), (width + 0.1, 2.12, 1.1), "middle", 0.0)
            if spot is not None:
                break
        if spot is not None:
            for sign in (-1, 1):
                self._nightstand(layout, spot.side, spot.at + sign * (width / 2 + 0.05 + 0.24))
            if style.bernoulli(0.7):
                self._rug(layout, layout.point(spot.side, spot.at, 1.7), (width + 1.0, 1.5), bool(spot.side % 2))
        for width in (float(style.rng.choice([1.2, 1.6, 2.0])), 1.0):
            front = style.wood if style.bernoulli(0.5) else style.front
            wardrobe = furniture.cabinet(style, (width, 0.6, 2.1), columns=round(width / 0.5), front=front)
            if self._stand(layout, wardrobe, (width, 0.62, 2.12), "corner", 0.6) is not None:
                break
        if style.bernoulli(0.6):
            self._desk(layout)
        if style.bernoulli(0.7):
            chest = furniture.cabinet(style, (0.9, 0.42, 0.85), columns=2, rows=3)
            chest += move(decor.vase(style, 0.25), shift=(-0.25, 0.2, 0.85))
            chest += move(decor.book_stack(style, 2), shift=(0.2, 0.2, 0.85))
            self._stand(layout, chest, (0.9, 0.46, 1.1))
        if style.bernoulli(0.2 + 0.6 * style.clutter):
            self._bookshelf(layout, 0.8, 1.8)

    def _nightstand(self, layout: Layout, side: int, at: float) -> None:
        a0 = at - 0.22
        a1 = at + 0.22
        spot = Spot(side, at, (0.44, 0.4, 0.95), 0.0, layout.rectangle(side, a0, a1, 0, 0.4))
        if layout.wall_is_clear(side, a0, a1, 0, 0.9, gap=0.0) and layout.is_clear(spot.footprint, 0.0):
            lit = layout.room.lamp_on and self.style.bernoulli(0.6)
            layout.put_by_wall(furniture.nightstand(self.style, lit), spot)
            if lit:
                layout.add_lamp(*layout.point(side, at - 0.06, 0.16), 0.87, 0.25)

    def _desk(self, layout: Layout) -> None:
        patches = furniture.desk(self.style, 1.3)
        chair = furniture.chair(self.style, *self.dining_chair)
        patches += move(chair, angle_rad=np.pi + self.style.rng.normal(0, 0.1), shift=(0.05, 0.85, 0))
        self._stand(layout, patches, (1.34, 1.12, 1.3), "any", 0.1)

    def _study(self, layout: Layout) -> None:
        style = self.style
        self._desk(layout)
        for _ in range(2 + round(2 * style.clutter)):
            self._bookshelf(layout, float(style.rng.choice([0.8, 1.2])), 2.0)
        self._stand(layout, furniture.sofa(style, 1), (0.98, 0.92, 0.85))
        self._rug(layout, layout.room.centre, (1.8, 1.3), turned=False)
        self._floor_lamp(layout)

    def _bathroom(self, layout: Layout) -> None:
        style = self.style
        for width in (1.7, 1.5):
            if self._stand(layout, fixtures.bathtub(style, width), (width, 0.77, 0.6), "corner", 0.3) is not None:
                break
        self._stand(layout, fixtures.basin(style), (0.7, 0.5, 1.95), "any", 0.5)
        self._stand(layout, fixtures.toilet(style), (0.5, 0.68, 1.0), "any", 0.45)
        if style.bernoulli(0.6):
            self._stand(layout, fixtures.washing_machine(style), (0.62, 0.6, 0.88), "corner", 0.5)
        for side in map(int, style.rng.permutation(4)[:3]):
            at = layout.hang(0.66, 0.7, 1.5, side, depth=0.1)
            if at is not None:
                layout.put_on_wall(side, at, move(fixtures.towel(style), shift=(0, 0, 1.4)))
        spot = layout.find_on_floor(0.8, 0.5, 0.1)
        if spot is not None:
            x, y = spot
            layout.patches += box((x - 0.4, y - 0.25, 0), (x + 0.4, y + 0.25, 0.012), style.patterned())

    def _hall(self, layout: Layout) -> None:
        style = self.style
        room = layout.room
        narrow = min(room.width, room.depth) < 1.7
        depth = 0.26 if narrow else 0.38
        shoes = furniture.cabinet(style, (0.9, depth, 0.85), columns=2, rows=2)
        shoes += move(decor.bowl(style, 0.1, False), shift=(-0.2, depth / 2, 0.85))
        shoes += move(decor.vase(style, 0.28), shift=(0.25, depth / 2, 0.85))
        self._stand(layout, shoes, (0.9, depth + 0.04, 1.15), "any", 0.3)
        for side in map(int, style.rng.permutation(4)):
            at = layout.hang(1.0, 0.65, 1.85, side, depth=0.16)
            if at is not None:
                layout.put_on_wall(side, at, fixtures.coat_rack(style, 3))
                break
        if not narrow:
            self._bookshelf(layout, 0.8, 2.0)
        length = min(max(room.width, room.depth) - 1.2, 2.6)
        self._rug(layout, room.centre, (length, 0.75), turned=room.width <= room.depth)


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
        if not style.bernoulli(0.45 + 0.5 * style.richness):
            continue
        for _ in range(int(style.rng.integers(1, 3 + round(1.5 * style.richness)))):
            width = float(style.rng.uniform(0.35, 1.2))
            height = float(style.rng.uniform(0.35, 0.85))
            middle = float(style.rng.uniform(1.45, 1.65))
            at = layout.hang(width, middle - height / 2, middle + height / 2, side)
            if at is not None:
                layout.put_on_wall(side, at, move(decor.picture_frame(style, width, height), shift=(0, 0, middle)))


def _wall_shelves(style: Style, layout: Layout) -> None:
    if layout.room.kind in ("bathroom", "hall"):
        return
    for side in range(4):
        if style.bernoulli(0.2 + 0.5 * style.clutter):
            width = float(style.rng.uniform(0.7, 1.3))
            height = float(style.rng.uniform(1.3, 1.6))
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
    lit = layout.room.lamp_on
    (x, y) = layout.room.centre
    dx, dy = (room.width / 4, 0.0) if room.width > room.depth else (0.0, room.depth / 4)
    centres = [(x - dx, y - dy), (x + dx, y + dy)] if max(room.width, room.depth) > 5.5 else [(x, y)]
    pendant = room.kind in ("living", "kitchen", "bedroom", "study") and style.bernoulli(0.5)
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
