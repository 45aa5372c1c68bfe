"""Floor plans: a rectangle cut into rooms, each with a use, joined by doors and lit by windows."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from wheretolook.geometry.poses import Float

INNER_WALL_M = 0.12
DOOR_HEIGHT_M = 2.05
# Doors are preferably between rooms of low cost.
_COST = {"hall": 0.0, "living": 1.0, "kitchen": 3.0, "study": 5.0, "bedroom": 5.0, "bathroom": 9.0}
# Least width in metres and greatest ratio of the sides, for kinds of rooms.
_SHAPES = {"hall": (1.15, 6.5), "bathroom": (1.6, 2.2), "living": (3.2, 2.0), "kitchen": (2.2, 2.0)}


@dataclass(frozen=True)
class Opening:
    """A door or window in a wall, in metres."""

    kind: str  # `door`, `wide` (a wide opening without a frame or door) or `window`
    a0: float  # left end along the wall, seen from inside the room
    a1: float  # right end
    z0: float  # lower edge above the floor
    z1: float  # upper edge
    other: int = -1  # index of the room behind it, -1 for outside
    owner: bool = True  # whether this room's side carries the jambs and the threshold


@dataclass
class Room:
    """An axis-aligned room, inside measures in metres."""

    index: int
    x0: float  # west wall
    y0: float  # south wall
    x1: float  # east wall
    y1: float  # north wall
    kind: str = ""  # `living`, `kitchen`, `bedroom`, `bathroom`, `hall`, `study` or `large`
    openings: list[list[Opening]] = field(default_factory=lambda: [[], [], [], []])  # of south, east, north, west
    lamp_on: bool = True  # on the ceiling
    curtains_closed: bool = False

    @property
    def width(self) -> float:
        """Extent in x."""
        return self.x1 - self.x0

    @property
    def depth(self) -> float:
        """Extent in y."""
        return self.y1 - self.y0

    @property
    def area(self) -> float:
        """Square metres."""
        return self.width * self.depth

    @property
    def centre(self) -> tuple[float, float]:
        """World x and y of the middle."""
        return (self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2

    def wall_length(self, side: int) -> float:
        """Length of a wall."""
        return self.width if side % 2 == 0 else self.depth

    def wall_frame(self, side: int) -> tuple[Float, Float, Float]:
        """Left end on the floor, direction to the right, and normal into the room, seen from inside; each (3,)."""
        corner = [(self.x1, self.y0), (self.x1, self.y1), (self.x0, self.y1), (self.x0, self.y0)][side]
        right = [(-1, 0), (0, -1), (1, 0), (0, 1)][side]
        normal = [(0, 1), (-1, 0), (0, -1), (1, 0)][side]
        return (np.array([*corner, 0.0]), np.array([*right, 0.0], float), np.array([*normal, 0.0], float))

    def along(self, side: int, world: float) -> float:
        """Wall coordinate of a world x (south, north) or y (east, west)."""
        return [self.x1 - world, self.y1 - world, world - self.x0, world - self.y0][side]


@dataclass(frozen=True)
class Plan:
    """Rooms, the doors between them as pairs of indices, and the height of the ceiling in metres."""

    rooms: list[Room]
    doors: list[tuple[int, int]]
    height: float


def _cut(rng: np.random.Generator, width: float, depth: float, count: int, corridor: bool) -> list[Room]:
    """A rectangle cut at random into a number of rooms, the largest again and again; a corridor is the first."""
    cells = [(0.0, 0.0, width, depth)]
    half_wall = INNER_WALL_M / 2
    hall: list[tuple[float, float, float, float]] = []
    if corridor:
        breadth = rng.uniform(1.25, 1.75)
        low = rng.uniform(0.4, 0.6) * (depth - breadth)
        hall = [(0.0, low + half_wall, width, low + breadth - half_wall)]
        cells = [(0.0, 0.0, width, low - half_wall), (0.0, low + breadth + half_wall, width, depth)]
    while len(cells) + len(hall) < count:
        cells.sort(key=lambda c: (c[2] - c[0]) * (c[3] - c[1]))
        x0, y0, x1, y1 = cells.pop()
        share = rng.uniform(0.36, 0.64)
        if (x1 - x0 > y1 - y0) or corridor:
            at = x0 + share * (x1 - x0)
            cells += [(x0, y0, at - half_wall, y1), (at + half_wall, y0, x1, y1)]
        else:
            at = y0 + share * (y1 - y0)
            cells += [(x0, y0, x1, at - half_wall), (x0, at + half_wall, x1, y1)]
    return [Room(i, *c) for i, c in enumerate(hall + cells)]


def shared_wall(a: Room, b: Room) -> tuple[int, float, float] | None:
    """Side of `a` that faces `b` and the common interval in world x or y, or None if they do not touch."""
    common_x = max(a.x0, b.x0), min(a.x1, b.x1)
    common_y = max(a.y0, b.y0), min(a.y1, b.y1)
    walls = (0, b.y1, a.y0, common_x), (2, a.y1, b.y0, common_x), (1, a.x1, b.x0, common_y), (3, b.x1, a.x0, common_y)
    for side, lower, upper, (low, high) in walls:
        if high - low > 1e-6 and abs(lower + INNER_WALL_M - upper) < 1e-4:
            return side, low, high
    return None


def _name(rooms: list[Room], corridor: bool) -> None:
    """Choose the rooms' kinds: bathroom the smallest, living room the largest, the kitchen next to it."""
    rest = sorted(rooms, key=lambda r: r.area)
    if corridor:
        rooms[0].kind = "hall"
        rest.remove(rooms[0])
    rest.pop(0).kind = "bathroom"
    living = rest.pop()
    living.kind = "living"
    if not corridor and len(rooms) >= 5:
        hall = max(rest[:2], key=lambda r: sum(shared_wall(r, o) is not None for o in rooms))
        hall.kind = "hall"
        rest.remove(hall)
    kinds = ["bedroom", "kitchen", "bedroom", "study"]
    if len(rest) >= 2:
        adjacent = [r for r in rest if shared_wall(r, living)] or rest
        kitchen = min(adjacent, key=lambda r: r.area)
        kitchen.kind = "kitchen"
        rest.remove(kitchen)
        kinds.remove("kitchen")
    for room, kind in zip(reversed(rest), kinds, strict=False):
        room.kind = kind


