"""Chooses which images of a map to match: those whose views share surface."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import camera_centers, transform

_SAMPLES_ACROSS = 16  # surface points taken from an image, in x
DEPTH_STRIDE = 4  # depth images are kept at every fourth pixel, the centre of each 4 x 4 block being the one at index 2
_ANGLE_DEG = (1.0, 55.0)  # between the rays of two images: less triangulates badly, more than that SIFT does not match
_DEPTH_RATIO = 2.5  # between the distances of two images to a point: beyond it, the scales differ too much
_DEPTH_TOLERANCE = 0.05


def shrink_depth(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Every fourth pixel of depth images (..., H, W), for `surface_overlap`."""
    half = DEPTH_STRIDE // 2
    return depth_m[..., half::DEPTH_STRIDE, half::DEPTH_STRIDE].copy()


def surface_overlap(
    camera: PinholeCamera, cam_from_world: NDArray[np.floating[Any]], depth_m: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Share of the surface in one image that another image sees too, similarly enough for the two to be matched.

    A point counts if the other image's depth agrees with it (5 %), if the rays of the two images meet at 1 to 55
    degrees, and if their depths differ by less than a factor of 2.5.

    Args:
        camera: intrinsics of all images.
        cam_from_world: (I, 3, 4) poses.
        depth_m: (I, h, w) z-depth from `shrink_depth`; 0 where there is none.

    Returns:
        (I, I) symmetric: the mean of both directions' shares, in [0, 1]; 0 on the diagonal.
    """
    n, h, w = depth_m.shape
    step = max(1, w // _SAMPLES_ACROSS)
    grid = np.meshgrid(np.arange(step // 2, h, step), np.arange(step // 2, w, step), indexing="ij")
    rows, columns = (axis.ravel() for axis in grid)
    pixels = np.column_stack([columns, rows]) * DEPTH_STRIDE + DEPTH_STRIDE // 2 + 0.5
    rays = np.column_stack([(pixels - (camera.cx, camera.cy)) / camera.focal_px, np.ones(len(pixels))])
    depth = depth_m[:, rows, columns].astype(np.float64)
    centers = camera_centers(cam_from_world)
    points = centers[:, None] + depth[..., None] * (rays @ np.asarray(cam_from_world)[:, :, :3])
    seen_from = points - centers[:, None]
    seen_from /= np.maximum(np.linalg.norm(seen_from, axis=-1, keepdims=True), 1e-9)
    closest, farthest = np.cos(np.radians(_ANGLE_DEG))
    share = np.zeros((n, n))
    for j in range(n):
        in_j = transform(cam_from_world[j], points.reshape(-1, 3)).reshape(points.shape)
        pixel, z = camera.project(in_j), in_j[..., 2]
        inside = (z > 0) & camera.in_image(pixel) & (depth > 0)
        index = np.where(inside[..., None], pixel, 0).astype(np.int64) // DEPTH_STRIDE
        there = depth_m[j, np.minimum(index[..., 1], h - 1), np.minimum(index[..., 0], w - 1)]
        ray = points - centers[j]
        cosine = (ray * seen_from).sum(-1) / np.maximum(np.linalg.norm(ray, axis=-1), 1e-9)
        shared = inside & (np.abs(there - z) < _DEPTH_TOLERANCE * z)
        shared &= (cosine > farthest) & (cosine < closest)
        shared &= (z < _DEPTH_RATIO * depth) & (depth < _DEPTH_RATIO * z)
        share[:, j] = shared.mean(1)
    np.fill_diagonal(share, 0)
    return (share + share.T) / 2


def choose_pairs(overlap: NDArray[np.float64], partners: int, min_overlap: float = 0.05) -> NDArray[np.int64]:
    """Pairs (P, 2) of each image with its `partners` images of largest overlap; i < j, sorted, each pair once.

    `overlap` (I, I) is symmetric; pairs of less than `min_overlap` are left out. An image can be in more than
    `partners` pairs, since others choose it too.
    """
    best = np.argsort(-overlap, axis=1, kind="stable")[:, :partners]
    first = np.repeat(np.arange(len(overlap)), best.shape[1])
    second = best.ravel()
    good = overlap[first, second] >= max(min_overlap, np.finfo(float).tiny)
    pairs = np.sort(np.column_stack([first, second])[good], axis=1)
    return np.unique(pairs, axis=0).reshape(-1, 2)
