"""Kitchen units, appliances, sanitary ware, radiators, curtains, doors. Frame as in `furniture`."""

from __future__ import annotations

import numpy as np

from wheretolook_rooms import artwork, decor, materials
from wheretolook_rooms.furniture import WALL_SIDE, cabinet
from wheretolook_rooms.materials import Material
from wheretolook_rooms.patches import Patch, box, cushion, cylinder, lathe, move, slab_between, tube
from wheretolook_rooms.style import Style

Corner = tuple[float, float, float]


def trough(low: Corner, high: Corner, rim: float, floor: float, material: Material) -> list[Patch]:
    """Basin: four walls of thickness `rim` around a bottom of thickness `floor`."""
    (x0, y0, z0) = low
    (x1, y1, z1) = high
    patches = box((x0, y0, z0), (x1, y0 + rim, z1), material, hidden=WALL_SIDE)
    patches += box((x0, y1 - rim, z0), (x1, y1, z1), material)
    patches += box((x0, y0 + rim, z0), (x0 + rim, y1 - rim, z1), material)
    patches += box((x1 - rim, y0 + rim, z0), (x1, y1 - rim, z1), material)
    return patches + box((x0 + rim, y0 + rim, z0), (x1 - rim, y1 - rim, z0 + floor), material)


def tap(style: Style, height: float) -> list[Patch]:
    """Mixer tap; stands on z = 0, spout to +y."""
    bend = np.linspace(0, np.pi, 8)
    path = [(0, 0, 0), (0, 0, 0.6 * height)]
    path += [(0, 0.07 - 0.07 * np.cos(a), 0.75 * height + 0.25 * height * np.sin(a)) for a in bend]
    return tube(path, 0.011, style.metal, sides=8) + cylinder(0.022, 0, 0.03, style.metal, sides=12)


