"""Whether a map is of the place that weights were adapted to."""

from __future__ import annotations

from scipy.spatial import cKDTree

from wheretolook.geometry.poses import Float

SAME_M = 0.05
LEAST_SAME = 0.5
"""A map is of the place if so large a share of the landmarks that are known has one of the map's within this distance:
a map with other filters, or made anew in the same frame, still is."""


def share_of_place(place: Float, landmarks: Float) -> float:
    """The share of a place's landmarks (P, 3) m that a map's (N, 3) m has too; 1 if none are known."""
    if len(place) == 0:
        return 1.0
    return float((cKDTree(landmarks).query(place)[0] <= SAME_M).mean()) if len(landmarks) else 0.0
