"""Arrays, meshes and pictures that the viewer shows, from what was computed; nothing here knows the page."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import Camera, PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import Float

Rgb = NDArray[np.uint8]

UNKNOWN = (120, 120, 120)  # of what nothing is known
GOOD = (0, 158, 115)
BAD = (150, 150, 150)
PROMISED = (213, 94, 0)
MISSED = (0, 114, 178)
"""Labelled views: localized as said, not localized as said, said to localize and not, not said to and localized."""

FADE = 0.65  # share of grey in the colour of a place below the threshold
CELL_PX = 6  # pixels of a floor's cell: its edges stay sharp
MOST_FRUSTA = 1500  # mapping cameras that are drawn
DARK_GROUND = np.full((2, 2, 3), (72, 74, 80), np.uint8)
"""What is behind the scene in the dark: on black, the blue of low scores would not be seen."""

PICTURE_PX = 360  # width of pictures in the panel


@lru_cache(1)
def _colors() -> Rgb:
    """Cividis, 256 colours; the project's figures show scores with it."""
    from matplotlib import colormaps

    return (np.asarray(colormaps["cividis"](np.linspace(0, 1, 256)))[:, :3] * 255).round().astype(np.uint8)


def score_colors(values: Float, low: float = 0.0, high: float = 1.0) -> Rgb:
    """Colours (..., 3) of values from low to high; NaN is `UNKNOWN`."""
    known = np.isfinite(values)
    share = np.clip((np.where(known, values, low) - low) / max(high - low, 1e-12), 0, 1)
    colors = _colors()[(share * 255).round().astype(np.int64)]
    colors[~known] = UNKNOWN
    return colors


def linear_light(colors: Any) -> Rgb:
    """Colours (..., 3) as a browser's 3D graphics takes them at vertices: of sRGB it would make paler ones."""
    return (255 * (np.asarray(colors) / 255.0) ** 2.2).round().astype(np.uint8)


def legend(low: float, high: float, unit: str) -> str:
    """The scale of colours, as HTML."""
    stops = ",".join("rgb({},{},{})".format(*_colors()[k]) for k in range(0, 256, 15))
    bar = f"height:10px;border-radius:3px;background:linear-gradient(to right,{stops})"
    row = "display:flex;justify-content:space-between;font-size:12px;opacity:.8"
    ends = f"<span>{low:.3g}</span><span>{unit}</span><span>{high:.3g}</span>"
    return f'<div style="padding:4px 12px"><div style="{bar}"></div><div style="{row}">{ends}</div></div>'


def floor_image(raster: Float, low: float, high: float, threshold: float | None) -> Rgb:
    """A floor (rows * CELL_PX, columns * CELL_PX, 4): coloured by score, paler below the threshold, clear where a
    camera cannot be. Row 0 is the lowest y."""
    colors = score_colors(raster, low, high).astype(np.float64)
    if threshold is not None:
        below = np.isfinite(raster) & (raster < threshold)
        grey = colors[below].mean(axis=1, keepdims=True) * 0.5 + 90
        colors[below] = FADE * grey + (1 - FADE) * colors[below]
    alpha = np.where(np.isfinite(raster), 235, 0)[..., None]
    image = np.concatenate([colors, alpha], axis=-1).astype(np.uint8)
    return np.repeat(np.repeat(image, CELL_PX, axis=0), CELL_PX, axis=1)


def sphere_glb(directions: Float, scores: Float, low: float, high: float, radius_m: float) -> bytes:
    """A ball around the origin, each direction in the colour of its score."""
    from scipy.spatial import ConvexHull

    from wheretolook.scenes.loading import glb_bytes

    triangles = ConvexHull(directions).simplices
    a, b, c = np.moveaxis(directions[triangles], 1, 0)
    inward = (np.cross(b - a, c - a) * a).sum(1) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    mesh = TexturedMesh(
        (directions * radius_m).astype(np.float32), triangles.astype(np.int32),
        np.zeros((len(triangles), 3, 2), np.float32), np.zeros(len(triangles), np.int32),
        (np.full((4, 4, 3), 255, np.uint8),), linear_light(score_colors(scores, low, high)),
    )  # fmt: skip
    return glb_bytes(mesh)


def mesh_glb(mesh: TexturedMesh, cut_m: float | None, largest_px: int = 2048) -> bytes:
    """The mesh below a height as a GLB file, its textures no larger than a browser likes."""
    from PIL import Image

    from wheretolook.scenes.cutting import cut_above
    from wheretolook.scenes.loading import glb_bytes

    textures = []
    for texture in mesh.textures:
        scale = min(1.0, largest_px / max(texture.shape[:2]))
        size = (max(1, round(texture.shape[1] * scale)), max(1, round(texture.shape[0] * scale)))
        textures.append(texture if scale == 1 else np.asarray(Image.fromarray(texture).resize(size)))
    small = replace(mesh, textures=tuple(textures))
    return glb_bytes(small if cut_m is None else cut_above(small, cut_m), 80)


def frusta(camera: Camera, cam_from_world: Float, depth_m: float) -> Float:
    """Edges (S, 2, 3) m of cameras, evenly chosen if there are too many to be drawn."""
    from wheretolook.figures.dollhouse import frustum_segments

    rows = np.unique(np.linspace(0, len(cam_from_world) - 1, min(len(cam_from_world), MOST_FRUSTA)).astype(int))
    return frustum_segments(camera, np.asarray(cam_from_world, dtype=np.float64)[rows], depth_m).reshape(-1, 2, 3)


def picture(rgb: Rgb | None, camera: Camera, pixels: Float, values: Float, dots: bool = True) -> Rgb:
    """What a view shows (H, W, 3), W = PICTURE_PX: an image or a plain ground, with the landmarks in their colours."""
    from PIL import Image, ImageDraw

    scale = PICTURE_PX / camera.width
    size = (PICTURE_PX, max(1, round(camera.height * scale)))
    ground = Image.new("RGB", size, (38, 40, 46)) if rgb is None else Image.fromarray(rgb).resize(size)
    if dots:
        draw = ImageDraw.Draw(ground)
        radius = 1.6
        order = np.argsort(np.nan_to_num(values, nan=0.0), kind="stable")  # the likely ones on top
        colors = score_colors(values)
        for row in order:
            x, y = (float(value) * scale for value in pixels[row])
            draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=tuple(colors[row].tolist()))
    return np.asarray(ground)


def small_camera(camera: Camera) -> Camera:
    """The camera with images as large as the panel shows; only a pinhole can be made smaller."""
    if not isinstance(camera, PinholeCamera) or camera.width <= PICTURE_PX:
        return camera
    scale = PICTURE_PX / camera.width
    center = (camera.cx * scale, camera.cy * scale)
    return PinholeCamera(PICTURE_PX, max(1, round(camera.height * scale)), camera.fx * scale, camera.fy * scale, center)


def label_arrows(positions: Float, axes: Float, colors: Any, length_m: float) -> tuple[Float, Rgb]:
    """Line segments (B, 2, 3) from places along axes, and their colours (B, 2, 3)."""
    segments = np.stack([positions, positions + length_m * axes], axis=1)
    return segments, np.repeat(linear_light(colors)[:, None], 2, axis=1)


def size_of(points: Float) -> float:
    """How large a scene is: the diagonal of the box around it, without outliers, metres."""
    low, high = np.quantile(points, (0.02, 0.98), axis=0)
    return float(np.linalg.norm(high - low))
