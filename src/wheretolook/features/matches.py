"""Matches of keypoints with landmarks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Matches(NamedTuple):
    """2D-3D matches of one image.

    Attributes:
        keypoints: (M,) rows of keypoints, ascending.
        landmarks: (M,) rows of their landmarks.
        near: (K, C) rows of the landmarks whose descriptors are nearest to each keypoint's.
        squared: (K, C) their squared distances, ascending.
    """

    keypoints: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    near: NDArray[np.int64]
    squared: NDArray[np.float32]

    @classmethod
    def none(cls, n_keypoints: int) -> Matches:
        """No matches of an image with so many keypoints."""
        rows = np.zeros(0, dtype=np.int64)
        return cls(rows, rows, np.zeros((n_keypoints, 0), dtype=np.int64), np.zeros((n_keypoints, 0), dtype=np.float32))
