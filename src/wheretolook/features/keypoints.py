"""Keypoints of an image with their descriptors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of one image."""

    pixels: NDArray[np.float32]  # (N, 2) (x, y) in pixels; (0.5, 0.5) is the centre of the top-left pixel
    # (N, D) of unit length; of SIFT (N, 128) RootSIFT (Arandjelovic and Zisserman, CVPR 2012)
    descriptors: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.pixels)

    @classmethod
    def none(cls, dimension: int = 128) -> Keypoints:
        """No keypoints, with descriptors of a dimension."""
        return cls(np.zeros((0, 2), np.float32), np.zeros((0, dimension), np.float32))
