"""What goes into a room of each kind, and where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wheretolook.scenes.procedural import artwork, decor, fixtures, furniture, materials
from wheretolook.scenes.procedural.dressing import dress
from wheretolook.scenes.procedural.layout import Lamp, Layout, Spot, overlap
from wheretolook.scenes.procedural.patches import Patch, box, move
from wheretolook.scenes.procedural.plan import Plan, outside_spans
from wheretolook.scenes.procedural.shell import wall_items
from wheretolook.scenes.procedural.style import Style


def furnish(style: Style, plan: Plan) -> tuple[list[Patch], list[Lamp]]:
    """Everything in the rooms of a plan, and the lamps that are lit."""
    furnisher = Furnisher(style, plan)
    entrance = min(plan.rooms, key=lambda room: {"hall": 0, "living": 1}.get(room.kind, 2))
    patches: list[Patch] = []
    lamps: list[Lamp] = []
    for room in plan.rooms:
        layout = Layout(room, style.rng)
        if room is entrance:
            furnisher.front_door(layout)
        furnisher.fill(layout)
        dress(style, layout, plan.height)
        # leaves and coats stop just short of the walls
        low, high = [room.x0 + 0.002, room.y0 + 0.002, 0], [room.x1 - 0.002, room.y1 - 0.002, plan.height]
        patches += [replace(p, room=room.index, positions=np.clip(p.positions, low, high)) for p in layout.patches]
        lamps += layout.lamps
    return patches, lamps


class Furnisher:
    """Knows what belongs into a room of each kind."""

    def __init__(self, style: Style, plan: Plan) -> None:
        self.style, self.plan = style, plan
        self.dining_chair = (style.wood, style.patterned() if style.chance(0.4) else style.upholstery)

    def fill(self, layout: Layout) -> None:
        """Put the furniture of its kind into a room."""
        {
            "living": self._living,
            "kitchen": self._kitchen,
            "bedroom": self._bedroom,
            "bathroom": self._bathroom,
            "hall": self._hall,
            "study": self._study,
        }[layout.room.kind](layout)

    def _stand(
        self,
        layout: Layout,
        patches: list[Patch],
        size: tuple[float, float, float],
        place: str = "any",
        front: float = 0.5,
        sides: list[int] | None = None,
    ) -> Spot | None:
        width, depth, height = size
        spot = layout.find_by_wall(width, depth, height, place=place, front=front, sides=sides)
        if spot is not None:
            layout.put_by_wall(patches, spot, width, height, depth, front)
        return spot

    def _rug(self, layout: Layout, x: float, y: float, width: float, depth: float) -> None:
        room = layout.room
        x0, x1 = max(x - width / 2, room.x0 + 0.15), min(x + width / 2, room.x1 - 0.15)
        y0, y1 = max(y - depth / 2, room.y0 + 0.15), min(y + depth / 2, room.y1 - 0.15)
        if min(x1 - x0, y1 - y0) > 0.4:
            layout.patches += box((x0, y0, 0), (x1, y1, 0.008), artwork.rug(self.style.rng, self.style.richness))

    def front_door(self, layout: Layout) -> None:
        """Closed door to the outside; without a free outer wall there is none."""
        room, width = layout.room, 0.95
        for side in self.style.rng.permutation(4):
            for low, high in outside_spans(room, self.plan.rooms, int(side)):
                at = (
                    float(self.style.rng.uniform(low + width / 2 + 0.15, high - width / 2 - 0.15))
                    if high - low > width + 0.4
                    else None
                )
                if at is not None and layout.wall_is_clear(
                    int(side), at - width / 2 - 0.1, at + width / 2 + 0.1, 0, 2.2
                ):
                    layout.patches += wall_items(room, int(side), at, fixtures.front_door(self.style, width, 2.05))
                    layout.add_door(int(side), at - width / 2, at + width / 2, 2.1)
                    return

    def _dining(self, layout: Layout, seats: int) -> bool:
        style = self.style
        for count in range(seats, 1, -2):
            length, depth = {2: 0.75, 4: 1.2, 6: 1.7}[count], 0.8
            turned = style.chance(0.5)
            full = (length + 0.1, depth + 1.0)
            w, d = full[::-1] if turned else full
            spot = layout.find_on_floor(w, d, 0.25)
            if spot is None:
                continue
            patches = move(furniture.table(style, length, depth, 0.75, style.second_wood), shift=(0, -depth / 2, 0))
            for k in range(count // 2):
                x = (k - (count / 2 - 1) / 2) * length / (count / 2)
                for sign in (-1, 1):
                    pulled = float(style.rng.uniform(0.0, 0.12))
                    seat = furniture.chair(style, *self.dining_chair)
                    patches += move(
                        seat, angle_rad=0.0 if sign < 0 else np.pi, shift=(x, sign * (depth / 2 + 0.08 + pulled), 0)
                    )
            patches += self._on_table(length, depth, 0.75)
            layout.patches += move(patches, angle_rad=np.pi / 2 if turned else 0.0, shift=(*spot, 0))
            layout.footprints.append((spot[0] - w / 2, spot[1] - d / 2, spot[0] + w / 2, spot[1] + d / 2))
            return True
        return False

    def _on_table(self, length: float, depth: float, height: float) -> list[Patch]:
        style = self.style
        patches: list[Patch] = []
        for x in np.arange(-length / 2 + 0.2, length / 2 - 0.15, 0.3):
            if not style.chance(0.25 + 0.6 * style.clutter):
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
        style, room = self.style, layout.room
        if not any(r.kind == "kitchen" for r in self.plan.rooms):
            self._kitchen(layout)
        spot = None
        for seats in (3, 2) if max(room.width, room.depth) > 4.2 else (2,):
            spot = spot or self._stand(
                layout, furniture.sofa(style, seats), (0.62 * seats + 0.36, 0.92, 0.85), "middle", front=0.42
            )
        tv = float(style.rng.uniform(1.4, 1.8))
        opposite = None if spot is None else [(spot.side + 2) % 4, (spot.side + 1) % 4, (spot.side + 3) % 4]
        self._stand(layout, furniture.media_unit(style, tv), (tv, 0.45, 1.3), "middle", 0.7, opposite)
        if spot is not None:
            self._before_sofa(layout, spot)
        for _ in range(1 + round(1.5 * style.clutter)):
            w = float(style.rng.choice([0.8, 1.0, 1.4]))
            height = float(style.rng.uniform(1.7, 2.15))
            place = "corner" if style.chance(0.5) else "any"
            self._stand(layout, furniture.bookshelf(style, w, height), (w, 0.3, height), place)
        if room.area > 15:
            self._dining(layout, 6)
        self._stand(layout, furniture.sofa(style, 1), (0.98, 0.92, 0.85), "any")
        self._floor_lamp(layout)

    def _before_sofa(self, layout: Layout, sofa: Spot) -> None:
        style = self.style
        corner, right, normal = layout.room.wall_frame(sofa.side)
        x, y, _ = corner + sofa.at * right + 1.65 * normal
        self._rug(layout, x, y, *((1.6, 2.3) if sofa.side % 2 else (2.3, 1.6)))
        footprint = layout.rectangle(sofa.side, sofa.at - 0.52, sofa.at + 0.52, 1.36, 1.93)
        # it may stand where the sofa and the television keep the floor free, but not before a door
        kept = layout.footprints + layout.keep_free[: len(layout.doors)]
        if layout.contains(footprint) and not any(overlap(footprint, f) for f in kept) and layout.passable(footprint):
            table = furniture.table(style, 1.0, 0.55, 0.42, style.second_wood)
            table += move(self._on_table(1.0, 0.55, 0.42), shift=(0, 0.275, 0))
            layout.patches += wall_items(layout.room, sofa.side, sofa.at, move(table, shift=(0, 1.37, 0)))
            layout.footprints.append(footprint)

    def _floor_lamp(self, layout: Layout) -> None:
        lit = layout.room.lamp_on and self.style.chance(0.7)
        spot = layout.find_by_wall(0.46, 0.46, 1.7, place="corner", front=0.0)
        if spot is not None:
            layout.put_by_wall(move(decor.floor_lamp(self.style, lit), shift=(0, 0.23, 0)), spot, 0.46, 1.7, 0.46, 0)
            if lit:
                layout.add_lamp(spot, 0.23, 1.52, 0.5)

    def _kitchen(self, layout: Layout) -> None:
        style, room = self.style, layout.room
        for width in (3.6, 3.0, 2.4, 1.8):
            spot = None
            for height, window in ((2.2, False), (0.92, True)):
                spot = layout.find_by_wall(width, 0.64, height, place="corner", front=0.8)
                if spot is not None:
                    run = fixtures.kitchen_run(style, width, self.plan.height, window)
                    layout.put_by_wall(run, spot, width, height, 0.64, 0.8)
                    self._splashback(layout, spot, width, window)
                    break
            if spot is not None:
                break
        self._stand(layout, fixtures.fridge(style), (0.64, 0.66, 1.9), "corner", 0.6)
        if room.kind == "kitchen":
            if style.chance(0.5):
                self._stand(layout, fixtures.washing_machine(style), (0.62, 0.6, 0.88), "corner")
            self._dining(layout, 4)
            self._stand(layout, furniture.bookshelf(style, 0.8, 1.6), (0.8, 0.3, 1.6))

    def _splashback(self, layout: Layout, spot: Spot, width: float, window: bool) -> None:

        style = self.style
        size = style.pick([(0.1, 0.1), (0.2, 0.1), (0.15, 0.15)])
        colour = materials.vary(style.rng, style.pick([(0.92, 0.92, 0.9), (0.55, 0.66, 0.66), (0.8, 0.74, 0.6)]), 0.03)
        tile = materials.tiles(
            style.rng,
            colour,
            (0.6, 0.6, 0.58),
            size_m=size,
            brick=size[0] != size[1],
            variation=0.02 + 0.05 * style.richness,
        )
        top = 1.45
        if window:
            low = min((o.z0 for o in layout.room.openings[spot.side] if o.kind == "window"), default=1.2)
            top = min(1.2, low - 0.035)
        layout.patches += wall_items(
            layout.room,
            spot.side,
            spot.at,
            box((-width / 2, 0, 0.9), (width / 2, 0.006, top), tile, hidden=("back", "bottom")),
        )

    def _bedroom(self, layout: Layout) -> None:
        style = self.style
        for width in (1.6, 1.4, 1.0):
            spot = self._stand(layout, furniture.bed(style, width), (width + 0.1, 2.12, 1.1), "middle", 0.0)
            if spot is not None:
                break
        if spot is not None:
            for sign in (-1, 1):
                at = spot.at + sign * (width / 2 + 0.05 + 0.24)
                beside = layout.rectangle(spot.side, at - 0.22, at + 0.22, 0, 0.4)
                if layout.wall_is_clear(spot.side, at - 0.22, at + 0.22, 0, 0.9, gap=0.0) and layout.is_clear(
                    beside, 0.0
                ):
                    lit = layout.room.lamp_on and style.chance(0.6)
                    stand = Spot(spot.side, at, beside)
                    layout.put_by_wall(furniture.nightstand(style, lit), stand, 0.44, 0.95, 0.4, 0.0)
                    if lit:
                        layout.add_lamp(stand, 0.16, 0.87, 0.25, along=0.06)
            if style.chance(0.7):
                corner, right, normal = layout.room.wall_frame(spot.side)
                x, y, _ = corner + spot.at * right + 1.7 * normal
                size = (width + 1.0, 1.5)
                self._rug(layout, x, y, *(size[::-1] if spot.side % 2 else size))
        w = float(style.rng.choice([1.2, 1.6, 2.0]))
        for width in (w, 1.0):
            robe = furniture.cabinet(
                style,
                width,
                0.6,
                2.1,
                columns=round(width / 0.5),
                rows=1,
                carcass=style.wood,
                front=style.wood if style.chance(0.5) else style.front,
            )
            if self._stand(layout, robe, (width, 0.62, 2.12), "corner", 0.6) is not None:
                break
        if style.chance(0.6):
            self._desk(layout)
        if style.chance(0.7):
            chest = furniture.cabinet(style, 0.9, 0.42, 0.85, columns=2, rows=3, carcass=style.wood, front=style.front)
            chest += move(decor.vase(style, 0.25), shift=(-0.25, 0.2, 0.85)) + move(
                decor.book_stack(style, 2), shift=(0.2, 0.2, 0.85)
            )
            self._stand(layout, chest, (0.9, 0.46, 1.1))
        self._stand(layout, furniture.bookshelf(style, 0.8, 1.8), (0.8, 0.3, 1.8)) if style.chance(
            0.2 + 0.6 * style.clutter
        ) else None

    def _desk(self, layout: Layout) -> None:
        style = self.style
        patches = furniture.desk(style, 1.3) + move(
            furniture.chair(style, *self.dining_chair),
            angle_rad=np.pi + style.rng.normal(0, 0.1),
            shift=(0.05, 0.85, 0),
        )
        self._stand(layout, patches, (1.34, 1.12, 1.3), "any", 0.1)

    def _study(self, layout: Layout) -> None:
        style = self.style
        self._desk(layout)
        for _ in range(2 + round(2 * style.clutter)):
            w = float(style.rng.choice([0.8, 1.2]))
            self._stand(layout, furniture.bookshelf(style, w, 2.0), (w, 0.3, 2.0))
        self._stand(layout, furniture.sofa(style, 1), (0.98, 0.92, 0.85))
        self._rug(layout, (layout.room.x0 + layout.room.x1) / 2, (layout.room.y0 + layout.room.y1) / 2, 1.8, 1.3)
        self._floor_lamp(layout)

    def _bathroom(self, layout: Layout) -> None:
        style, room = self.style, layout.room
        for width in (1.7, 1.5):
            if self._stand(layout, fixtures.bathtub(style, width), (width, 0.77, 0.6), "corner", 0.3) is not None:
                break
        self._stand(layout, fixtures.basin(style), (0.7, 0.5, 1.95), "any", 0.5)
        self._stand(layout, fixtures.toilet(style), (0.5, 0.68, 1.0), "any", 0.45)
        if style.chance(0.6):
            self._stand(layout, fixtures.washing_machine(style), (0.62, 0.6, 0.88), "corner", 0.5)

        for side in style.rng.permutation(4)[:3]:
            at = layout.hang(0.66, 0.7, 1.5, int(side), depth=0.1)
            if at is not None:
                layout.patches += wall_items(room, int(side), at, move(fixtures.towel(style), shift=(0, 0, 1.4)))
        spot = layout.find_on_floor(0.8, 0.5, 0.1)
        if spot is not None:
            layout.patches += box(
                (spot[0] - 0.4, spot[1] - 0.25, 0), (spot[0] + 0.4, spot[1] + 0.25, 0.012), style.patterned()
            )

    def _hall(self, layout: Layout) -> None:
        style, room = self.style, layout.room
        narrow = min(room.width, room.depth) < 1.7
        depth = 0.26 if narrow else 0.38
        shoes = furniture.cabinet(style, 0.9, depth, 0.85, columns=2, rows=2, carcass=style.wood, front=style.front)
        shoes += move(decor.bowl(style, 0.1, False), shift=(-0.2, depth / 2, 0.85)) + move(
            decor.vase(style, 0.28), shift=(0.25, depth / 2, 0.85)
        )
        self._stand(layout, shoes, (0.9, depth + 0.04, 1.15), "any", 0.3)

        for side in style.rng.permutation(4):
            at = layout.hang(1.0, 0.65, 1.85, int(side), depth=0.16)
            if at is not None:
                layout.patches += wall_items(room, int(side), at, fixtures.coat_rack(style, 3))
                break
        if not narrow:
            self._stand(layout, furniture.bookshelf(style, 0.8, 2.0), (0.8, 0.3, 2.0))
        long = max(room.width, room.depth)
        size = (min(long - 1.2, 2.6), 0.75)
        self._rug(
            layout, (room.x0 + room.x1) / 2, (room.y0 + room.y1) / 2, *(size if room.width > room.depth else size[::-1])
        )
