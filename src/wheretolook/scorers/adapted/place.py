"""Check that a map is of the scene that weights were adapted to."""

from __future__ import annotations

from scipy.spatial import cKDTree

from wheretolook.geometry.poses import Float

SAME_M = 0.05
MIN_SHARE = 0.5
"""A map is of the scene if this share of the stored landmarks has one of the map's within this distance. A map with
other filters, or reconstructed again in the same frame, still is."""


def share_of_place(place: Float, landmarks: Float) -> float:
    """Return the share of stored landmarks (P, 3) m that a map's landmarks (N, 3) m contain; 1 if none are stored."""
    if len(place) == 0:
        return 1.0
    return float((cKDTree(landmarks).query(place)[0] <= SAME_M).mean()) if len(landmarks) else 0.0
