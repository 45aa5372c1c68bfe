"""The landmarks of a map on a device, in an order that keeps neighbours together."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from wheretolook.utils.warp import start_warp, vec3_array

MORTON_BITS = 10  # bits along each axis of the curve that landmarks are ordered by


class DevicePoints:
    """Landmarks (N, 3) m on a device along a Morton curve, so that threads side by side have landmarks side by side.

    Attributes:
        positions: (N, 3) float64, metres, in the map's order.
        device: its full name.
        order: (N,) rows of the map in the order of the device's arrays.
        double: (N,) Warp array of vec3d.
    """

    def __init__(self, positions: ArrayLike, device: str = "cpu") -> None:
        self.positions = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
        self.device = start_warp(device)
        self.order = np.argsort(morton_codes(self.positions), kind="stable")
        self.double: Any = wp.array(self.positions[self.order], dtype=wp.vec3d, device=self.device)

    def __len__(self) -> int:
        return len(self.positions)

    @cached_property
    def single(self) -> Any:
        """(N,) Warp array of vec3."""
        return vec3_array(self.positions[self.order], self.device)

    @cached_property
    def rank(self) -> Any:
        """(N,) Warp array of int32: where the map's landmarks lie in the device's arrays, the inverse of `order`."""
        return wp.array(np.argsort(self.order).astype(np.int32), dtype=wp.int32, device=self.device)


def morton_codes(positions: NDArray[np.float64]) -> NDArray[np.int64]:
    """Place (N,) of points (N, 3) along a Morton curve through their bounding box; points not finite come first."""
    finite = np.isfinite(positions).all(1)
    codes = np.zeros(len(positions), dtype=np.int64)
    if not finite.any():
        return codes
    low, high = positions[finite].min(0) / 2, positions[finite].max(0) / 2  # halves: their difference is finite
    share = (positions[finite] / 2 - low) / np.maximum(high - low, 1e-12)
    cells = (share * ((1 << MORTON_BITS) - 1)).astype(np.int64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            codes[finite] |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return codes
