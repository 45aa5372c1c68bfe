"""Plain version of the compact layout of bins."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def compact(means: NDArray[np.float32], filled: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Move the filled bins of (B, C, bins, bins) to the front, row by row."""
    flat = means.reshape(*means.shape[:2], -1)
    order = np.argsort(~filled.reshape(len(filled), -1), axis=1, kind="stable")
    return np.take_along_axis(flat, order[:, None, :], axis=2).reshape(means.shape)
