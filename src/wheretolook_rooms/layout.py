"""Finds places for things in a room: along its walls, on its floor, on its walls. Doors stay passable."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage

from wheretolook_rooms.patches import Patch
from wheretolook_rooms.plan import Room
from wheretolook_rooms.shell import wall_items

CELL_M = 0.1  # side of the cells in which `Layout.passable` looks for ways
WALKER_RADIUS_M = 0.25
DOOR_ZONE_M = 0.95  # depth of the floor before a door that stays free
WARM = (1.0, 0.80, 0.58)  # colour of a light bulb

Rectangle = tuple[float, float, float, float]
Size = tuple[float, float, float]


@dataclass(frozen=True)
class Lamp:
    """A small light: where it is (metres), the index of its room, its strength per colour."""

    position: tuple[float, float, float]
    room: int
    colour: tuple[float, float, float]


def overlap(a: Rectangle, b: Rectangle, gap: float = 0.0) -> bool:
    """Whether two rectangles (x0, y0, x1, y1) come closer than `gap`."""
    return a[0] < b[2] + gap and b[0] < a[2] + gap and a[1] < b[3] + gap and b[1] < a[3] + gap


@dataclass(frozen=True)
class Spot:
    """A place along a wall for a piece of furniture, in metres."""

    side: int  # of the room
    at: float  # wall coordinate of its middle
    size: Size  # width along the wall, depth into the room and height
    front: float  # depth of the floor before it that must stay free
    footprint: Rectangle  # in the world


@dataclass
class Layout:
    """What stands and hangs in one room, and where more can."""

    room: Room
    rng: np.random.Generator
    footprints: list[Rectangle] = field(default_factory=list)  # of what stands on the floor
    keep_free: list[Rectangle] = field(default_factory=list)  # floor before doors (first), wardrobes, the sofa
    on_wall: list[list[Rectangle]] = field(default_factory=lambda: [[], [], [], []])  # covered (a0, a1, z0, z1)
    patches: list[Patch] = field(default_factory=list)
    doors: list[tuple[float, float]] = field(default_factory=list)  # for each door, a point 0.4 m before it
    lamps: list[Lamp] = field(default_factory=list)  # that are lit

    def __post_init__(self) -> None:
        for side in range(4):
            for o in self.room.openings[side]:
                if o.kind == "window":
                    bare = self.room.kind in ("bathroom", "kitchen", "large")
                    edge, low = (0.08, o.z0 - 0.05) if bare else (0.48, 0.0)
                    self.on_wall[side].append((o.a0 - edge, o.a1 + edge, low, o.z1 + 0.3))
                else:
                    self.add_door(side, o.a0, o.a1, o.z1)

    def add_door(self, side: int, a0: float, a1: float, height: float) -> None:
        """Keep a doorway and the floor before it free."""
        self.on_wall[side].append((a0 - 0.09, a1 + 0.09, 0.0, height + 0.09))
        self.keep_free.append(self.rectangle(side, a0 - 0.03, a1 + 0.03, 0.0, DOOR_ZONE_M))
        self.doors.append(self.point(side, (a0 + a1) / 2, 0.4))

    def point(self, side: int, at: float, off_wall: float) -> tuple[float, float]:
        """World x, y of a wall coordinate and a distance from the wall."""
        corner, right, normal = self.room.wall_frame(side)
        x, y, _ = corner + at * right + off_wall * normal
        return float(x), float(y)

    def rectangle(self, side: int, a0: float, a1: float, near: float, far: float) -> Rectangle:
        """Floor from wall coordinate a0 to a1 and from `near` to `far` metres off the wall, in the world."""
        (px, py) = self.point(side, a0, near)
        (qx, qy) = self.point(side, a1, far)
        return min(px, qx), min(py, qy), max(px, qx), max(py, qy)

    def passable(self, extra: Rectangle) -> bool:
        """Whether one can still walk from door to door, and over most of the free floor, with `extra` occupied as well."""
        room = self.room
        nx = int(room.width / CELL_M)
        ny = int(room.depth / CELL_M)
        x = room.x0 + (np.arange(nx) + 0.5) * room.width / nx
        y = room.y0 + (np.arange(ny) + 0.5) * room.depth / ny
        r = WALKER_RADIUS_M
        free = ((x > room.x0 + r) & (x < room.x1 - r))[:, None] & ((y > room.y0 + r) & (y < room.y1 - r))[None]
        for x0, y0, x1, y1 in [*self.footprints, extra]:
            free[np.ix_((x > x0 - r) & (x < x1 + r), (y > y0 - r) & (y < y1 + r))] = False
        labels, count = ndimage.label(free)
        if count == 0:
            return False
        sizes = np.bincount(labels.ravel())[1:]
        found = {int(labels[np.abs(x - dx).argmin(), np.abs(y - dy).argmin()]) for dx, dy in self.doors}
        if len(found) > 1 or 0 in found:
            return False
        main = found.pop() if found else int(sizes.argmax()) + 1
        return bool(sizes[main - 1] > 0.8 * sizes.sum())

    def contains(self, footprint: Rectangle) -> bool:
        """Return whether a footprint is inside the room."""
        (x0, y0, x1, y1) = footprint
        room = self.room
        return x0 > room.x0 - 1e-6 and y0 > room.y0 - 1e-6 and x1 < room.x1 + 1e-6 and y1 < room.y1 + 1e-6

    def is_clear(self, footprint: Rectangle, gap: float = 0.02) -> bool:
        """Return whether a footprint is inside the room, touches nothing and blocks no way."""
        occupied = any(overlap(footprint, f, gap) for f in self.footprints)
        occupied = occupied or any(overlap(footprint, f) for f in self.keep_free)
        return self.contains(footprint) and not occupied and self.passable(footprint)

    def wall_is_clear(self, side: int, a0: float, a1: float, z0: float, z1: float, gap: float = 0.01) -> bool:
        """Whether a piece of wall is bare."""
        if a0 < 0 or a1 > self.room.wall_length(side):
            return False
        return not any(a0 < b1 + gap and b0 < a1 + gap and z0 < h1 and h0 < z1 for b0, b1, h0, h1 in self.on_wall[side])

    def find_by_wall(
        self, size: Size, place: str = "any", front: float = 0.5, sides: list[int] | None = None
    ) -> Spot | None:
        """Spot along a wall for a piece of furniture (see `Spot`), or None: at its `middle`, a `corner`, or `any`.

        `sides` are the walls to try, in order; all in random order if None.
        """
        width, depth, height = size
        order = [int(s) for s in self.rng.permutation(4)] if sides is None else sides
        if sides is None and place == "middle":
            order.sort(key=lambda s: -self.room.wall_length(s))
        for side in order:
            length = self.room.wall_length(side)
            low = width / 2 + 0.03
            high = length - width / 2 - 0.03
            if high < low:
                continue
            if place == "middle":
                candidates = (low + high) / 2 + np.array([0, 0.25, -0.25, 0.5, -0.5, 0.8, -0.8, 1.2, -1.2])
            elif place == "corner":
                candidates = self.rng.permutation([low, high, low + 0.1, high - 0.1])
            else:
                candidates = np.concatenate([self.rng.permutation([low, high]), self.rng.uniform(low, high, 8)])
            for at in candidates[(candidates >= low - 1e-9) & (candidates <= high + 1e-9)]:
                a0 = float(at) - width / 2
                a1 = float(at) + width / 2
                footprint = self.rectangle(side, a0, a1, 0.0, depth)
                before = self.rectangle(side, a0, a1, depth, depth + front)
                blocked = any(overlap(before, f, -0.01) for f in self.footprints)
                if self.wall_is_clear(side, a0, a1, 0.0, height) and not blocked and self.is_clear(footprint):
                    return Spot(side, float(at), size, front, footprint)
        return None

    def put_by_wall(self, patches: list[Patch], spot: Spot) -> None:
        """Stand patches at a spot, and keep the floor before them free."""
        self.put_on_wall(spot.side, spot.at, patches)
        self.footprints.append(spot.footprint)
        width, depth, height = spot.size
        a0 = spot.at - width / 2
        a1 = spot.at + width / 2
        self.on_wall[spot.side].append((a0, a1, 0.0, height))
        if spot.front:
            self.keep_free.append(self.rectangle(spot.side, a0, a1, depth, depth + spot.front))

    def put_on_wall(self, side: int, at: float, patches: list[Patch]) -> None:
        """Put patches of the furniture frame against a wall, with x = 0 at a wall coordinate."""
        self.patches += wall_items(self.room, side, at, patches)

    def placed(self, height: float) -> list[Patch]:
        """All patches, cut off just short of the walls, as leaves and coats reach into them; below the ceiling."""
        room = self.room
        low = [room.x0 + 0.002, room.y0 + 0.002, 0]
        high = [room.x1 - 0.002, room.y1 - 0.002, height]
        return [replace(p, room=room.index, positions=np.clip(p.positions, low, high)) for p in self.patches]

    def add_lamp(self, x: float, y: float, height: float, strength: float) -> None:
        """Light a lamp with the colour of a light bulb at a world position."""
        red, green, blue = WARM
        self.lamps.append(Lamp((x, y, height), self.room.index, (strength * red, strength * green, strength * blue)))

    def find_on_floor(self, width: float, depth: float, margin: float) -> tuple[float, float] | None:
        """Centre of a free rectangle (width in x, depth in y) with `margin` around it, or None."""
        room = self.room
        for _ in range(30):
            x = self.rng.uniform(room.x0 + width / 2 + 0.1, max(room.x1 - width / 2 - 0.1, room.x0 + width / 2 + 0.11))
            y = self.rng.uniform(room.y0 + depth / 2 + 0.1, max(room.y1 - depth / 2 - 0.1, room.y0 + depth / 2 + 0.11))
            footprint = (x - width / 2, y - depth / 2, x + width / 2, y + depth / 2)
            if self.is_clear(footprint, margin):
                return float(x), float(y)
        return None

    def hang(self, width: float, z0: float, z1: float, side: int, depth: float = 0.0) -> float | None:
        """Wall coordinate for something that hangs between two heights, or None; marks the place as covered.

        What stands out from the wall by `depth` metres does not hang in a doorway.
        """
        doorways = self.keep_free[: len(self.doors)]
        length = self.room.wall_length(side)
        if length < width + 0.3:
            return None
        for at in self.rng.uniform(width / 2 + 0.12, length - width / 2 - 0.12, 6):
            a0 = float(at) - width / 2
            a1 = float(at) + width / 2
            below = self.rectangle(side, a0, a1, 0.0, depth)
            in_the_way = depth > 0 and any(overlap(below, d) for d in doorways)
            if not in_the_way and self.wall_is_clear(side, a0, a1, z0, z1, gap=0.08):
                self.on_wall[side].append((a0, a1, z0, z1))
                return float(at)
        return None
