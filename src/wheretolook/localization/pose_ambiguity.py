"""Select between pose hypotheses under perceptual aliasing, by the inliers that only one of them explains.

Identical objects in two rooms match landmarks of both rooms, so a wrong pose may have more inliers than the correct one.
Such inliers do not discriminate: each hypothesis explains them. Therefore the inliers of one pose are transformed to where
they would be under the other pose. If the map has a landmark there, both poses explain the match; otherwise only the first.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from wheretolook.geometry.poses import Float, compose_poses, invert_poses, transform

COUNTERPART_DISTANCE_M = 0.4
"""A landmark this close to a moved one is its counterpart. On validation scenes 0.25 to 0.6 m work equally: different
points are triangulated on two copies of an object."""

VOXEL_SIZE_M = 0.25
"""Landmarks in one cube of this edge count once: landmarks on one object are matched or mismatched jointly."""

PSEUDOCOUNT = 10.0
"""Additive smoothing of both counts of a comparison: 1 against 0 is not decisive."""

SUPPORT_POWER = 0.2
"""Power of the ratio of two poses' support that counts in addition to that of their unique support."""

MIN_SUPPORT_RATIO = 0.1
"""Minimum support of a candidate, relative to the best supported pose."""


_CELL_STRIDES = np.array([1, 2**21, 2**42])  # for 260 km in each direction


class PoseAmbiguity:
    """Compares pose hypotheses in a map with landmarks (N, 3) m, by the inliers that only one of them explains."""

    def __init__(self, points: Float) -> None:
        self.points = points
        self._tree = cKDTree(points[np.isfinite(points).all(axis=1)])

    def unique_support(self, rows: NDArray[np.int64], pose: Float, other: Float) -> int:
        """Count voxels with landmarks, rows (M,), that agree with a pose and that the other pose cannot explain.

        Both poses (3, 4) are from the world into the same frame of camera or rig.
        """
        moved = transform(compose_poses(invert_poses(other), pose), self.points[rows])
        distance, _ = self._tree.query(moved, distance_upper_bound=COUNTERPART_DISTANCE_M)
        return self.count_voxels(rows[~np.isfinite(distance)])

    def count_voxels(self, rows: NDArray[np.int64]) -> int:
        """Count voxels (cubes of `VOXEL_SIZE_M`) with landmarks, rows (M,)."""
        cells = np.floor(self.points[rows] / VOXEL_SIZE_M).astype(np.int64)
        return len(np.unique(cells @ _CELL_STRIDES))  # of one number each: unique rows take ten times as long


def log_ratio(unique: ArrayLike, rival_unique: ArrayLike) -> Float:
    """Damped log ratio of the unique support (...,) of two poses."""
    return np.log(
        (np.asarray(unique, dtype=np.float64) + PSEUDOCOUNT)
        / (np.asarray(rival_unique, dtype=np.float64) + PSEUDOCOUNT)
    )


def _preferences(unique: NDArray[np.int64], support: ArrayLike) -> Float:
    """Log odds (K, K) for each pose against each other, from unique support (K, K) and support (K,)."""
    smoothed = np.asarray(support, dtype=np.float64) + 1
    return log_ratio(unique, unique.T) + SUPPORT_POWER * np.log(smoothed[:, None] / smoothed)


def strongest_rival(unique: NDArray[np.int64], support: Sequence[float], k: int) -> int:
    """Index of the pose that is the strongest evidence against pose `k`; `unique` (K, K) as by `unique_support`."""
    preference = _preferences(unique, support)[k]
    preference[k] = np.inf
    return int(np.argmin(preference))


def most_likely(unique: NDArray[np.int64], support: Sequence[float]) -> int:
    """Index of the pose with the strongest evidence against its strongest rival; poses by decreasing support.

    Pairwise preferences may be cyclic, so poses are not eliminated one after the other.
    """
    candidates = np.flatnonzero(np.asarray(support) >= MIN_SUPPORT_RATIO * support[0])
    preference = _preferences(unique, support)[np.ix_(candidates, candidates)]
    np.fill_diagonal(preference, np.inf)
    return int(candidates[np.argmax(preference.min(axis=1))])
