"""Images of cameras of any model that COLMAP knows, from those that pinholes take around the same centre."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.geometry.poses import Float
from wheretolook.rendering.types import Rendering

if TYPE_CHECKING:
    from wheretolook.rendering.types import Renderer

MARGIN_PX = 2  # of each face of the cube around its 90 degrees, for interpolation at its edges
LARGEST_FACE_PX = 4096  # a camera that magnifies more is rendered less sharply than it could see

_FACES = np.array([
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]],  # ahead
    [[0, 0, -1], [0, 1, 0], [1, 0, 0]],  # right
    [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],  # left
    [[1, 0, 0], [0, 0, -1], [0, 1, 0]],  # down
    [[1, 0, 0], [0, 0, 1], [0, -1, 0]],  # up
    [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],  # behind
], dtype=np.float64)  # fmt: skip
"""Rotations face_from_camera (6, 3, 3) of the faces of a cube."""


def render_distorted(renderer: Renderer, camera: ColmapCamera, cam_from_world: Float) -> Rendering:
    """What `Renderer.render` gives for poses (B, 3, 4), by looking up each pixel's ray on a cube around the camera.

    A pixel is black, and its depth 0, where the model has no ray. Depth is along the optical axis: below 0 behind it.
    """
    face, columns_rows, along = _lookup(camera)
    pinhole = _face_camera(camera)
    shape = (len(cam_from_world), camera.height, camera.width)
    rgb = np.zeros((*shape, 3), dtype=np.uint8)
    depth_m = np.zeros(shape, dtype=np.float32)
    for number in np.unique(face[face >= 0]).tolist():
        seen = renderer.render(pinhole, _FACES[number] @ cam_from_world)
        there = face == number
        (x, y) = columns_rows
        for view in range(len(cam_from_world)):
            colors = cv2.remap(seen.rgb[view], x, y, cv2.INTER_LINEAR)
            depths = cv2.remap(seen.depth_m[view], x, y, cv2.INTER_NEAREST)
            rgb[view][there] = colors[there]
            depth_m[view][there] = (depths * along)[there]
    return Rendering(rgb, depth_m)


def _face_camera(camera: ColmapCamera) -> PinholeCamera:
    focal = min(LARGEST_FACE_PX / 2, np.ceil(camera.mean_focal_px))
    side = int(2 * (focal + MARGIN_PX))
    return PinholeCamera(side, side, float(focal))


@lru_cache(maxsize=8)
def _lookup(
    camera: ColmapCamera,
) -> tuple[NDArray[np.int8], tuple[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32]]:
    """For each pixel (H, W): face of the cube, -1 for none; column and row there; z of its ray over the face's."""
    pixels = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), axis=-1)
    rays = camera.unproject(pixels)
    # beyond what a model was made for, such as 90 degrees for COLMAP's fisheyes, rays come back of other pixels
    known = np.abs(camera.project(rays) - pixels).max(-1) < 0.01
    depths = np.nan_to_num(rays) @ _FACES[:, 2].T  # (H, W, 6): along the axis of each face
    face = depths.argmax(-1)
    in_face = (_FACES[face] @ np.nan_to_num(rays)[..., None])[..., 0]
    in_face[~known] = (0, 0, 1)
    at = (_face_camera(camera).project(in_face) - 0.5).astype(np.float32)  # OpenCV counts from pixel centres
    along = (np.nan_to_num(rays[..., 2]) / in_face[..., 2]).astype(np.float32)
    return np.where(known, face, -1).astype(np.int8), (at[..., 0].copy(), at[..., 1].copy()), along
