"""Small things: books, plants, bottles, bowls, lamps, pictures, clothes. Most stand on z = 0 around the origin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wheretolook_rooms import artwork, materials
from wheretolook_rooms.materials import Material
from wheretolook_rooms.patches import Patch, box, cushion, cylinder, lathe, movable, move, plane, slab_between, tube
from wheretolook_rooms.style import Style


def books_in_row(style: Style, length: float, height: float, depth: float) -> list[Patch]:
    """Books side by side along x from 0 to `length`, backs to y = 0, spines to the front."""
    rng = style.rng
    x = 0.0
    patches: list[Patch] = []
    while True:
        width = float(rng.uniform(0.014, 0.05))
        tall = float(rng.uniform(0.62, 0.92) * height)
        deep = float(min(rng.uniform(0.13, 0.2), depth - 0.01))
        if x + width > length:
            return patches
        if style.bernoulli(0.05):
            x += width  # a gap
            continue
        colour = materials.vary(rng, style.pick(style.cover_colours), 0.06)
        printed = style.bernoulli(0.35 + 0.6 * style.richness)
        spine = artwork.book_spine(rng, colour) if printed else materials.plain(rng, colour)
        cover = style.pick(style.covers)
        faces = {"front": spine, "top": style.paper}
        book = movable(box)((x, 0, 0), (x + width - 0.001, deep, tall), cover, faces=faces)
        book[0] = replace(book[0], density=1.9)
        patches += book
        x += width


@movable
def book_stack(style: Style, count: int) -> list[Patch]:
    """Books or magazines lying on each other, covers up."""
    rng = style.rng
    z = 0.0
    patches: list[Patch] = []
    for _ in range(count):
        w = rng.uniform(0.19, 0.3)
        d = rng.uniform(0.14, 0.21)
        h = rng.uniform(0.01, 0.035)
        faces = {"top": artwork.package(rng)}
        book = box((-w / 2, -d / 2, 0), (w / 2, d / 2, h), style.paper, faces=faces, density=1.6)
        patches += move(book, angle_rad=float(rng.normal(0, 0.25)), shift=(0, 0, z))
        z += h + 0.0005
    return patches


@movable
def bottle(style: Style, height: float) -> list[Patch]:
    """Bottle or jar with a label."""
    rng = style.rng
    h = height
    r = h * rng.uniform(0.13, 0.2)
    neck = rng.uniform(0.3, 0.8)
    colour = style.pick([(0.22, 0.36, 0.24), (0.75, 0.75, 0.72), (0.45, 0.28, 0.15), (0.85, 0.82, 0.7)])
    glass = materials.plain(rng, materials.vary(rng, colour, 0.05), shared=True)
    profile = [(0, h), (r * neck, h), (r * neck, 0.8 * h), (r, 0.62 * h), (r, 0.02 * h), (0, 0)]
    inner = r * 0.98
    outer = r * 1.03
    label = [(inner, 0.5 * h), (outer, 0.5 * h), (outer, 0.18 * h), (inner, 0.18 * h), (inner, 0.5 * h)]
    return lathe(profile, glass, sides=14) + lathe(label, artwork.package(rng), sides=14, density=2.0)


@movable
def package(style: Style) -> list[Patch]:
    """Cardboard box with a printed front."""
    rng = style.rng
    w = rng.uniform(0.07, 0.18)
    d = rng.uniform(0.04, 0.09)
    h = rng.uniform(0.1, 0.26)
    cover = style.pick(style.covers)
    faces = {"front": artwork.package(rng)}
    return box((-w / 2, -d / 2, 0), (w / 2, d / 2, h), cover, faces=faces, density=1.8)


@movable
def bowl(style: Style, radius: float, fruit: bool) -> list[Patch]:
    """Open bowl, with oranges or apples if asked for."""
    rng = style.rng
    r = radius
    h = radius * 0.5
    material = materials.plain(rng, materials.vary(rng, style.pick(style.cover_colours), 0.05), shared=True)
    inside = [(0, 0.02), (0.6 * r, 0.1 * h), (r * 0.96, h)]
    patches = lathe([*inside, (r, h), (0.7 * r, 0.06 * h), (0.4 * r, 0), (0, 0)], material, sides=24)
    if fruit:
        skin = materials.plain(rng, style.pick([(0.86, 0.5, 0.14), (0.72, 0.2, 0.14), (0.6, 0.7, 0.25)]), shared=True)
        for k in range(6):  # five around one on top
            angle = 2 * np.pi * k / 5
            off = 0.45 * r if k < 5 else 0.0
            centre = (off * np.cos(angle), off * np.sin(angle), 0.6 * h + (0.25 * h if k == 5 else 0))
            patches += sphere(centre, 0.24 * r, skin)
    return patches


def sphere(centre: tuple[float, float, float], radius: float, material: Material) -> list[Patch]:
    """Closed sphere."""
    angles = np.linspace(0, np.pi, 8)
    profile = [(radius * np.sin(a) if 0 < a < np.pi else 0.0, radius * np.cos(a)) for a in angles]
    return lathe(profile, material, sides=14, centre=centre)


@movable
def vase(style: Style, height: float) -> list[Patch]:
    """Closed vase with a belly."""
    rng = style.rng
    z = np.linspace(1, 0, 12)
    r = height * (0.16 + 0.13 * np.sin(np.pi * (1 - z) ** rng.uniform(0.7, 1.6)))
    pattern = style.pick(["plain", "stripes", "zigzag"])
    colour = materials.vary(rng, style.pick(style.cover_colours))
    second = style.pick(style.cover_colours)
    glaze = materials.fabric(rng, colour, second=second, pattern=pattern, weave=0.01, period_m=0.06)
    profile = [(0, 0.97 * height), *[(float(a), float(b) * height) for a, b in zip(r, z, strict=True)], (0, 0)]
    return lathe(profile, glaze, sides=20, density=1.4)


@movable
def plant(style: Style, height: float, leaves: int, reach_m: float) -> list[Patch]:
    """Potted plant: stems with curved, two-sided leaves, none of which reaches further than `reach_m` to the side."""
    rng = style.rng
    h = 0.3 * height
    r = 0.55 * h
    colour = materials.vary(rng, style.pick([(0.72, 0.42, 0.28), (0.85, 0.84, 0.8), (0.3, 0.32, 0.34)]), 0.03)
    pot = materials.plain(rng, colour)
    earth = materials.plain(rng, (0.22, 0.16, 0.11), speckle=0.15)
    profile = [(0, 0.88 * h), (r * 0.9, 0.88 * h), (r * 0.92, h), (r, h), (0.75 * r, 0), (0, 0)]
    patches = lathe(profile, pot, sides=20)
    patches += lathe([(0, 0.92 * h), (r * 0.91, 0.92 * h), (0, 0.9 * h)], earth, sides=20)
    stem = materials.plain(rng, (0.3, 0.36, 0.18), shared=True)
    wide = style.bernoulli(0.5)
    for _ in range(leaves):
        turn = rng.uniform(0, 2 * np.pi)
        lean = rng.uniform(0.1, 0.75)
        length = height * rng.uniform(0.18, 0.3)
        width = length * (0.55 if wide else 0.22) * rng.uniform(0.8, 1.1)
        rise = (height - h) * rng.uniform(0.35, 0.8)
        u = np.linspace(0, 1, 6)
        path = np.stack([0.35 * rise * lean * u**1.6, 0 * u, 0.9 * h + rise * u * (1 - 0.25 * lean * u)], -1)
        shrink = min(1.0, (reach_m - 0.01) / (path[-1, 0] + length * (np.sin(0.9 * lean) + 0.25 * lean)))
        path[:, 0] *= shrink
        grow = move(tube(path, np.linspace(0.006, 0.003, 6) * (0.4 + height), stem, sides=5), angle_rad=turn)
        v = np.linspace(1, 0, 9)
        half = 0.5 * width * np.sin(np.pi * v**0.8) ** 0.8 + 0.001
        along = lean * 0.9
        x = path[-1, 0] + shrink * length * (v * np.sin(along) + 0.25 * v**2 * lean)
        z = path[-1, 2] + length * (v * np.cos(along) - 0.45 * v**2 * lean)
        across = np.linspace(1, -1, 5)[None]
        half = half[:, None]
        grid = np.stack([np.repeat(x[:, None], 5, 1), half * across, z[:, None] + 0.35 * half * across**2], -1)
        under = along + 0.45 * lean
        thickness = 0.003 * np.array([-np.cos(under), 0, np.sin(under)])
        blade = slab_between(grid, grid - thickness, style.pick(style.leaves), (width, length))
        patches += grow + move(blade, angle_rad=turn)
    return patches


@movable
def picture_frame(style: Style, width: float, height: float) -> list[Patch]:
    """Framed picture: back at y = 0, centred on the origin in x and z."""
    depth = 0.025
    border = float(style.rng.uniform(0.015, 0.035))
    frame = style.pick([style.black, style.small_wood, style.small_white])
    w = width / 2
    h = height / 2
    patches = box((-w, 0, h - border), (w, depth, h), frame) + box((-w, 0, -h), (w, depth, border - h), frame)
    patches += box((-w, 0, border - h), (border - w, depth, h - border), frame)
    patches += box((w - border, 0, border - h), (w, depth, h - border), frame)
    right = (2 * border - width, 0, 0)
    down = (0, 0, 2 * border - height)
    return [*patches, plane((w - border, 0.6 * depth, h - border), right, down, style.print(), density=1.7)]


def shade(style: Style, radius: float, height: float, z: float, lit: bool) -> list[Patch]:
    """Cloth lamp shade, open below and above, glowing if lit."""
    colour = (1.0, 0.93, 0.80) if lit else (0.80, 0.77, 0.70)
    material = materials.glow(colour) if lit else materials.plain(style.rng, colour)
    r = radius
    top = z + height
    return lathe([(0.68 * r, top), (0.7 * r, top), (r, z), (0.98 * r, z), (0.68 * r, top)], material, sides=24)


def table_lamp(style: Style, lit: bool) -> list[Patch]:
    """Lamp about 0.45 m high; its bulb is at z = 0.36."""
    base = materials.plain(style.rng, materials.vary(style.rng, style.pick(style.cover_colours)), shared=True)
    foot = lathe([(0, 0.3), (0.012, 0.3), (0.012, 0.2), (0.06, 0.12), (0.07, 0.05), (0.05, 0), (0, 0)], base, sides=16)
    return foot + shade(style, 0.13, 0.18, 0.27, lit)


def floor_lamp(style: Style, lit: bool) -> list[Patch]:
    """Standard lamp; its bulb is at z = 1.5."""
    stand = cylinder(0.14, 0, 0.025, style.metal, sides=20) + cylinder(0.012, 0.025, 1.45, style.metal, sides=8)
    return stand + shade(style, 0.22, 0.28, 1.38, lit)


@movable
def pillow(style: Style, material: Material, size: float) -> list[Patch]:
    """Square pillow standing on its edge, front to +y."""
    half = size / 2
    thick = 0.14 * 0.45
    puff = (0, 0.3 * 0.14, 0)
    return cushion((-half, 0, 0), (half, thick, size), material, radius_m=0.03, puff=puff, span=6, hidden=())


@movable
def coat(style: Style) -> list[Patch]:
    """A garment hanging from z = 0 downwards, back at y = 0."""
    rng = style.rng
    material = materials.fabric(rng, materials.vary(rng, style.pick(style.cover_colours), 0.06), weave=0.04)
    n = 24
    m = 10
    length = rng.uniform(0.75, 1.05)
    u = np.linspace(0, 1, n + 1)[None]
    v = np.linspace(0, 1, m + 1)[:, None]
    half = 0.05 + 0.19 * np.minimum(1, 4 * v) + 0.03 * v
    fold = 0.025 * np.sin(2 * np.pi * (3.5 * u + rng.random())) * v
    front = np.stack([half * (1 - 2 * u), 0.07 + 0.05 * np.sin(np.pi * u) + fold, -length * v + 0 * u], -1)
    back = front.copy()
    back[..., 1] = 0.015
    return slab_between(front, back, material, (0.5, length))
