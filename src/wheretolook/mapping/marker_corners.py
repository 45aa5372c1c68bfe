"""Finds the corners of a marker in an image to hundredths of a pixel, from the edges between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float

_ROUNDS = 3  # of fitting lines to the edges between the corners
_SAMPLES = 32  # profiles across an edge
_AWAY_FROM_CORNERS = 0.15  # share of an edge left out at either end, where its neighbours blur into it
_STEPS_PER_PX = 4  # samples of a profile


def refine_corners(grey: NDArray[np.uint8], corners: Float) -> Float:
    """Move a marker's corners to where lines through its edges meet.

    OpenCV's refinement looks at a window around each corner. Blur rounds a corner off, so that it is found inside the
    square: in rendered images the sides come out 0.6 % short, which would become an error of the map's scale. Blur does
    not move an edge.

    Args:
        grey: (H, W) uint8.
        corners: (4, 2) in order, to a pixel or two; (0, 0) is the centre of the top-left pixel, as in OpenCV.

    Returns:
        (4, 2); the corners as given where an edge cannot be made out.
    """
    at = np.asarray(corners, dtype=np.float64)
    for _ in range(_ROUNDS):
        lines = [_edge_line(grey, at[side], at[(side + 1) % 4], at.mean(0)) for side in range(4)]
        if any(line is None for line in lines):
            return corners
        homogeneous = np.array([np.cross(lines[side - 1], lines[side]) for side in range(4)])  # type: ignore[arg-type]
        with np.errstate(divide="ignore", invalid="ignore"):
            moved = homogeneous[:, :2] / homogeneous[:, 2:]
        limit = 0.1 * np.linalg.norm(np.roll(at, -1, axis=0) - at, axis=1).min() + 1
        if not np.linalg.norm(moved - corners, axis=1).max() < limit:
            return corners
        at = moved
    return at


def _edge_line(grey: NDArray[np.uint8], start: Float, end: Float, inside: Float) -> Float | None:
    """The line (a, b, c), a x + b y + c = 0, of an edge between dark inside and bright outside; None if there is none.

    In a profile across the edge, the edge is at the mean position of the rise in brightness.
    """
    import cv2

    along = end - start
    length = float(np.linalg.norm(along))
    if length < 4:
        return None
    normal = np.array([-along[1], along[0]]) / length
    if normal @ (inside - start) > 0:
        normal = -normal
    half = float(np.clip(length / 16, 1.5, 6.0))  # within the black frame, a sixth to a tenth of the marker
    across = np.linspace(-half, half, 2 * round(half * _STEPS_PER_PX) + 1)
    share = np.linspace(_AWAY_FROM_CORNERS, 1 - _AWAY_FROM_CORNERS, _SAMPLES)
    middle = start + share[:, None] * along
    at = (middle[:, None] + across[:, None] * normal).astype(np.float32)
    profile = cv2.remap(grey.astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
    rise = np.maximum(np.diff(profile, axis=1), 0)
    total = rise.sum(1)
    strong = total > max(10.0, 0.5 * float(np.median(total)))
    if strong.sum() < _SAMPLES // 2:
        return None
    offset = (rise[strong] @ ((across[1:] + across[:-1]) / 2)) / total[strong]
    typical = np.abs(offset - np.median(offset))
    near = typical <= max(0.5, 3 * float(np.median(typical)))
    points = middle[strong][near] + offset[near, None] * normal
    center = points.mean(0)
    across_points = np.linalg.svd(points - center)[2][1]
    return np.array([*across_points, -across_points @ center])
