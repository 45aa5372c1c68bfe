"""What the camera sees at one place of a path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float

Pixels = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class PathView:
    """One view along a path.

    Attributes:
        position: (3,) world, metres.
        axis: (3,) unit optical axis, world.
        score: score of the view in [0, 1]; NaN if unknown.
        pixels: (K, 2) pixels of the landmarks in view.
        size_px: width and height of the image.
        rgb: (H, W, 3) uint8, the image; None if the scene cannot be rendered.
    """

    position: Float
    axis: Float
    score: float
    pixels: Float
    size_px: tuple[int, int]
    rgb: Pixels | None
