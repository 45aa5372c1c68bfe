"""Furniture that rooms are made of. Frame: x along the wall, y = 0 at the wall and growing into the room, z up."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from wheretolook_rooms import artwork, decor, materials
from wheretolook_rooms.materials import Material
from wheretolook_rooms.patches import Patch, box, cushion, movable, move, slab_between, tilted_back, tube
from wheretolook_rooms.style import Style

WALL_SIDE = ("back", "bottom")


def legs(
    width: float, y0: float, y1: float, top: float, material: Material, *, radius: float = 0.022, splay: float = 0.0
) -> list[Patch]:
    """Four tapered round legs under a rectangle of the given width, centred in x."""
    radii = [radius, 0.85 * radius, 0.65 * radius]
    patches: list[Patch] = []
    for side in (-1, 1):
        for y, dy in ((y0, -splay), (y1, splay)):
            x = side * width / 2
            dx = side * splay
            path = [(x, y, top), (x + dx / 2, y + dy / 2, top / 2), (x + dx, y + dy, 0.001)]
            patches += tube(path, radii, material, sides=10)
    return patches


@movable
def sofa(style: Style, seats: int) -> list[Patch]:
    """Sofa or armchair: frame, arms, swelling seat and back cushions, a few pillows; 0.9 m deep."""
    rng = style.rng
    cloth = style.upholstery
    arm = 0.17
    depth = 0.88
    seat = 0.62 if seats > 1 else 0.6
    width = seats * seat + 2 * arm
    w = width / 2
    inner = width / 2 - arm * 0.9
    patches = legs(width - 0.14, 0.1, depth - 0.1, 0.13, style.leg, radius=0.025)
    patches += cushion((-w, 0.02, 0.12), (w, depth, 0.3), cloth, radius_m=0.03, hidden=WALL_SIDE)
    patches += cushion((-inner, 0.02, 0.29), (inner, 0.24, 0.72), cloth, radius_m=0.06, hidden=WALL_SIDE)
    for x in (-w, w - arm):
        patches += cushion((x, 0.02, 0.29), (x + arm, depth, 0.6), cloth, radius_m=0.07, hidden=WALL_SIDE)
    for k in range(seats):
        x = -w + arm + k * seat
        low = (x + 0.004, 0.23, 0.295)
        high = (x + seat - 0.004, depth + 0.01, 0.43)
        patches += cushion(low, high, cloth, radius_m=0.045, puff=(0, 0.01, 0.025), span=7)
        low = (x + 0.01, 0.2, 0.43)
        high = (x + seat - 0.01, 0.36, 0.82)
        patches += cushion(low, high, cloth, radius_m=0.07, puff=(0, 0.03, 0.015), span=7)
    places = rng.permutation(np.linspace(-w + arm + 0.25, w - arm - 0.25, 2 * seats))
    for x in places[: int(rng.integers(1, seats + 1))]:
        tilt = float(rng.uniform(0.2, 0.35))
        patches += move(tilted_back(decor.pillow(style, style.patterned(), 0.4), tilt), shift=(x, 0.46, 0.475))
    return patches


def table(style: Style, width: float, depth: float, height: float, material: Material) -> list[Patch]:
    """Table with four legs; with an apron if it is high."""
    w = width / 2
    z = height - 0.035
    patches = box((-w, 0, z), (w, depth, height), material)
    patches += legs(width - 0.12, 0.06, depth - 0.06, z, style.leg, radius=0.028)
    if height > 0.6:
        patches += box((-w + 0.07, 0.05, z - 0.07), (w - 0.07, 0.07, z), style.small_wood)
        patches += box((-w + 0.07, depth - 0.07, z - 0.07), (w - 0.07, depth - 0.05, z), style.small_wood)
    return patches


@movable
def chair(style: Style, wooden: Material, cloth: Material) -> list[Patch]:
    """Dining chair, centred on the origin, its back towards -y."""
    patches = legs(0.36, -0.18, 0.18, 0.43, style.leg, radius=0.018, splay=0.02)
    patches += cushion((-0.22, -0.21, 0.43), (0.22, 0.22, 0.48), cloth, radius_m=0.022, puff=(0, 0, 0.012), span=5)
    for x in (-0.19, 0.19):
        patches += tube([(x, -0.19, 0.44), (x, -0.22, 0.65), (x, -0.26, 0.9)], 0.016, style.leg, sides=8)
    for z in (0.62, 0.74, 0.86):
        y = -0.2 - 0.07 * (z - 0.44) / 0.46
        patches += cushion((-0.2, y - 0.02, z - 0.035), (0.2, y + 0.005, z + 0.035), wooden, radius_m=0.011, hidden=())
    return patches


def bed(style: Style, width: float) -> list[Patch]:
    """Bed with headboard at the wall, mattress, duvet, pillows; 2.1 m long."""
    rng = style.rng
    length = 2.08
    w = width / 2
    frame = style.wood if style.bernoulli(0.6) else style.upholstery
    sheet = materials.fabric(rng, (0.90, 0.89, 0.86), weave=0.01)
    cover = style.patterned()
    head = float(rng.uniform(0.9, 1.15))
    patches = cushion((-w - 0.04, 0.02, 0), (w + 0.04, 0.1, head), frame, radius_m=0.02, hidden=WALL_SIDE)
    patches += box((-w - 0.03, 0.1, 0.12), (w + 0.03, length, 0.3), frame)
    patches += legs(width - 0.15, 0.2, length - 0.08, 0.12, style.leg, radius=0.03)
    patches += cushion((-w, 0.1, 0.3), (w, length - 0.02, 0.48), sheet, radius_m=0.05)
    patches += _duvet(rng, w + 0.03, length + 0.01, cover, (2 * w, length - 0.72))
    count = 2 if width > 1.2 else 1
    for k in range(count):
        x = (k - (count - 1) / 2) * width / count
        low = (x - 0.32, 0.14, 0.46)
        high = (x + 0.32, 0.56, 0.56)
        patches += cushion(low, high, sheet, radius_m=0.04, puff=(0, 0, 0.05), span=7)
        if style.bernoulli(0.6):
            patches += move(tilted_back(decor.pillow(style, cover, 0.38), 0.5), shift=(x, 0.62, 0.55))
    return patches


def _duvet(
    rng: np.random.Generator, half_width: float, end: float, cover: Material, size_m: tuple[float, float]
) -> list[Patch]:
    """Rippled cover from y = 0.72 to `end`, whose edges hang over the mattress."""
    x = np.broadcast_to(half_width * np.linspace(-1, 1, 37), (29, 37))
    y = np.broadcast_to((0.72 + (end - 0.72) * np.linspace(0, 1, 29))[:, None], x.shape)
    ripple = 0.012 * np.sin(7 * x + 3 * y + rng.uniform(0, 6)) + 0.01 * np.sin(4 * x - 9 * y + rng.uniform(0, 6))
    across = (half_width - np.abs(x)) / 0.06
    to_foot = (end - y) / 0.06
    to_head = (y - 0.72) / 0.08
    edge = np.clip(across, 0, 1) * np.clip(to_foot, 0, 1) * np.clip(to_head, 0, 1)
    fall = 0.48 - 0.16 * (1 - np.sqrt(edge * (2 - edge)))
    top = np.stack([x, y, np.maximum(fall + 0.045 * edge + ripple * edge, 0.33)], -1)[::-1]
    under = top.copy()
    under[..., 2] = 0.325
    return slab_between(top, under, cover, size_m)


def cabinet(
    style: Style,
    size: tuple[float, float, float],
    *,
    columns: int,
    rows: int = 1,
    carcass: Material | None = None,
    front: Material | None = None,
    plinth: float = 0.08,
    faces: dict[tuple[int, int], Material] | None = None,
) -> list[Patch]:
    """Carcass with a grid of doors or drawers and their handles.

    `size` is width, depth and height, `plinth` the height of the recessed foot, in metres. `faces` are the materials of
    single doors by column and row. Without materials, the carcass is of the style's wood, the doors are its fronts.
    """
    (width, depth, height) = size
    w = size[0] / 2
    carcass = carcass or style.wood
    front = front or style.front
    patches = box((-w, 0, plinth), (w, depth - 0.02, height), carcass, hidden=WALL_SIDE)
    if plinth > 0:
        patches += box((-w + 0.02, 0, 0), (w - 0.02, depth - 0.06, plinth), style.black, hidden=WALL_SIDE)
    cell_w = width / columns
    cell_h = (height - plinth) / rows
    for i in range(columns):
        for j in range(rows):
            x0 = -w + i * cell_w + 0.003
            z0 = plinth + j * cell_h + 0.003
            x1 = x0 + cell_w - 0.006
            z1 = z0 + cell_h - 0.006
            face = {"front": (faces or {}).get((i, j), front)}
            patches += box((x0, depth - 0.02, z0), (x1, depth, z1), front, faces=face, hidden=WALL_SIDE)
            if cell_h < 0.9 * cell_w:
                middle = (x0 + x1) / 2
                half = min(0.08, cell_w / 4)
                z = z1 - 0.05
                ends = ((middle - half, z), (middle + half, z))
            else:
                x = x1 - 0.04 if i % 2 == 0 else x0 + 0.04
                z = min(max(1.0, z0 + 0.2), z1 - 0.12)
                ends = ((x, z + 0.07), (x, z - 0.07))
            patches += tube([(x, depth + 0.02, z) for x, z in ends], 0.006, style.metal, sides=6)
    return patches


def bookshelf(style: Style, width: float, height: float, depth: float = 0.28) -> list[Patch]:
    """Open shelves full of books, with vases and boxes between."""
    rng = style.rng
    wooden = style.wood
    board = 0.022
    w = width / 2
    inner = width / 2 - board
    patches = box((-w, 0, 0), (-inner, depth, height), wooden) + box((inner, 0, 0), (w, depth, height), wooden)
    patches += box((-inner, 0, 0.04), (inner, 0.008, height), wooden, hidden=WALL_SIDE)
    levels = np.linspace(0.05, height - board, max(2, round(height / 0.36)) + 1)
    for z in levels:
        patches += box((-inner, 0.008, z), (inner, depth - 0.005, z + board), wooden, hidden=())
    for low, high in pairwise(levels):
        gap = high - low - board - 0.015
        x = -w + board + 0.01
        end = w - board - 0.01
        while end - x > 0.12:
            run = float(min(rng.uniform(0.25, 0.8), end - x))
            draw = rng.random()
            if draw < 0.35 + 0.55 * style.clutter:
                books = decor.books_in_row(style, run, gap, depth - 0.03)
                patches += move(books, shift=(x, 0.03, low + board))
            elif draw < 0.92 and run > 0.2:
                vase = style.bernoulli(0.5)
                gap_m = min(gap * 0.85, 0.26)
                item = decor.vase(style, gap_m) if vase else decor.book_stack(style, int(rng.integers(1, 4)))
                patches += move(item, shift=(x + run / 2, depth / 2, low + board))
            x += run + 0.005
    return patches


def wall_shelf(style: Style, width: float) -> list[Patch]:
    """Board on the wall, its top at z = 0, with books and a few things on it."""
    rng = style.rng
    w = width / 2
    x = -width / 2 + 0.03
    patches = box((-w, 0, -0.025), (w, 0.22, 0), style.wood, hidden=("back",))
    while w - x > 0.15:
        run = float(min(rng.uniform(0.2, 0.6), w - 0.03 - x))
        draw = rng.random()
        if draw < 0.55:
            patches += move(decor.books_in_row(style, run, 0.3, 0.2), shift=(x, 0.02, 0))
        elif draw < 0.7 and abs(x + run / 2) < w - 0.25:  # leaves must not reach past the end
            patches += move(decor.plant(style, 0.3, 16, 0.2), shift=(x + run / 2, 0.12, 0))
        else:
            item = decor.vase(style, 0.22) if draw < 0.85 else decor.package(style)
            patches += move(item, shift=(x + run / 2, 0.11, 0))
        x += run
    return patches


def media_unit(style: Style, width: float) -> list[Patch]:
    """Low cabinet with a television on it."""
    patches = cabinet(style, (width, 0.42, 0.48), columns=3)
    tv = min(1.25, width - 0.1)
    low = (-tv / 2, 0.14, 0.56)
    high = (tv / 2, 0.18, 0.56 + 0.57 * tv)
    patches += box(low, high, style.black, faces={"front": style.screen}, hidden=("back",))
    patches += box((-0.2, 0.08, 0.48), (0.2, 0.26, 0.495), style.black)
    patches += box((-0.04, 0.14, 0.495), (0.04, 0.17, 0.57), style.black)
    if width - tv > 0.5 and style.bernoulli(0.7):
        patches += move(decor.vase(style, 0.24), shift=(width / 2 - 0.12, 0.2, 0.48))
    return patches


def nightstand(style: Style, lit: bool) -> list[Patch]:
    """Bedside table with a lamp and books."""
    patches = cabinet(style, (0.42, 0.38, 0.5), columns=1, rows=2, plinth=0.06)
    patches += move(decor.table_lamp(style, lit), shift=(0.06, 0.16, 0.5))
    return patches + move(decor.book_stack(style, 1), shift=(-0.09, 0.28, 0.5))


def desk(style: Style, width: float) -> list[Patch]:
    """Desk with a monitor, keyboard, lamp and papers."""
    top = 0.74
    black = style.black
    patches = table(style, width, 0.65, top, style.second_wood)
    low = (-0.3, 0.16, top + 0.12)
    high = (0.3, 0.19, top + 0.47)
    patches += box(low, high, black, faces={"front": style.screen}, hidden=())
    patches += box((-0.1, 0.1, top), (0.1, 0.26, top + 0.012), black)
    patches += box((-0.025, 0.15, top + 0.012), (0.025, 0.17, top + 0.14), black)
    patches += box((-0.21, 0.4, top), (0.21, 0.53, top + 0.02), black)
    patches += move(decor.book_stack(style, 3), shift=(width / 2 - 0.2, 0.25, top))
    faces = {"top": artwork.package(style.rng)}
    paper = box((-0.105, -0.15, 0), (0.105, 0.15, 0.004), style.paper, faces=faces, density=1.5)
    return patches + move(paper, shift=(-width / 2 + 0.2, 0.42, top), angle_rad=0.2)
