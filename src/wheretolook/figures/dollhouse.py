"""Drawing on pictures of a scene from above."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from numpy.typing import ArrayLike

from wheretolook.figures.house_image import Dollhouse
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import Float, invert_poses

BLUE, SKY, GREEN, ORANGE, VERMILION, PURPLE = "#0072B2", "#56B4E9", "#009E73", "#E69F00", "#D55E00", "#CC79A7"
"""The colours of Okabe and Ito (2008), which colour-blind people can tell apart."""


def draw_house(axes: Axes, house: Dollhouse, fade: float = 0.5) -> None:
    """Draw the picture, with axes in its pixels; `fade` makes it paler, from 0 (as it is) to 1 (white)."""
    height, width = house.rgb.shape[:2]
    rgb = 255 * (house.rgb / 255.0) ** 0.7  # rooms without a lamp are dark
    axes.imshow((rgb + fade * (255 - rgb)).astype(np.uint8), extent=(0, width, height, 0))
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal")
    axes.axis("off")


def draw_points(axes: Axes, house: Dollhouse, points: ArrayLike, **style: Any) -> None:
    """Draw world points (N, 3) m as dots."""
    pixels = house.pixels(points).reshape(-1, 2)
    axes.scatter(pixels[:, 0], pixels[:, 1], **{"linewidths": 0, **style})


def draw_segments(axes: Axes, house: Dollhouse, segments: ArrayLike, **style: Any) -> LineCollection:
    """Draw lines between pairs of world points (..., 2, 3) m."""
    pixels = house.pixels(np.asarray(segments)).reshape(-1, 2, 2)
    lines = LineCollection(list(pixels), **{"capstyle": "round", **style})
    axes.add_collection(lines, autolim=False)
    return lines


def frustum_corners(camera: PinholeCamera, cam_from_world: ArrayLike, depth_m: float) -> Float:
    """Corners (B, 5, 3) m of cameras (B, 3, 4): centre, then the image's corners at a depth, from top left."""
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (camera.cx, camera.cy) / camera.focal_px
    corners = np.concatenate([np.zeros((1, 3)), depth_m * np.column_stack([half, np.ones(4)])])
    world_from_cam = invert_poses(np.asarray(cam_from_world, dtype=np.float64).reshape(-1, 3, 4))
    return corners @ np.swapaxes(world_from_cam[..., :3], -1, -2) + world_from_cam[:, None, :, 3]


def frustum_segments(camera: PinholeCamera, cam_from_world: ArrayLike, depth_m: float) -> Float:
    """The eight edges (B, 8, 2, 3) m of camera frusta down to a depth."""
    edges = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]])
    return frustum_corners(camera, cam_from_world, depth_m)[:, edges]
