"""Kernel between views, and the correction of log-odds by localized views."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from wheretolook.geometry.poses import Float

REACH = 4.0  # lengths beyond which the kernel, below 4e-4, is cut to zero


def nearness(
    centers: Float, axes: Float, other_centers: Float, other_axes: Float, length_m: float, sharpness: float
) -> Float:
    """Return the kernel (B, N) between views (B, 3) m and (N, 3) m with unit optical axes, 1 for the same view.

    A Gaussian of the distance between the cameras, with standard deviation `length_m`, times a von Mises-Fisher kernel
    of the angle between their axes, exp(sharpness (cos - 1)); 0 beyond `REACH` lengths.
    """
    squared = ((centers[:, None] - other_centers[None]) ** 2).sum(-1) / length_m**2
    kernel = np.exp(-squared / 2 + sharpness * (axes @ other_axes.T - 1))
    return np.where(squared <= REACH**2, kernel, 0.0)


class Correction:
    """The sum over N views of their weights (N,), each times its kernel with the query view."""

    def __init__(self, centers: Float, axes: Float, weights: Float, length_m: float, sharpness: float) -> None:
        self.centers = centers
        self.axes = axes
        self.weights = weights
        self.length_m = length_m
        self.sharpness = sharpness
        self._tree = cKDTree(centers)

    def at(self, centers: Float, axes: Float) -> Float:
        """Return the correction (B,) of views at centers (B, 3) m with optical axes (B, 3)."""
        values = np.zeros(len(centers))
        locations, row, counts = np.unique(centers, axis=0, return_inverse=True, return_counts=True)
        rows_by_location = np.split(np.argsort(row.reshape(-1), kind="stable"), np.cumsum(counts)[:-1])
        for location, rows in zip(locations, rows_by_location, strict=False):
            values[rows] = self._at_location(location, axes[rows])
        return values

    def grid(self, locations: Float, directions: Float) -> Float:
        """Return the correction (L, D) of views at locations (L, 3) m along each of directions (D, 3)."""
        values = [self._at_location(location, directions) for location in locations]
        return np.array(values).reshape(len(locations), len(directions))

    def _at_location(self, location: Float, axes: Float) -> Float:
        near = np.array(self._tree.query_ball_point(location, REACH * self.length_m), dtype=np.int64)
        squared = ((self.centers[near] - location) ** 2).sum(1) / self.length_m**2
        by_distance = self.weights[near] * np.exp(-squared / 2)
        return np.asarray(np.exp(self.sharpness * (axes @ self.axes[near].T - 1)) @ by_distance)
