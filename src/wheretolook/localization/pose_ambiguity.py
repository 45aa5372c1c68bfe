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

from wheretolook.geometry.poses import Float

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


class PoseAmbiguity:
    """Compares pose hypotheses in a map with landmarks (N, 3) m, by the inliers that only one of them explains."""

    def __init__(self, points: Float) -> None:
        self.points = points
        self._tree = cKDTree(points[np.isfinite(points).all(axis=1)])

    def unique_support(self, rows: NDArray[np.int64], pose: Float, other: Float) -> int:
        """Count voxels with landmarks, rows (M,), that agree with a pose and that the other pose cannot explain.

        Both poses (3, 4) are from the world into the same frame of camera or rig.
        """
        in_camera = self.points[rows] @ pose[:, :3].T + pose[:, 3]
        moved = (in_camera - other[:, 3]) @ other[:, :3]
        distance, _ = self._tree.query(moved, distance_upper_bound=COUNTERPART_DISTANCE_M)
        return self.count_voxels(rows[~np.isfinite(distance)])

    def count_voxels(self, rows: NDArray[np.int64]) -> int:
        """Count voxels (cubes of `VOXEL_SIZE_M`) with landmarks, rows (M,)."""
        return len(np.unique(np.floor(self.points[rows] / VOXEL_SIZE_M), axis=0))


def log_ratio(unique: ArrayLike, rival_unique: ArrayLike) -> Float:
    """Damped log ratio of the unique support (...,) of two poses."""
    return np.log(
        (np.asarray(unique, dtype=np.float64) + PSEUDOCOUNT)
        / (np.asarray(rival_unique, dtype=np.float64) + PSEUDOCOUNT)
    )


def preference(unique: tuple[int, int], support: tuple[float, float]) -> float:
    """Log odds for the first of two poses, from the unique support and the support of both."""
    return float(log_ratio(*unique) + SUPPORT_POWER * np.log((support[0] + 1) / (support[1] + 1)))


def strongest_rival(
    unique: NDArray[np.int64], support: Sequence[float], k: int, among: Sequence[int] | None = None
) -> int:
    """Index of the pose that is the strongest evidence against pose `k`; `unique` (K, K) as by `unique_support`."""
    others = [n for n in (range(len(support)) if among is None else among) if n != k]
    return min(others, key=lambda n: _preference_over(unique, support, k, n))


def most_likely(unique: NDArray[np.int64], support: Sequence[float]) -> int:
    """Index of the pose with the strongest evidence against its strongest rival; poses by decreasing support.

    Pairwise preferences may be cyclic, so poses are not eliminated one after the other.
    """
    candidates = [k for k, value in enumerate(support) if value > MIN_SUPPORT_RATIO * support[0]]
    if len(candidates) < 2:
        return 0
    return max(
        candidates, key=lambda k: _preference_over(unique, support, k, strongest_rival(unique, support, k, candidates))
    )


def _preference_over(unique: NDArray[np.int64], support: Sequence[float], k: int, n: int) -> float:
    return preference((int(unique[k, n]), int(unique[n, k])), (support[k], support[n]))
