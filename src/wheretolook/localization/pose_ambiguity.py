"""Which of two poses is right, where a map resembles itself: the one with evidence that the other cannot explain.

Two rooms have the same chairs. Seen in one, these are matched with the landmarks of either, so a wrong pose may have
more inliers than the right one. But inliers on a chair speak for both rooms: whoever stands in the other sees a chair
at the same place of the image, too. What tells is what only one of the rooms has. So landmarks that agree with a pose
are carried to where they would be seen from if the other were right. Where the map has something there, they are
evidence for both; where it has nothing, for the first alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from wheretolook.geometry.poses import Float

ALIKE_M = 0.4
"""A landmark this close to where one is carried is its counterpart. On validation scenes 0.25 to 0.6 m do as well: a
copy of a thing is a copy, but not the same points of it were mapped."""

PLACE_M = 0.25
"""Landmarks in one cube of this edge count once: those of one thing are matched together, and wrongly together."""

PSEUDOCOUNT = 10.0
"""Places added to both poses' own before they are compared, so that one against none is no proof."""

SUPPORT_POWER = 0.2
"""Power of the ratio of two poses' support that counts beside that of their own places."""

LEAST_OF_RIVAL = 0.1
"""Support of a rival at least, as a share of the best supported pose's."""


class Likeness:
    """Of a map's landmarks (N, 3) m: what is alike as seen from two poses."""

    def __init__(self, points: Float) -> None:
        self.points = points
        self._tree = cKDTree(points[np.isfinite(points).all(axis=1)])

    def own_places(self, rows: NDArray[np.int64], pose: Float, other: Float) -> int:
        """How many places hold landmarks, of those that agree with a pose, that the other pose cannot explain.

        The landmarks are rows (M,), both poses (3, 4) from the world into the same frame of camera or rig.
        """
        seen = self.points[rows] @ pose[:, :3].T + pose[:, 3]
        carried = (seen - other[:, 3]) @ other[:, :3]
        distance, _ = self._tree.query(carried, distance_upper_bound=ALIKE_M)
        return self.places(rows[~np.isfinite(distance)])

    def places(self, rows: NDArray[np.int64]) -> int:
        """How many places hold some landmarks, rows (M,)."""
        return len(np.unique(np.floor(self.points[rows] / PLACE_M), axis=0))


def log_ratio(own: ArrayLike, others: ArrayLike) -> Float:
    """Of places that only one pose explains and that only the other does, (...,) each: log of their ratio, damped."""
    return np.log(
        (np.asarray(own, dtype=np.float64) + PSEUDOCOUNT) / (np.asarray(others, dtype=np.float64) + PSEUDOCOUNT)
    )


def preference(own: tuple[int, int], support: tuple[float, float]) -> float:
    """By how much the first of two poses is to be preferred, by the places of their own and their support."""
    return float(log_ratio(*own) + SUPPORT_POWER * np.log((support[0] + 1) / (support[1] + 1)))


def strongest_rival(
    own: NDArray[np.int64], support: Sequence[float], k: int, among: Sequence[int] | None = None
) -> int:
    """Which of K poses, two or more, speaks most against one of them; (K, K) places of each that another lacks."""
    others = [n for n in (range(len(support)) if among is None else among) if n != k]
    return min(others, key=lambda n: _against(own, support, k, n))


def most_likely(own: NDArray[np.int64], support: Sequence[float]) -> int:
    """Of K poses, by falling support, the one for which most speaks even against its strongest rival.

    Not by one duel after the other: these may go round in a circle.
    """
    able = [k for k, of in enumerate(support) if of > LEAST_OF_RIVAL * support[0]]
    if len(able) < 2:
        return 0
    return max(able, key=lambda k: _against(own, support, k, strongest_rival(own, support, k, able)))


def _against(own: NDArray[np.int64], support: Sequence[float], k: int, n: int) -> float:
    return preference((int(own[k, n]), int(own[n, k])), (support[k], support[n]))