def kitchen_run(style: Style, width: float, height: float, window: bool) -> list[Patch]:
    """Base units with worktop, sink, hob and oven; wall units above unless a window is there; things on the worktop."""
    rng = style.rng
    depth = 0.6
    top = 0.9
    w = width / 2
    columns = max(2, round(width / 0.6))
    colour = materials.vary(rng, style.pick([(0.32, 0.32, 0.33), (0.78, 0.75, 0.70), (0.60, 0.46, 0.34)]), 0.03)
    stone = materials.marble(rng, colour, (0.9, 0.88, 0.84), 0.25 + 0.5 * style.richness)
    hob = int(rng.integers(columns))
    sink = (hob + max(1, columns // 2)) % columns
    cell = width / columns
    size = (width, depth, top - 0.04)
    oven = {(hob, 0): artwork.screen(rng)}
    patches = cabinet(style, size, columns=columns, carcass=style.front, plinth=0.1, faces=oven)
    sx = -w + (sink + 0.5) * cell
    basin_w = min(0.5, cell - 0.06)
    y0 = 0.12
    y1 = 0.5
    for low, high in (
        ((-w, 0), (sx - basin_w / 2, depth + 0.02)),
        ((sx + basin_w / 2, 0), (w, depth + 0.02)),
        ((sx - basin_w / 2, 0), (sx + basin_w / 2, y0)),
        ((sx - basin_w / 2, y1), (sx + basin_w / 2, depth + 0.02)),
    ):
        patches += box((*low, top - 0.04), (*high, top), stone, hidden=WALL_SIDE, offset_m=(low[0], 0))
    patches += box((sx - basin_w / 2, y0, top - 0.04), (sx + basin_w / 2, y1, top - 0.03), style.metal)
    patches += move(tap(style, 0.3), shift=(sx, 0.06, top))
    hx = -w + (hob + 0.5) * cell
    patches += box((hx - 0.27, 0.06, top), (hx + 0.27, 0.55, top + 0.008), style.black)
    for dx, dy, r in ((-0.13, 0.18, 0.09), (0.13, 0.18, 0.07), (-0.13, 0.42, 0.07), (0.13, 0.42, 0.09)):
        patches += move(cylinder(r, 0.008, 0.011, style.metal, sides=20), shift=(hx + dx, dy, top))
    if style.bernoulli(0.6):
        enamel = materials.plain(rng, style.pick([(0.7, 0.7, 0.72), (0.6, 0.16, 0.14), (0.2, 0.28, 0.36)]), shared=True)
        pot = lathe([(0, 0.135), (0.02, 0.135), (0.02, 0.12), (0.1, 0.11), (0.1, 0), (0, 0)], enamel, sides=24)
        patches += move(pot, shift=(hx + 0.13, 0.42, top + 0.0115))
    if not window:
        size = (width, 0.34, min(height - 0.15, 2.2) - 1.45)
        above = cabinet(style, size, columns=columns, carcass=style.front, plinth=0.0)
        patches += move(above, shift=(0, 0, 1.45))
    for x in np.arange(-w + 0.12, w - 0.1, 0.2):
        free = abs(x - sx) > basin_w / 2 + 0.1 and abs(x - hx) > 0.4
        if not free or not style.bernoulli(0.25 + 0.6 * style.clutter):
            continue
        kind = rng.integers(5 if abs(x) < w - 0.3 else 4)  # leaves must not reach past the end
        item = [
            lambda: decor.bottle(style, float(rng.uniform(0.16, 0.3))),
            lambda: decor.package(style),
            lambda: decor.bowl(style, 0.09, False),
            lambda: decor.vase(style, 0.2),
            lambda: decor.plant(style, 0.3, 14, 0.2),
        ][int(kind)]()
        patches += move(item, shift=(x + rng.uniform(-0.02, 0.02), rng.uniform(0.14, 0.3), top))
    return patches


def fridge(style: Style) -> list[Patch]:
    """Fridge with a few notes on its door."""
    shell = materials.plain(style.rng, style.pick([(0.72, 0.73, 0.74), (0.9, 0.9, 0.89)]))
    patches = box((-0.3, 0.02, 0), (0.3, 0.6, 1.85), shell, hidden=WALL_SIDE)
    for low, high in ((0.03, 0.68), (0.69, 1.84)):
        patches += box((-0.3, 0.6, low), (0.3, 0.64, high), shell, hidden=("back",))
    patches += tube([(0.25, 0.67, 1.3), (0.25, 0.67, 0.8)], 0.009, style.metal, sides=8)
    for _ in range(round(5 * style.clutter)):
        x = style.rng.uniform(-0.2, 0.12)
        z = style.rng.uniform(0.85, 1.65)
        w, h = style.rng.uniform(0.05, 0.12, 2)
        faces = {"front": artwork.package(style.rng)}
        patches += box((x, 0.64, z), (x + w, 0.642, z + h), style.paper, faces=faces, density=1.6)
    return patches


def bathtub(style: Style, width: float) -> list[Patch]:
    """Built-in bathtub with a tap and a few bottles on its rim."""
    patches = trough((-width / 2, 0.0, 0.0), (width / 2, 0.75, 0.56), 0.09, 0.14, style.ceramic)
    patches += move(tap(style, 0.16), shift=(width / 4, 0.03, 0.56))
    for x in np.arange(-width / 2 + 0.15, 0, 0.12):
        if style.bernoulli(0.3 + 0.4 * style.clutter):
            patches += move(decor.bottle(style, 0.2), shift=(x, 0.045, 0.56))
    return patches


def toilet(style: Style) -> list[Patch]:
    """Toilet with cistern."""
    white = style.ceramic
    patches = cushion((-0.19, 0.02, 0.38), (0.19, 0.2, 0.8), white, radius_m=0.025, hidden=("back",))
    profile = [(0, 0.44), (0.19, 0.44), (0.2, 0.41), (0.19, 0.34), (0.12, 0.14), (0.13, 0.0), (0, 0.0)]
    bowl = move(lathe(profile, white, sides=28), rotation=np.diag([1.0, 1.25, 1.0]))
    patches += move(bowl, shift=(0, 0.42, 0))
    return patches + box((-0.11, 0.02, 0), (0.11, 0.3, 0.379), white, hidden=WALL_SIDE)


def basin(style: Style) -> list[Patch]:
    """Washbasin on a cabinet with a mirror above; bottles next to the tap."""
    patches = cabinet(style, (0.62, 0.42, 0.72), columns=2, carcass=style.front)
    patches += trough((-0.34, 0.0, 0.72), (0.34, 0.47, 0.86), 0.04, 0.03, style.ceramic)
    patches += move(tap(style, 0.16), shift=(0, 0.02, 0.86))
    glass = materials.plain(style.rng, (0.70, 0.75, 0.77))
    patches += box((-0.32, 0, 1.15), (0.32, 0.03, 1.95), style.metal, faces={"front": glass}, hidden=("back",))
    for x in (-0.28, 0.28):
        if style.bernoulli(0.4 + 0.5 * style.clutter):
            patches += move(decor.bottle(style, 0.15), shift=(x, 0.021, 0.86))
    return patches


def washing_machine(style: Style) -> list[Patch]:
    """Washing machine with its door."""
    patches = box((-0.3, 0.02, 0), (0.3, 0.58, 0.85), style.white, hidden=WALL_SIDE)
    door = cylinder(0.19, 0, 0.03, style.metal, sides=32) + cylinder(0.14, 0.03, 0.04, style.black, sides=32)
    patches += move(door, rotation=[[1, 0, 0], [0, 0, 1], [0, -1, 0]], shift=(0, 0.58, 0.42))
    panel = {"front": artwork.package(style.rng)}
    return patches + box((-0.29, 0.58, 0.73), (0.29, 0.585, 0.83), style.white, faces=panel, hidden=("back",))


def towel(style: Style) -> list[Patch]:
    """Towel over a rail; origin at the middle of the rail's wall side."""
    patches = tube([(-0.3, 0.06, 0), (0.3, 0.06, 0)], 0.009, style.metal, sides=8)
    for x in (-0.29, 0.29):
        patches += tube([(x, 0, 0), (x, 0.06, 0)], 0.007, style.metal, sides=6)
    cloth = style.patterned()
    n = 16
    m = 8
    u = np.linspace(0, 1, n + 1)[None]
    v = np.linspace(0, 1, m + 1)[:, None]
    front = np.stack([0.22 - 0.44 * u + 0 * v, 0.078 + 0.008 * np.sin(9 * u) * v, 0.011 - 0.55 * v + 0 * u], -1)
    back = front.copy()
    back[..., 1] = 0.05
    return patches + slab_between(front, back, cloth, (0.44, 0.55))


def radiator(style: Style, width: float, height: float) -> list[Patch]:
    """Column radiator: a row of equal slender elements."""
    count = max(4, round(width / 0.06))
    white = style.small_white
    patches: list[Patch] = []
    for x in (np.arange(count) - (count - 1) / 2) * 0.06:
        low = (x - 0.022, 0.04, 0.12)
        high = (x + 0.022, 0.14, 0.12 + height)
        patches += cushion(low, high, white, radius_m=0.02, rounding=2, span=1)
    half = count * 0.03
    for z in (0.18, 0.06 + height):
        patches += tube([(-half, 0.09, z), (half, 0.09, z)], 0.016, white, sides=8)
    for x in (-half + 0.1, half - 0.1):
        patches += tube([(x, 0.09, 0.15), (x, 0.09, 0)], 0.01, white, sides=6)
    return patches


def curtain(width: float, height: float, material: Material) -> list[Patch]:
    """Wavy curtain from z = 0 (top) down; y = 0 is its middle."""
    folds = max(3, round(width / 0.11))
    n = 8 * folds
    m = 6
    u = np.linspace(0, 1, n + 1)[None]
    v = np.linspace(0, 1, m + 1)[:, None]
    wave = (0.028 + 0.008 * v) * np.sin(2 * np.pi * folds * u) + 0.008 * np.sin(2 * np.pi * 1.7 * u + 2 * v)
    front = np.stack([width / 2 - width * u + 0 * v, wave, -height * v + 0 * u], -1)
    return slab_between(front, front - np.array([0, 0.006, 0]), material, (1.4 * width, height))


def front_door(style: Style, width: float, height: float) -> list[Patch]:
    """Closed door leaf with panels, handle and frame; back at y = 0."""
    w = width / 2
    wooden = style.second_wood
    patches = box((-w, 0, 0), (w, 0.03, height), wooden, hidden=("back", "bottom"))
    for x0, x1 in ((-w + 0.1, -0.04), (0.04, w - 0.1)):
        for z0, z1 in ((0.15, 0.9), (1.05, height - 0.15)):
            patches += box((x0, 0.03, z0), (x1, 0.04, z1), wooden, hidden=("back",), offset_m=(x0, z0))
    for x0, x1 in ((-w - 0.08, -w), (w, w + 0.08)):
        patches += box((x0, 0, 0), (x1, 0.045, height + 0.08), style.trim, hidden=WALL_SIDE)
    patches += box((-w, 0, height), (w, 0.045, height + 0.08), style.trim, hidden=("back",))
    handle = [(w - 0.06, 0.04, 1.02), (w - 0.06, 0.08, 1.02), (w - 0.17, 0.08, 1.02)]
    return patches + tube(handle, 0.01, style.metal, sides=8)


def coat_rack(style: Style, count: int) -> list[Patch]:
    """Board with hooks at z = 1.75 and coats on some of them."""
    half = 0.16 * count
    patches = box((-half, 0, 1.7), (half, 0.02, 1.8), style.wood, hidden=("back",))
    for k in range(count):
        x = -half + 0.16 + 0.32 * k
        patches += tube([(x, 0.02, 1.75), (x, 0.08, 1.75), (x, 0.09, 1.79)], 0.006, style.metal, sides=6)
        if style.bernoulli(0.45 + 0.3 * style.clutter):
            patches += move(decor.coat(style), shift=(x, 0, 1.74))
    return patches