def _spanning_doors(rooms: list[Room]) -> list[tuple[int, int]] | None:
    """Doors, as pairs of rooms, that make a minimum spanning tree of the rooms (Kruskal).

    None if a room cannot be reached or one would have to walk through a bathroom, bedroom or study.
    """
    edges = []
    for a, b in combinations(rooms, 2):
        wall = shared_wall(a, b)
        if wall is not None and wall[2] - wall[1] > 1.35:
            low, high = sorted((_COST[a.kind], _COST[b.kind]))
            edges.append((low * 10 + high, a.index, b.index))
    group = list(range(len(rooms)))
    doors = []
    for _, i, j in sorted(edges):
        if group[i] != group[j]:
            group = [group[i] if g == group[j] else g for g in group]
            doors.append((i, j))
    if len(set(group)) > 1:
        return None
    degree = np.bincount(np.ravel(doors), minlength=len(rooms))
    private = [r for r in rooms if r.kind in ("bathroom", "bedroom", "study")]
    return None if any(degree[r.index] > 1 for r in private) else doors


def _fits(room: Room) -> bool:
    short, long = sorted((room.width, room.depth))
    least, slenderness = _SHAPES.get(room.kind, (2.5, 2.0))
    return short >= least and long / short <= slenderness


def _add_doors(rng: np.random.Generator, rooms: list[Room], doors: list[tuple[int, int]], height: float) -> None:
    for i, j in doors:
        a = rooms[i]
        b = rooms[j]
        wall = shared_wall(a, b)
        kinds = {a.kind, b.kind}
        assert wall is not None
        side, low, high = wall
        wide = kinds == {"living", "kitchen"} or (kinds == {"living", "hall"} and rng.random() < 0.4)
        wide = wide and high - low - 0.3 > 1.3
        width = float(min(rng.uniform(1.3, 2.0), high - low - 0.3) if wide else rng.uniform(0.86, 0.95))
        kind, top = ("wide", min(2.25, height - 0.2)) if wide else ("door", DOOR_HEIGHT_M)
        slack = high - low - width
        start = low + float(rng.choice([0.15, slack - 0.15, rng.uniform(0.15, max(slack - 0.15, 0.16))]))
        for room, s, other, owner in ((a, side, j, True), (b, (side + 2) % 4, i, False)):
            ends = sorted((room.along(s, start), room.along(s, start + width)))
            room.openings[s].append(Opening(kind, ends[0], ends[1], 0.0, top, other, owner))


