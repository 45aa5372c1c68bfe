"""Materials painted for one surface each: pictures, posters, rugs, book spines, packages, views from a window."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from wheretolook_rooms.materials import SIZE, Canvas, Colour, Image, Material, fill, mix, vary

PALETTES: tuple[tuple[Colour, ...], ...] = (
    ((0.93, 0.88, 0.78), (0.80, 0.36, 0.22), (0.16, 0.25, 0.34), (0.88, 0.67, 0.28), (0.35, 0.48, 0.44)),
    ((0.95, 0.94, 0.90), (0.14, 0.15, 0.18), (0.73, 0.18, 0.17), (0.20, 0.36, 0.60), (0.92, 0.76, 0.22)),
    ((0.86, 0.89, 0.87), (0.22, 0.38, 0.33), (0.55, 0.66, 0.50), (0.78, 0.62, 0.47), (0.30, 0.25, 0.22)),
    ((0.92, 0.85, 0.86), (0.55, 0.25, 0.38), (0.25, 0.22, 0.40), (0.85, 0.55, 0.48), (0.44, 0.56, 0.68)),
    ((0.90, 0.90, 0.88), (0.30, 0.30, 0.30), (0.60, 0.59, 0.57), (0.12, 0.12, 0.12), (0.78, 0.76, 0.72)),
)


def palette(rng: np.random.Generator) -> list[Colour]:
    """Five colours that go together, slightly varied."""
    colours = PALETTES[int(rng.integers(len(PALETTES)))]
    return [vary(rng, c, 0.03) for c in colours]


def _ellipses(
    canvas: Canvas, image: Image, rng: np.random.Generator, colours: list[Colour], count: int, size: tuple[float, float]
) -> Image:
    x = canvas.unit_x
    y = canvas.unit_y
    for _ in range(count):
        cx, cy = rng.random(2)
        a, b = rng.uniform(*size, 2)
        c = np.cos(angle := rng.uniform(0, np.pi))
        s = np.sin(angle)
        u = ((x - cx) * c + (y - cy) * s) / a
        v = ((y - cy) * c - (x - cx) * s) / b
        distance = np.abs(u) + np.abs(v) if rng.random() < 0.3 else np.hypot(u, v)
        inside = np.clip((1 - distance) * min(a, b) * canvas.width, 0, 1)
        colour = np.asarray(colours[int(rng.integers(len(colours)))], np.float32)
        image = mix(image, colour, rng.uniform(0.6, 1.0) * inside)
    return image


def _rectangles(image: Image, rng: np.random.Generator, colours: list[Colour], count: int) -> Image:
    height, width = image.shape[:2]
    for _ in range(count):
        x0 = int(rng.uniform(-0.1, 0.9) * width)
        y0 = int(rng.uniform(-0.1, 0.9) * height)
        x1 = x0 + 2 + int(rng.uniform(0.04, 0.4) * width)
        y1 = y0 + 2 + int(rng.uniform(0.04, 0.4) * height)
        image[max(y0, 0) : y1, max(x0, 0) : x1] = colours[int(rng.integers(len(colours)))]
    return image


def _text(
    image: Image, rng: np.random.Generator, ink: ArrayLike, box: tuple[float, float, float, float], line_px: int
) -> Image:
    """Lines of letter-like strokes inside a box (left, top, right, bottom as shares of the image)."""
    height, width = image.shape[:2]
    left = int(box[0] * width)
    top = int(box[1] * height)
    right = int(box[2] * width)
    bottom = int(box[3] * height)
    glyph = max(2, round(0.55 * line_px))
    for y in range(top, bottom - line_px + 1, max(2, round(1.6 * line_px))):
        end = right - int(rng.uniform(0, 0.35) * (right - left))
        x = left
        while x + glyph <= end:
            if rng.random() > 0.16:
                cells = rng.random((3, 2)) < 0.62
                strokes = np.kron(cells, np.ones((-(-line_px // 3), -(-glyph // 2)), bool))[:line_px, : glyph - 1]
                image[y : y + line_px, x : x + glyph - 1][strokes] = ink
            x += glyph
    return image


def _landscape(canvas: Canvas, rng: np.random.Generator, colours: list[Colour]) -> Image:
    sky = vary(rng, (0.55, 0.70, 0.85), 0.08)
    low = vary(rng, (0.93, 0.82, 0.68), 0.06)
    image = mix(sky, low, np.broadcast_to(canvas.unit_y**0.8, canvas.shape))
    shift = (int(rng.integers(SIZE)), int(rng.integers(SIZE)))
    cloud = np.clip(0.3 * canvas.crop(canvas.noise.cloud, shift, step=3), 0, 0.6)
    image = mix(image, 0.96, cloud)
    if rng.random() < 0.6:
        image = _ellipses(canvas, image, rng, [(0.98, 0.9, 0.7)], 1, (0.05, 0.1))
    tint = np.asarray(vary(rng, (0.25, 0.38, 0.28), 0.08), np.float32)
    layers = int(rng.integers(3, 6))
    for i in range(layers):
        ridge = canvas.noise.cloud[int(rng.integers(SIZE)), (np.arange(canvas.width) * (2 + 2 * i) + shift[1]) % SIZE]
        horizon = 0.35 + 0.5 * (i + 0.5) / layers + 0.05 * ridge
        inside = np.clip((canvas.unit_y - horizon) * canvas.height + 0.5, 0, 1)
        fade = (i + 1) / layers
        colour = np.asarray(low) * (1 - fade) + tint * fade
        detail = 1 + 0.14 * fade * canvas.crop(canvas.noise.fine, (shift[0] + 50 * i, shift[1]))
        image = mix(image, (colour * detail[..., None]).astype(np.float32), inside)
    return _ellipses(canvas, image, rng, colours[1:], int(rng.integers(8, 30)), (0.008, 0.03))


def _abstract(canvas: Canvas, rng: np.random.Generator, colours: list[Colour]) -> Image:
    shift = (int(rng.integers(SIZE)), int(rng.integers(SIZE)))
    value = canvas.crop(canvas.noise.cloud, shift, step=3)
    steps = np.digitize(value, np.sort(rng.uniform(-1.2, 1.2, 4)))
    image = np.asarray(colours, np.float32)[steps]
    image = image * (1 + 0.05 * canvas.crop(canvas.noise.fine, shift))[..., None]
    return _ellipses(canvas, image, rng, colours, int(rng.integers(8, 30)), (0.012, 0.1))


def _geometric(canvas: Canvas, rng: np.random.Generator, colours: list[Colour]) -> Image:
    image = _rectangles(fill(canvas, colours[0]), rng, colours, int(rng.integers(15, 60)))
    return _ellipses(canvas, image, rng, colours, int(rng.integers(4, 24)), (0.015, 0.12))


def _poster(canvas: Canvas, rng: np.random.Generator, colours: list[Colour]) -> Image:
    image = _ellipses(canvas, fill(canvas, colours[0]), rng, colours[1:], int(rng.integers(6, 20)), (0.02, 0.22))
    bar = int(canvas.height * rng.uniform(0.62, 0.8))
    image[bar:] = colours[int(rng.integers(5))]
    ink = (0.06, 0.06, 0.08) if image[bar:].mean() > 0.45 else (0.95, 0.94, 0.9)
    image = _text(image, rng, ink, (0.08, bar / canvas.height + 0.03, 0.95, 0.84), max(4, canvas.height // 14))
    return _text(image, rng, ink, (0.08, 0.86, 0.9, 0.98), max(2, canvas.height // 45))


def picture(rng: np.random.Generator, mat: float = 0.0) -> Material:
    """A picture of a random kind; `mat` is the width of its white border as a share of its width."""
    seed = int(rng.integers(2**31))
    kind = int(rng.integers(4))
    colours = palette(rng)

    def paint(canvas: Canvas) -> Image:
        local = np.random.default_rng(seed)
        image = (_landscape, _abstract, _geometric, _poster)[kind](canvas, local, colours)
        border = min(round(mat * canvas.width), canvas.height // 2)
        if border:
            bare = image[border:-border, border:-border]
            image = np.pad(bare, ((border, border), (border, border), (0, 0)), constant_values=0.93)
        return image

    return Material(paint)


def rug(rng: np.random.Generator, richness: float = 1.0) -> Material:
    """A rug: ornament mirrored about both axes inside borders, stripes, or nearly plain."""
    seed = int(rng.integers(2**31))
    colours = palette(rng)
    kind = "ornament" if rng.random() < 0.25 + 0.4 * richness else ("stripes" if rng.random() < 0.5 else "plain")
    shift = (int(rng.integers(SIZE)), int(rng.integers(SIZE)))

    def paint(canvas: Canvas) -> Image:
        local = np.random.default_rng(seed)
        x = np.broadcast_to(np.abs(canvas.unit_x - 0.5), canvas.shape) * canvas.width / canvas.texels_per_m
        y = np.broadcast_to(np.abs(canvas.unit_y - 0.5), canvas.shape) * canvas.height / canvas.texels_per_m
        edge = np.minimum(x.max() - x, y.max() - y)
        if kind == "ornament":
            rows = (y * canvas.texels_per_m).astype(int)
            columns = (x * canvas.texels_per_m).astype(int)
            field = canvas.noise.cloud[(rows * 2 + shift[0]) % SIZE, (columns * 2 + shift[1]) % SIZE]
            field = field + 0.5 * np.sin(18 * x) * np.sin(18 * y)
            image = np.asarray(colours, np.float32)[np.digitize(field, [-0.9, -0.2, 0.3, 0.9])]
            image = image * 0.75 + 0.25 * np.asarray(colours[1], np.float32)
            medallion = (np.hypot(x / max(x.max(), 0.1), y / max(y.max(), 0.1)) < 0.42) & (np.sin(30 * (x + y)) > -0.3)
            image[medallion] = 0.6 * image[medallion] + 0.4 * np.asarray(colours[3], np.float32)
            for k, (low, high) in enumerate(((0.0, 0.03), (0.06, 0.16), (0.18, 0.2))):
                band = (edge >= low) & (edge < high)
                image[band] = colours[(k + 2) % 5]
                if k == 1:
                    along = np.where(x.max() - x < y.max() - y, y, x)
                    image[band & (np.sin(60 * along) + np.cos(40 * edge) > 0.6)] = colours[0]
        elif kind == "stripes":
            steps = np.sort(local.uniform(0, max(float(y.max()), 0.1), 7))
            image = np.asarray(colours, np.float32)[np.digitize(y, steps) % 5]
        else:
            image = fill(canvas, colours[0])
            image[(edge > 0.05) & (edge < 0.08)] = colours[1]
        return image * (1 + 0.05 * canvas.crop(canvas.noise.fine, shift))[..., None]

    return Material(paint)


def book_spine(rng: np.random.Generator, colour: ArrayLike) -> Material:
    """A spine: bands and a title of letter-like strokes, top to bottom."""
    seed = int(rng.integers(2**31))
    base = np.asarray(colour, np.float32)
    ink = vary(rng, (0.93, 0.88, 0.72) if base.mean() < 0.5 else (0.12, 0.1, 0.12), 0.04)
    accent = vary(rng, PALETTES[int(rng.integers(4))][int(rng.integers(1, 5))])

    def paint(canvas: Canvas) -> Image:
        local = np.random.default_rng(seed)
        image = fill(canvas, base)
        for _ in range(int(local.integers(0, 3))):
            top = local.uniform(0, 0.9)
            rows = slice(int(top * canvas.height), int((top + local.uniform(0.02, 0.14)) * canvas.height) + 1)
            image[rows] = accent if local.random() < 0.6 else ink
        if canvas.width >= 4:
            title = np.swapaxes(image, 0, 1)  # titles run down the spine
            size = max(2, int(canvas.width * local.uniform(0.3, 0.6)))
            top = (canvas.width - size) // 2
            start = local.uniform(0.06, 0.25)
            end = local.uniform(0.6, 0.95)
            _text(title, local, ink, (start, top / canvas.width, end, (top + size + 1) / canvas.width), size)
        return image

    return Material(paint)


def package(rng: np.random.Generator) -> Material:
    """Labels of boxes, tins, bottles, covers of books and magazines."""
    seed = int(rng.integers(2**31))
    colours = palette(rng)

    def paint(canvas: Canvas) -> Image:
        local = np.random.default_rng(seed)
        ground = fill(canvas, colours[int(local.integers(5))])
        image = _rectangles(ground, local, colours, int(local.integers(1, 5)))
        image = _ellipses(canvas, image, local, colours, int(local.integers(1, 4)), (0.08, 0.3))
        ink = (0.95, 0.95, 0.92) if image.mean() < 0.5 else (0.1, 0.1, 0.12)
        image = _text(image, local, ink, (0.1, 0.12, 0.95, 0.4), max(3, canvas.height // 8))
        return _text(image, local, ink, (0.1, 0.6, 0.95, 0.95), max(2, canvas.height // 22))

    return Material(paint)


def view(rng: np.random.Generator) -> Material:
    """The view from a window: a bright sky, hazy hills and perhaps houses. It emits the daylight."""
    shift = (int(rng.integers(SIZE)), int(rng.integers(SIZE)))
    seed = int(rng.integers(2**31))
    horizon = float(rng.uniform(0.5, 0.7))
    houses = bool(rng.random() < 0.5)

    def paint(canvas: Canvas) -> Image:
        local = np.random.default_rng(seed)
        shape = canvas.shape
        image = mix((0.78, 0.88, 0.97), (0.96, 0.97, 0.97), np.broadcast_to(canvas.unit_y / horizon, shape).clip(0, 1))
        image = mix(image, 0.98, np.clip(0.25 * canvas.crop(canvas.noise.cloud, shift), 0, 0.5))
        for i, colour in enumerate(((0.70, 0.78, 0.82), (0.58, 0.68, 0.62), (0.47, 0.58, 0.42))):
            ridge = canvas.noise.cloud[int(local.integers(SIZE)), (np.arange(canvas.width) + shift[1]) % SIZE]
            level = horizon + 0.11 * i + 0.03 * ridge
            inside = np.clip((canvas.unit_y - level) * canvas.height / 2 + 0.5, 0, 1)
            detail = 1 + 0.025 * (i + 1) * canvas.crop(canvas.noise.fine, (shift[0] + 90 * i, shift[1]))
            image = mix(image, (np.asarray(colour) * detail[..., None]).astype(np.float32), inside)
        if houses:
            for _ in range(int(local.integers(2, 6))):
                width = int(local.uniform(0.06, 0.2) * shape[1]) + 2
                top = int((horizon + local.uniform(-0.1, 0.1)) * shape[0])
                left = int(local.uniform(0, 1) * shape[1])
                bottom = top + int(0.3 * shape[0])
                image[top:bottom, left : left + width] = vary(local, (0.80, 0.76, 0.70), 0.05)
                image[max(top - 4, 0) : top, left : left + width] = vary(local, (0.62, 0.42, 0.36), 0.04)
                for y in range(top + 4, bottom - 6, 12):
                    for x in range(left + 3, left + width - 5, 10):
                        image[y : y + 6, x : x + 5] = (0.45, 0.5, 0.56)
        return np.clip(image, 0, 1)

    return Material(paint, emissive=True)


def screen(rng: np.random.Generator) -> Material:
    """A television or monitor that is off: near black with a soft sheen."""
    lean = float(rng.uniform(-0.5, 0.5))

    def paint(canvas: Canvas) -> Image:
        sheen = 0.05 + 0.04 * (canvas.unit_x * lean - canvas.unit_y + 1)
        return np.repeat(sheen[..., None], 3, axis=-1) * np.array([0.95, 1.0, 1.1], np.float32)

    return Material(paint)
