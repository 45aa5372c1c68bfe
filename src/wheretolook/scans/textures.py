"""Texture a mesh from photographs: every triangle shows the part of one photograph that it projects to.

Each photograph is a texture, so nothing is resampled. Among photographs that show a triangle about equally large, one
that shows many triangles is chosen, greedily, so that seams are few (set cover; the problem is that of Lempitsky and Ivanov,
"Seamless Mosaicing of Image-Based Texture Maps", CVPR 2007).
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import Float, transform
from wheretolook.geometry.similarity import poses_from
from wheretolook.rendering.registry import make_renderer
from wheretolook.rendering.warp_renderer import Renderer
from wheretolook.scans.frames import RgbdFrames, evenly

MAX_PHOTOGRAPHS = 100  # larger sets are subsampled evenly
_BEHIND_M = 0.03  # tolerance of the visibility of a corner: voxels and rounding
_EDGE_PX = 5  # window that must not contain nearer surface: at an edge, small pose errors change the surface
_MARGIN_PX = 8  # at the image's border
_GAINS = (0.5, 2.0)  # range of exposure correction
_MIN_AREA_SHARE = 0.5  # of the largest area in pixels of a triangle in any photograph


def textured(mesh: TexturedMesh, frames: RgbdFrames, device: str) -> TexturedMesh:
    """Texture a mesh with the photographs of frames; triangles that none shows get their vertex colours."""
    camera = frames.camera
    chosen = evenly(len(frames), MAX_PHOTOGRAPHS)
    poses = frames.cam_from_world[chosen]
    areas = np.zeros((len(chosen), len(mesh.triangles)), dtype=np.float16)
    renderer = make_renderer(mesh, device)
    for row, pose in enumerate(tqdm(poses, desc="find textures", unit="photograph")):
        areas[row] = _areas_px(mesh, renderer, camera, pose)
    photograph = _cover(areas)
    textures: list[NDArray[np.uint8]] = []
    uvs = np.zeros((len(mesh.triangles), 3, 2), dtype=np.float32)
    number = np.zeros(len(mesh.triangles), dtype=np.int32)
    for row in np.unique(photograph[photograph >= 0]).tolist():
        shown = np.flatnonzero(photograph == row)
        corners = mesh.vertices[mesh.triangles[shown]].reshape(-1, 3)
        pixels = camera.project(transform(poses_from(poses[row], mesh.origin), corners)).reshape(-1, 3, 2)
        uvs[shown] = pixels / (camera.width, camera.height)
        number[shown] = len(textures)
        textures.append(_as_exposed(frames.rgb(chosen[row]), pixels.mean(1), mesh, shown))
    rest = np.flatnonzero(photograph < 0)
    if len(rest):
        texture, uvs[rest] = _flat_colors(mesh, rest)
        number[rest] = len(textures)
        textures.append(texture)
    return replace(mesh, corner_uvs=uvs, triangle_texture=number, textures=tuple(textures), vertex_colors=None)


def _areas_px(mesh: TexturedMesh, renderer: Renderer, camera: PinholeCamera, pose: Float) -> NDArray[np.float16]:
    """Area in pixels of each triangle (T,) in a photograph; 0 if it is hidden, turned away or not completely inside."""
    depth = renderer.render(camera, pose[None]).depth_m[0]
    nearest = cv2.erode(np.where(depth > 0, depth, np.float32(np.inf)), np.ones((_EDGE_PX, _EDGE_PX), np.uint8))
    points = transform(poses_from(pose, mesh.origin), mesh.vertices)
    pixels = camera.project(points)
    z = points[:, 2]
    low = _MARGIN_PX
    high = np.array([camera.width, camera.height]) - _MARGIN_PX
    seen = (z > 0) & ((pixels >= low) & (pixels < high)).all(1)
    column, row = pixels[seen].astype(np.int64).T
    seen[seen] = z[seen] < nearest[row, column] + _BEHIND_M
    whole = np.flatnonzero(seen[mesh.triangles].all(1))
    a, b, c = np.moveaxis(pixels[mesh.triangles[whole]], 1, 0)
    ux, uy = (b - a).T
    vx, vy = (c - a).T
    areas = np.zeros(len(mesh.triangles), dtype=np.float16)
    areas[whole] = np.clip((uy * vx - ux * vy) / 2, 0, 60_000)  # fronts are clockwise where y points down
    return areas


def _cover(areas: NDArray[np.float16]) -> NDArray[np.int64]:
    """Choose the photograph of each triangle (T,), -1 for none, from the areas (F, T) in pixels."""
    best = areas.max(0)
    good = (areas > 0) & (areas >= np.float16(_MIN_AREA_SHARE) * best)
    chosen = np.full(areas.shape[1], -1)
    open_ones = good.sum(1)
    while open_ones.max() > 0:
        row = int(open_ones.argmax())
        covered = np.flatnonzero(good[row])
        chosen[covered] = row
        open_ones -= good[:, covered].sum(1)
        good[:, covered] = False
    return chosen


def _as_exposed(
    rgb: NDArray[np.uint8], pixels: Float, mesh: TexturedMesh, triangles: NDArray[np.int64]
) -> NDArray[np.uint8]:
    """Scale a photograph's channels to the mean vertex colour of the triangles (N,) that it shows at (N, 2) px.

    Cameras adjust exposure and white balance for every photograph, which would leave edges at seams.
    """
    assert mesh.vertex_colors is not None
    column, row = pixels.astype(np.int64).T
    here = rgb[row, column].mean(0)
    wanted = mesh.vertex_colors[mesh.triangles[triangles]].mean((0, 1))
    gain = np.clip(wanted / np.maximum(here, 1), *_GAINS)
    return np.asarray(np.clip(np.rint(rgb * gain), 0, 255), dtype=np.uint8)


def _flat_colors(mesh: TexturedMesh, rows: NDArray[np.int64]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """A texture of one texel per triangle, in the mean colour of its corners, and the texture coordinates."""
    side = int(np.ceil(np.sqrt(len(rows))))
    texels = np.full((side * side, 3), 255, dtype=np.uint8)
    assert mesh.vertex_colors is not None
    texels[: len(rows)] = mesh.vertex_colors[mesh.triangles[rows]].mean(1).round()
    index = np.arange(len(rows))
    uv = (np.column_stack([index % side, index // side]) + 0.5) / side
    return texels.reshape(side, side, 3), np.repeat(uv[:, None], 3, axis=1).astype(np.float32)
