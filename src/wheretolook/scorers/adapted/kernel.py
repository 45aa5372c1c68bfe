"""Nearness of views: how much one that was localized tells of another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from wheretolook.geometry.poses import Float

REACH = 4.0  # lengths beyond which a view tells nothing: there the kernel is below 4e-4


def nearness(
    centers: Float, axes: Float, other_centers: Float, other_axes: Float, length_m: float, sharpness: float
) -> Float:
    """The kernel (B, N) between views (B, 3) m and (N, 3) m with unit optical axes, 1 for the same view.

    A Gaussian of the distance between the cameras, with standard deviation `length_m`, times a von Mises-Fisher kernel
    of the angle between their axes, exp(sharpness (cos - 1)); 0 beyond `REACH` lengths.
    """
    squared = ((centers[:, None] - other_centers[None]) ** 2).sum(-1) / length_m**2
    kernel = np.exp(-squared / 2 + sharpness * (axes @ other_axes.T - 1))
    return np.where(squared <= REACH**2, kernel, 0.0)


class Correction:
    """The sum over N views of their weights (N,), each times its nearness to the view asked for.

    `grid` is for many directions at the same places: what the distance tells is computed once for all.
    """

    def __init__(self, centers: Float, axes: Float, weights: Float, length_m: float, sharpness: float) -> None:
        self.centers = centers
        self.axes = axes
        self.weights = weights
        self.length_m = length_m
        self.sharpness = sharpness
        self._tree = cKDTree(centers) if len(centers) else None

    def at(self, centers: Float, axes: Float) -> Float:
        """The correction (B,) of views (B, 3), (B, 3)."""
        found = np.zeros(len(centers))
        _, row = np.unique(centers, axis=0, return_inverse=True)
        order = np.argsort(row.reshape(-1), kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(row.reshape(-1)[order])) + 1):
            if len(rows):
                found[rows] = self._around(centers[rows[0]], axes[rows])
        return found

    def grid(self, locations: Float, directions: Float) -> Float:
        """The correction (L, D) of views at locations (L, 3) along each of directions (D, 3)."""
        found = np.empty((len(locations), len(directions)))
        for row, location in enumerate(locations):
            found[row] = self._around(location, directions)
        return found

    def _around(self, location: Float, axes: Float) -> Float:
        near = self._near(location)
        if not len(near):
            return np.zeros(len(axes))
        squared = ((self.centers[near] - location) ** 2).sum(1) / self.length_m**2
        by_distance = self.weights[near] * np.exp(-squared / 2)
        return np.asarray(np.exp(self.sharpness * (axes @ self.axes[near].T - 1)) @ by_distance)

    def _near(self, location: Float) -> NDArray[np.int64]:
        if self._tree is None:
            return np.zeros(0, dtype=np.int64)
        return np.array(self._tree.query_ball_point(location, REACH * self.length_m), dtype=np.int64)
