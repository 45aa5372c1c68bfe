"""Furniture that rooms are made of. Frame: x along the wall, y = 0 at the wall and growing into the room, z up."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from wheretolook.scenes.procedural import artwork, decor, materials
from wheretolook.scenes.procedural.materials import Material
from wheretolook.scenes.procedural.patches import Patch, box, cushion, move, slab_between, tilted_back, tube
from wheretolook.scenes.procedural.style import Style

WALL_SIDE = ("back", "bottom")


def leg(
    x: float, y: float, top: float, material: Material, *, radius: float = 0.022, splay: tuple[float, float] = (0, 0)
) -> list[Patch]:
    """Tapered round leg."""
    return tube(
        [(x, y, top), (x + splay[0] / 2, y + splay[1] / 2, top / 2), (x + splay[0], y + splay[1], 0.001)],
        [radius, 0.85 * radius, 0.65 * radius],
        material,
        sides=10,
    )


def legs(
    width: float, y0: float, y1: float, top: float, material: Material, *, radius: float = 0.022, splay: float = 0.0
) -> list[Patch]:
    """Four legs under a rectangle of the given width, centred in x."""
    return [
        p
        for sx in (-1, 1)
        for y, sy in ((y0, -1), (y1, 1))
        for p in leg(sx * width / 2, y, top, material, radius=radius, splay=(sx * splay, sy * splay))
    ]


def sofa(style: Style, seats: int) -> list[Patch]:
    """Sofa or armchair: frame, arms, swelling seat and back cushions, a few pillows; 0.9 m deep."""
    cloth, arm, depth = style.upholstery, 0.17, 0.88
    seat = 0.62 if seats > 1 else 0.6
    width = seats * seat + 2 * arm
    w = width / 2
    patches = legs(width - 0.14, 0.1, depth - 0.1, 0.13, style.leg(), radius=0.025)
    patches += cushion((-w, 0.02, 0.12), (w, depth, 0.3), cloth, radius_m=0.03, hidden=WALL_SIDE)
    patches += cushion(
        (-w + arm * 0.9, 0.02, 0.29), (w - arm * 0.9, 0.24, 0.72), cloth, radius_m=0.06, hidden=WALL_SIDE
    )
    for x in (-w, w - arm):
        patches += cushion((x, 0.02, 0.29), (x + arm, depth, 0.6), cloth, radius_m=0.07, hidden=WALL_SIDE)
    for k in range(seats):
        x = -w + arm + k * seat
        patches += cushion(
            (x + 0.004, 0.23, 0.295),
            (x + seat - 0.004, depth + 0.01, 0.43),
            cloth,
            radius_m=0.045,
            puff=(0, 0.01, 0.025),
            span=7,
        )
        patches += cushion(
            (x + 0.01, 0.2, 0.43), (x + seat - 0.01, 0.36, 0.82), cloth, radius_m=0.07, puff=(0, 0.03, 0.015), span=7
        )
    for x in style.rng.permutation(np.linspace(-w + arm + 0.25, w - arm - 0.25, 2 * seats))[
        : int(style.rng.integers(1, seats + 1))
    ]:
        tilt = float(style.rng.uniform(0.2, 0.35))
        patches += move(tilted_back(decor.pillow(style, style.patterned(), 0.4), tilt), shift=(x, 0.46, 0.475))
    return patches


def table(
    style: Style, width: float, depth: float, height: float, material: Material, *, thick: float = 0.035
) -> list[Patch]:
    """Table with four legs and an apron."""
    w = width / 2
    patches = box((-w, 0, height - thick), (w, depth, height), material)
    patches += legs(width - 0.12, 0.06, depth - 0.06, height - thick, style.leg(), radius=0.028)
    if height > 0.6:
        z = height - thick
        patches += box((-w + 0.07, 0.05, z - 0.07), (w - 0.07, 0.07, z), style.small_wood)
        patches += box((-w + 0.07, depth - 0.07, z - 0.07), (w - 0.07, depth - 0.05, z), style.small_wood)
    return patches


def chair(style: Style, wooden: Material, cloth: Material) -> list[Patch]:
    """Dining chair, centred on the origin, its back towards -y."""
    patches = legs(0.36, -0.18, 0.18, 0.43, style.leg(), radius=0.018, splay=0.02)
    patches += cushion((-0.22, -0.21, 0.43), (0.22, 0.22, 0.48), cloth, radius_m=0.022, puff=(0, 0, 0.012), span=5)
    for x in (-0.19, 0.19):
        patches += tube([(x, -0.19, 0.44), (x, -0.22, 0.65), (x, -0.26, 0.9)], 0.016, style.leg(), sides=8)
    for z in (0.62, 0.74, 0.86):
        y = -0.2 - 0.07 * (z - 0.44) / 0.46
        patches += cushion((-0.2, y - 0.02, z - 0.035), (0.2, y + 0.005, z + 0.035), wooden, radius_m=0.011, hidden=())
    return patches


def bed(style: Style, width: float) -> list[Patch]:
    """Bed with headboard at the wall, mattress, duvet, pillows; 2.1 m long."""
    rng, length, w = style.rng, 2.08, width / 2
    frame = style.wood if style.chance(0.6) else style.upholstery
    sheet = materials.fabric(rng, (0.90, 0.89, 0.86), weave=0.01)
    cover = style.patterned()
    patches = cushion(
        (-w - 0.04, 0.02, 0), (w + 0.04, 0.1, float(rng.uniform(0.9, 1.15))), frame, radius_m=0.02, hidden=WALL_SIDE
    )
    patches += box((-w - 0.03, 0.1, 0.12), (w + 0.03, length, 0.3), frame) + legs(
        width - 0.15, 0.2, length - 0.08, 0.12, style.leg(), radius=0.03
    )
    patches += cushion((-w, 0.1, 0.3), (w, length - 0.02, 0.48), sheet, radius_m=0.05)
    n, m = 36, 28
    s, t = np.linspace(-1, 1, n + 1), np.linspace(0, 1, m + 1)
    x = np.broadcast_to((w + 0.03) * s, (m + 1, n + 1))
    y = np.broadcast_to((0.72 + (length + 0.01 - 0.72) * t)[:, None], x.shape)
    ripple = 0.012 * np.sin(7 * x + 3 * y + rng.uniform(0, 6)) + 0.01 * np.sin(4 * x - 9 * y + rng.uniform(0, 6))
    edge = (
        np.clip((w + 0.03 - np.abs(x)) / 0.06, 0, 1)
        * np.clip((length + 0.01 - y) / 0.06, 0, 1)
        * np.clip((y - 0.72) / 0.08, 0, 1)
    )
    fall = 0.48 - 0.16 * (1 - np.sqrt(edge * (2 - edge)))
    top = np.stack([x, y, np.maximum(fall + 0.045 * edge + ripple * edge, 0.33)], -1)[::-1]
    under = top.copy()
    under[..., 2] = 0.325
    patches += slab_between(top, under, cover, (2 * w, length - 0.72))
    count = 2 if width > 1.2 else 1
    for k in range(count):
        x0 = (k - (count - 1) / 2) * width / count
        pillow = cushion(
            (x0 - 0.32, 0.14, 0.46), (x0 + 0.32, 0.56, 0.56), sheet, radius_m=0.04, puff=(0, 0, 0.05), span=7
        )
        patches += pillow
        if style.chance(0.6):
            patches += move(tilted_back(decor.pillow(style, cover, 0.38), 0.5), shift=(x0, 0.62, 0.55))
    return patches


def cabinet(
    style: Style,
    width: float,
    depth: float,
    height: float,
    *,
    columns: int,
    rows: int,
    carcass: Material,
    front: Material,
    plinth: float = 0.08,
    faces: dict[tuple[int, int], Material] | None = None,
) -> list[Patch]:
    """Carcass with a grid of doors or drawers and their handles."""
    w = width / 2
    patches = box((-w, 0, plinth), (w, depth - 0.02, height), carcass, hidden=WALL_SIDE)
    if plinth > 0:
        patches += box((-w + 0.02, 0, 0), (w - 0.02, depth - 0.06, plinth), style.black, hidden=WALL_SIDE)
    cell_w, cell_h = width / columns, (height - plinth) / rows
    for i in range(columns):
        for j in range(rows):
            x0, z0 = -w + i * cell_w + 0.003, plinth + j * cell_h + 0.003
            x1, z1 = x0 + cell_w - 0.006, z0 + cell_h - 0.006
            face = (faces or {}).get((i, j), front)
            patches += box((x0, depth - 0.02, z0), (x1, depth, z1), front, faces={"front": face}, hidden=WALL_SIDE)
            if cell_h < 0.9 * cell_w:
                c, half = (x0 + x1) / 2, min(0.08, cell_w / 4)
                patches += tube(
                    [(c - half, depth + 0.02, z1 - 0.05), (c + half, depth + 0.02, z1 - 0.05)],
                    0.006,
                    style.metal,
                    sides=6,
                )
            else:
                x = x1 - 0.04 if i % 2 == 0 else x0 + 0.04
                middle = min(max(1.0, z0 + 0.2), z1 - 0.12)
                patches += tube(
                    [(x, depth + 0.02, middle + 0.07), (x, depth + 0.02, middle - 0.07)], 0.006, style.metal, sides=6
                )
    return patches


def bookshelf(style: Style, width: float, height: float, depth: float = 0.28) -> list[Patch]:
    """Open shelves full of books, with vases and boxes between."""
    rng, w, board = style.rng, width / 2, 0.022
    wooden = style.wood
    patches = box((-w, 0, 0), (-w + board, depth, height), wooden) + box((w - board, 0, 0), (w, depth, height), wooden)
    patches += box((-w + board, 0, 0.04), (w - board, 0.008, height), wooden, hidden=WALL_SIDE)
    count = max(2, round(height / 0.36))
    levels = np.linspace(0.05, height - board, count + 1)
    for z in levels:
        patches += box((-w + board, 0.008, z), (w - board, depth - 0.005, z + board), wooden, hidden=())
    for low, high in pairwise(levels):
        gap, x = high - low - board - 0.015, -w + board + 0.01
        inner_end = w - board - 0.01
        while inner_end - x > 0.12:
            run = float(min(rng.uniform(0.25, 0.8), inner_end - x))
            draw = rng.random()
            if draw < 0.35 + 0.55 * style.clutter:
                item = decor.books_in_row(style, run, gap, depth - 0.03)
                patches += move(item, shift=(x, 0.03, low + board))
            elif draw < 0.92 and run > 0.2:
                item = (
                    decor.vase(style, min(gap * 0.85, 0.26))
                    if style.chance(0.5)
                    else decor.book_stack(style, int(rng.integers(1, 4)))
                )
                patches += move(item, shift=(x + run / 2, depth / 2, low + board))
            x += run + 0.005
    return patches


def wall_shelf(style: Style, width: float) -> list[Patch]:
    """Board on the wall, its top at z = 0, with books and a few things on it."""
    rng, w, x = style.rng, width / 2, -width / 2 + 0.03
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
    patches = cabinet(style, width, 0.42, 0.48, columns=3, rows=1, carcass=style.wood, front=style.front)
    tv = min(1.25, width - 0.1)
    bezel = box(
        (-tv / 2, 0.14, 0.56),
        (tv / 2, 0.18, 0.56 + 0.57 * tv),
        style.black,
        faces={"front": style.screen},
        hidden=("back",),
    )
    stand = box((-0.2, 0.08, 0.48), (0.2, 0.26, 0.495), style.black) + box(
        (-0.04, 0.14, 0.495), (0.04, 0.17, 0.57), style.black
    )
    patches += bezel + stand
    if width - tv > 0.5 and style.chance(0.7):
        patches += move(decor.vase(style, 0.24), shift=(width / 2 - 0.12, 0.2, 0.48))
    return patches


def nightstand(style: Style, lit: bool) -> list[Patch]:
    """Bedside table with a lamp and books."""
    patches = cabinet(style, 0.42, 0.38, 0.5, columns=1, rows=2, carcass=style.wood, front=style.front, plinth=0.06)
    patches += move(decor.table_lamp(style, lit), shift=(0.06, 0.16, 0.5))
    return patches + move(decor.book_stack(style, 1), shift=(-0.09, 0.28, 0.5))


def desk(style: Style, width: float) -> list[Patch]:
    """Desk with a monitor, keyboard, lamp and papers."""
    top = 0.74
    patches = table(style, width, 0.65, top, style.second_wood)
    patches += box(
        (-0.3, 0.16, top + 0.12), (0.3, 0.19, top + 0.47), style.black, faces={"front": style.screen}, hidden=()
    )
    patches += box((-0.1, 0.1, top), (0.1, 0.26, top + 0.012), style.black) + box(
        (-0.025, 0.15, top + 0.012), (0.025, 0.17, top + 0.14), style.black
    )
    patches += box((-0.21, 0.4, top), (0.21, 0.53, top + 0.02), style.black)
    patches += move(decor.book_stack(style, 3), shift=(width / 2 - 0.2, 0.25, top))
    paper = box(
        (-0.105, -0.15, 0), (0.105, 0.15, 0.004), style.paper, faces={"top": artwork.package(style.rng)}, density=1.5
    )
    patches += move(paper, shift=(-width / 2 + 0.2, 0.42, top), angle_rad=0.2)
    return patches
