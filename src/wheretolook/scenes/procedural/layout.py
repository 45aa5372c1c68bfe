"""Where things can stand in a room: along its walls, on its floor, on its walls; doors stay passable."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from wheretolook.scenes.procedural.patches import Patch
from wheretolook.scenes.procedural.plan import Room
from wheretolook.scenes.procedural.shell import wall_items

CELL_M = 0.1
WALKER_RADIUS_M = 0.25
DOOR_ZONE_M = 0.95

Rectangle = tuple[float, float, float, float]


WARM = (1.0, 0.80, 0.58)


@dataclass(frozen=True)
class Lamp:
    """A small light: where it is (metres), the index of its room, its strength per colour."""

    position: tuple[float, float, float]
    room: int
    colour: tuple[float, float, float]


def warm_lamp(position: tuple[float, float, float], room: int, strength: float) -> Lamp:
    """Lamp of the colour of a light bulb."""
    return Lamp(position, room, (strength * WARM[0], strength * WARM[1], strength * WARM[2]))


def overlap(a: Rectangle, b: Rectangle, gap: float = 0.0) -> bool:
    """Whether two rectangles (x0, y0, x1, y1) come closer than `gap`."""
    return a[0] < b[2] + gap and b[0] < a[2] + gap and a[1] < b[3] + gap and b[1] < a[3] + gap


@dataclass
class Spot:
    """A place found along a wall: the side, the wall coordinate of its middle, its footprint in the world."""

    side: int
    at: float
    footprint: Rectangle


@dataclass
class Layout:
    """What is taken in one room.

    Attributes:
        room: the room.
        rng: source of the choices.
        footprints: what stands on the floor.
        keep_free: floor that nothing may stand on (before doors, wardrobes, the sofa).
        on_wall: per wall what it is covered by, as (a0, a1, z0, z1).
        patches: all that was put into the room.
        doors: for each door, a point 0.4 m before it.
        lamps: the lamps that are lit.
    """

    room: Room
    rng: np.random.Generator
    footprints: list[Rectangle] = field(default_factory=list)
    keep_free: list[Rectangle] = field(default_factory=list)
    on_wall: tuple[list[Rectangle], list[Rectangle], list[Rectangle], list[Rectangle]] = field(
        default_factory=lambda: ([], [], [], [])
    )
    patches: list[Patch] = field(default_factory=list)
    doors: list[tuple[float, float]] = field(default_factory=list)
    lamps: list[Lamp] = field(default_factory=list)

    def __post_init__(self) -> None:
        for side in range(4):
            for o in self.room.openings[side]:
                if o.kind == "window":
                    bare = self.room.kind in ("bathroom", "kitchen")
                    edge, low = (0.08, o.z0 - 0.05) if bare else (0.48, 0.0)
                    self.on_wall[side].append((o.a0 - edge, o.a1 + edge, low, o.z1 + 0.3))
                else:
                    self.add_door(side, o.a0, o.a1, o.z1)

    def add_door(self, side: int, a0: float, a1: float, height: float) -> None:
        """Keep a doorway and the floor before it free."""
        self.on_wall[side].append((a0 - 0.09, a1 + 0.09, 0.0, height + 0.09))
        self.keep_free.append(self.rectangle(side, a0 - 0.03, a1 + 0.03, 0.0, DOOR_ZONE_M))
        corner, right, normal = self.room.wall_frame(side)
        x, y, _ = corner + (a0 + a1) / 2 * right + 0.4 * normal
        self.doors.append((float(x), float(y)))

    def rectangle(self, side: int, a0: float, a1: float, near: float, far: float) -> Rectangle:
        """Floor from wall coordinate a0 to a1 and from `near` to `far` metres off the wall, in the world."""
        corner, right, normal = self.room.wall_frame(side)
        p, q = corner + a0 * right + near * normal, corner + a1 * right + far * normal
        return float(min(p[0], q[0])), float(min(p[1], q[1])), float(max(p[0], q[0])), float(max(p[1], q[1]))

    def passable(self, extra: Rectangle) -> bool:
        """Whether a walker still gets from door to door, and into most of the free floor, with `extra` in the way."""
        room = self.room
        nx, ny = int(room.width / CELL_M), int(room.depth / CELL_M)
        x = room.x0 + (np.arange(nx) + 0.5) * room.width / nx
        y = room.y0 + (np.arange(ny) + 0.5) * room.depth / ny
        free = np.ones((nx, ny), bool)
        r = WALKER_RADIUS_M
        free &= ((x > room.x0 + r) & (x < room.x1 - r))[:, None] & ((y > room.y0 + r) & (y < room.y1 - r))[None]
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
        """Whether a footprint lies in the room."""
        x0, y0, x1, y1 = footprint
        room = self.room
        return x0 > room.x0 - 1e-6 and y0 > room.y0 - 1e-6 and x1 < room.x1 + 1e-6 and y1 < room.y1 + 1e-6

    def is_clear(self, footprint: Rectangle, gap: float = 0.02) -> bool:
        """Whether a footprint lies in the room, touches nothing and blocks no way."""
        if not self.contains(footprint):
            return False
        if any(overlap(footprint, f, gap) for f in self.footprints) or any(
            overlap(footprint, f) for f in self.keep_free
        ):
            return False
        return self.passable(footprint)

    def wall_is_clear(self, side: int, a0: float, a1: float, z0: float, z1: float, gap: float = 0.01) -> bool:
        """Whether a piece of wall is bare."""
        if a0 < 0 or a1 > self.room.wall_length(side):
            return False
        return not any(a0 < b1 + gap and b0 < a1 + gap and z0 < h1 and h0 < z1 for b0, b1, h0, h1 in self.on_wall[side])

    def find_by_wall(
        self,
        width: float,
        depth: float,
        height: float,
        *,
        place: str = "any",
        front: float = 0.5,
        sides: list[int] | None = None,
    ) -> Spot | None:
        """Spot along a wall for a piece of furniture, or None.

        Args:
            width: extent along the wall.
            depth: extent into the room.
            height: of the piece.
            place: `middle` of the wall, `corner`, or `any`.
            front: floor that must stay free before it.
            sides: the walls to try, in order; all in random order if None.
        """
        order = [int(s) for s in self.rng.permutation(4)] if sides is None else sides
        if sides is None and place == "middle":
            order.sort(key=lambda s: -self.room.wall_length(s))
        for side in order:
            length = self.room.wall_length(side)
            low, high = width / 2 + 0.03, length - width / 2 - 0.03
            if high < low:
                continue
            if place == "middle":
                candidates = (low + high) / 2 + np.array([0, 0.25, -0.25, 0.5, -0.5, 0.8, -0.8, 1.2, -1.2])
            elif place == "corner":
                candidates = self.rng.permutation([low, high, low + 0.1, high - 0.1])
            else:
                candidates = np.concatenate([self.rng.permutation([low, high]), self.rng.uniform(low, high, 8)])
            for at in candidates[(candidates >= low - 1e-9) & (candidates <= high + 1e-9)]:
                a0, a1 = float(at) - width / 2, float(at) + width / 2
                if not self.wall_is_clear(side, a0, a1, 0.0, height):
                    continue
                footprint = self.rectangle(side, a0, a1, 0.0, depth)
                before = self.rectangle(side, a0, a1, depth, depth + front)
                blocked = any(overlap(before, f, -0.01) for f in self.footprints)
                if not blocked and self.is_clear(footprint):
                    return Spot(side, float(at), footprint)
        return None

    def put_by_wall(
        self, patches: list[Patch], spot: Spot, width: float, height: float, depth: float, front: float = 0.5
    ) -> None:
        """Stand patches at a spot found before, and keep the floor before them free."""
        self.patches += wall_items(self.room, spot.side, spot.at, patches)
        self.footprints.append(spot.footprint)
        a0, a1 = spot.at - width / 2, spot.at + width / 2
        self.on_wall[spot.side].append((a0, a1, 0.0, height))
        if front:
            self.keep_free.append(self.rectangle(spot.side, a0, a1, depth, depth + front))

    def add_lamp(self, spot: Spot, off_wall: float, height: float, strength: float, along: float = 0.0) -> None:
        """Light a lamp of a piece of furniture; `along` and `off_wall` are its x and y in the furniture frame."""
        corner, right, normal = self.room.wall_frame(spot.side)
        x, y, _ = corner + (spot.at - along) * right + off_wall * normal
        self.lamps.append(warm_lamp((float(x), float(y), height), self.room.index, strength))

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
        """Wall coordinate for something that hangs between two heights, or None; the place is then taken.

        What stands out by `depth` metres does not hang into the way through a door.
        """
        doorways = self.keep_free[: len(self.doors)]
        length = self.room.wall_length(side)
        if length < width + 0.3:
            return None
        for at in self.rng.uniform(width / 2 + 0.12, length - width / 2 - 0.12, 6):
            a0, a1 = float(at) - width / 2, float(at) + width / 2
            below = self.rectangle(side, a0, a1, 0.0, depth)
            in_the_way = depth > 0 and any(overlap(below, d) for d in doorways)
            if not in_the_way and self.wall_is_clear(side, a0, a1, z0, z1, gap=0.08):
                self.on_wall[side].append((a0, a1, z0, z1))
                return float(at)
        return None