def outside_spans(room: Room, rooms: list[Room], side: int) -> list[tuple[float, float]]:
    """Intervals of a wall, in wall coordinates, with no room behind."""
    length = room.wall_length(side)
    occupied = []
    for other in rooms:
        wall = shared_wall(room, other) if other is not room else None
        if wall is not None and wall[0] == side:
            occupied.append(sorted((room.along(side, wall[1]), room.along(side, wall[2]))))
    free = []
    at = 0.0
    for low, high in sorted(occupied):
        free.append((at, low - INNER_WALL_M))
        at = high + INNER_WALL_M
    free.append((at, length))
    return [f for f in free if f[1] - f[0] > 0.9]


def draw_windows(rng: np.random.Generator, rooms: list[Room]) -> None:
    """Give each room but halls a window or two in the outer walls that have most space."""
    for room in (room for room in rooms if room.kind != "hall"):
        spans = [(high - low, side, low, high) for side in range(4) for low, high in outside_spans(room, rooms, side)]
        for span, side, low, high in sorted(spans, reverse=True)[: 2 if room.kind == "living" else 1]:
            small = room.kind == "bathroom"
            width = min(rng.uniform(0.55, 0.8) if small else rng.uniform(1.1, 2.1), span - 0.5)
            if width < 0.5:
                continue
            sill = {"living": float(rng.choice([0.35, 0.8])), "bathroom": 1.3, "kitchen": 1.1}.get(room.kind, 0.9)
            middle = (low + high) / 2 + rng.uniform(-0.3, 0.3) * max(0.0, span - width - 0.6)
            room.openings[side].append(Opening("window", middle - width / 2, middle + width / 2, sill, 2.15))


def draw_plan(rng: np.random.Generator, n_rooms: int, area_m2: float, dark_rooms: float) -> Plan:
    """Random plan with `n_rooms` rooms (3 to 6) on about `area_m2`, centred on the origin.

    Draws plans until every room has a good shape, all are reached by doors, and only hall, living room and kitchen are
    passed through. `dark_rooms` is the share of rooms whose lamp is off.
    """
    height = float(rng.uniform(2.5, 2.8))
    for attempt in range(5000):
        corridor = (n_rooms >= 5 or (n_rooms == 4 and rng.random() < 0.5)) and rng.random() < 0.6
        grown = area_m2 * (1 + attempt / 5000)
        ratio = rng.uniform(0.65, 1.0)
        width = float(np.sqrt(grown / ratio))
        depth = float(np.sqrt(grown * ratio))
        rooms = _cut(rng, width, depth, n_rooms, corridor)
        for room in rooms:
            room.x0 = room.x0 - width / 2
            room.x1 = room.x1 - width / 2
            room.y0 = room.y0 - depth / 2
            room.y1 = room.y1 - depth / 2
        _name(rooms, corridor)
        doors = _spanning_doors(rooms) if all(_fits(r) for r in rooms) else None
        if doors is None:
            continue
        _add_doors(rng, rooms, doors, height)
        draw_windows(rng, rooms)
        for index in rng.permutation(n_rooms)[: round(dark_rooms * n_rooms)]:
            rooms[index].lamp_on = False
            rooms[index].curtains_closed = bool(rooms[index].kind != "kitchen" and rng.random() < 0.5)
        return Plan(rooms, doors, height)
    raise RuntimeError("no floor plan found in 5000 attempts")  # pragma: no cover - the area grows until one fits
