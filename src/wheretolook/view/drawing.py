"""Arrays, meshes, images and HTML that the viewer shows; independent of the page."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from matplotlib import colormaps
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw
from scipy.spatial import ConvexHull

from wheretolook.geometry.camera import Camera, PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh, cut_above
from wheretolook.geometry.poses import Float, invert_poses
from wheretolook.scenes.loading import glb_bytes

Rgb = NDArray[np.uint8]

TRUE_POSITIVE = (0, 158, 115)
TRUE_NEGATIVE = (150, 150, 150)
FALSE_POSITIVE = (213, 94, 0)
FALSE_NEGATIVE = (0, 114, 178)
"""Colours of labelled views by prediction: localizes or not, as predicted or not."""

CAMERA_COLOR = (86, 180, 233)
LANDMARK_COLOR = (150, 150, 155)

CELL_PX = 6  # pixels of a floor's cell, so that its edges stay sharp
PICTURE_PX = 360  # width of images in the panel

_PUNCTUATION = re.compile(r"([!-/:-@\[-`{-~])")  # ASCII punctuation, which CommonMark escapes by a backslash


def escape_markdown(text: str) -> str:
    """Escape text from files or links, since the page renders Markdown with HTML."""
    return _PUNCTUATION.sub(r"\\\1", " ".join(text.split()))


@cache
def _colormap() -> Any:
    return colormaps["cividis"].with_extremes(bad="#787878")


def path_color(number: int) -> tuple[int, int, int]:
    """Return the colour of a path by its number."""
    colors = ((120, 120, 120), (0, 114, 178), (0, 158, 115), (204, 121, 167), (230, 159, 0))
    return colors[number % len(colors)]


def score_colors(values: Float, low: float = 0.0, high: float = 1.0) -> Rgb:
    """Map values between low and high to colours (..., 3); NaN to grey."""
    colors = _colormap()((values - low) / max(high - low, 1e-12), bytes=True)
    return np.array(colors, dtype=np.uint8)[..., :3]


def linear_light(colors: Any) -> Rgb:
    """Convert sRGB colours (..., 3) to linear light, which browsers expect at vertices."""
    return (255 * (np.asarray(colors) / 255.0) ** 2.2).round().astype(np.uint8)


def line_ends(colors: Any) -> Rgb:
    """Return the linear light of both ends of lines of the given colours (S, 3), (S, 2, 3)."""
    return np.repeat(linear_light(colors)[:, None], 2, axis=1)


def legend(low: float, high: float, quantity: str = "score") -> str:
    """Return the colour scale of a quantity as HTML."""
    stops = ",".join(f"rgb({red},{green},{blue})" for red, green, blue in score_colors(np.linspace(0, 1, 18)))
    bar = f"height:10px;border-radius:3px;background:linear-gradient(to right,{stops})"
    row = "display:flex;justify-content:space-between;font-size:12px;opacity:.8"
    ends = f"<span>{low:.3g}</span><span>{quantity}</span><span>{high:.3g}</span>"
    return f'<div style="padding:4px 12px"><div style="{bar}"></div><div style="{row}">{ends}</div></div>'


def floor_image(raster: Float, low: float, high: float, threshold: float | None) -> Rgb:
    """Draw a floor's scores (rows, columns) as RGBA, CELL_PX pixels per cell.

    Scores below the threshold are faded, NaN is transparent.
    """
    known = np.isfinite(raster)
    colors = score_colors(raster, low, high).astype(np.float64)
    if threshold is not None:
        below = known & (raster < threshold)
        grey = colors[below].mean(axis=1, keepdims=True) * 0.5 + 90
        colors[below] = 0.65 * grey + 0.35 * colors[below]
    image = np.dstack([colors, np.where(known, 235, 0)]).astype(np.uint8)
    return image.repeat(CELL_PX, axis=0).repeat(CELL_PX, axis=1)


def sphere_glb(directions: Float, scores: Float, low: float, high: float, radius_m: float) -> bytes:
    """Return a sphere around the origin as GLB, coloured by the score of each direction (D, 3)."""
    triangles = ConvexHull(directions).simplices
    a, b, c = np.moveaxis(directions[triangles], 1, 0)
    inward = (np.cross(b - a, c - a) * a).sum(1) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    mesh = TexturedMesh(
        (directions * radius_m).astype(np.float32),
        triangles.astype(np.int32),
        np.zeros((len(triangles), 3, 2), np.float32),
        np.zeros(len(triangles), np.int32),
        (np.full((4, 4, 3), 255, np.uint8),),
        linear_light(score_colors(scores, low, high)),
    )
    return glb_bytes(mesh)


def mesh_glb(mesh: TexturedMesh, cut_m: float | None) -> bytes:
    """Return the mesh below a height as GLB, its textures scaled down to 2048 px."""
    textures = [Image.fromarray(texture) for texture in mesh.textures]
    for texture in textures:
        texture.thumbnail((2048, 2048))
    small = replace(mesh, textures=tuple(map(np.asarray, textures)))
    return glb_bytes(small if cut_m is None else cut_above(small, cut_m), 80)


def frustum_corners(camera: Camera, cam_from_world: ArrayLike, depth_m: float) -> Float:
    """Compute the frustum corners (B, 5, 3) m of poses (B, 3, 4): centre, then image corners at a depth, from top left."""
    pixels = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (camera.width, camera.height)
    rays = camera.unproject(pixels)
    if isinstance(camera, PinholeCamera):  # corners of a fisheye can be behind it: they are at a distance
        rays = rays / rays[:, 2:]
    corners = np.concatenate([np.zeros((1, 3)), depth_m * rays])
    world_from_cam = invert_poses(np.asarray(cam_from_world, dtype=np.float64).reshape(-1, 3, 4))
    return corners @ np.swapaxes(world_from_cam[..., :3], -1, -2) + world_from_cam[:, None, :, 3]


def frustum_segments(camera: Camera, cam_from_world: ArrayLike, depth_m: float) -> Float:
    """Compute the eight edges (B, 8, 2, 3) m of camera frusta to a depth."""
    edges = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]])
    return frustum_corners(camera, cam_from_world, depth_m)[:, edges]


def frusta(camera: Camera, cam_from_world: Float, depth_m: float) -> Float:
    """Return the edges (S, 2, 3) m of at most 1500 camera frusta, evenly chosen."""
    n = len(cam_from_world)
    rows = np.unique(np.linspace(0, n - 1, min(n, 1500)).astype(int))
    return frustum_segments(camera, cam_from_world[rows], depth_m).reshape(-1, 2, 3)


@dataclass(frozen=True, eq=False)
class VisibleLandmarks:
    """The K landmarks visible in a view."""

    points: Float  # (K, 3) m
    pixels: Float  # (K, 2)
    probabilities: Float  # (K,) of being detected; NaN if unknown


def picture(rgb: Rgb | None, camera: Camera, visible: VisibleLandmarks) -> Rgb:
    """Draw visible landmarks in the colours of their probabilities on an image or a plain ground; (H, PICTURE_PX, 3)."""
    scale = PICTURE_PX / camera.width
    size = (PICTURE_PX, max(1, round(camera.height * scale)))
    ground = Image.new("RGB", size, (38, 40, 46)) if rgb is None else Image.fromarray(rgb).resize(size)
    draw = ImageDraw.Draw(ground)
    order = np.argsort(np.nan_to_num(visible.probabilities), kind="stable")  # probable ones on top
    colors = score_colors(visible.probabilities[order]).tolist()
    radius = 1.6  # of a landmark, in pixels of the picture
    for (x, y), color in zip(visible.pixels[order] * scale, colors, strict=True):
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=tuple(color))
    return np.asarray(ground)


def small_camera(camera: Camera) -> Camera:
    """Return a pinhole scaled down to the width of the panel's images; other cameras are returned unchanged."""
    if not isinstance(camera, PinholeCamera) or camera.width <= PICTURE_PX:
        return camera
    scale = PICTURE_PX / camera.width
    center = (camera.cx * scale, camera.cy * scale)
    return PinholeCamera(PICTURE_PX, max(1, round(camera.height * scale)), camera.fx * scale, camera.fy * scale, center)
