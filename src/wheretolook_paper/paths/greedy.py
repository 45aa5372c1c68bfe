"""Sequences of views along a given path by ActLoc's greedy rule, and evenly spaced waypoints."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.poses import Float, pan_tilt_angles
from wheretolook.planning.view_sequence import (
    TurnLimit,
    ViewSequence,
    between,
    check_reached,
    check_scores,
    lengths_along,
)

SPACING_M = 0.2  # distance of waypoints in the Active Localization Benchmark
CELL_DEG = 20.0
TURN_PENALTY = 0.02
"""Step of ActLoc's lattice of yaws and pitches, and the penalty of its greedy rule (lambda) for each step."""


def greedy_sequence(scores: ArrayLike, limit: TurnLimit) -> ViewSequence:
    """Choose directions in the order of the waypoints: the best score less a penalty for turning (ActLoc).

    The penalty is for each step of 20 degrees of yaw and of pitch. Only directions within the limit are allowed. See
    `best_sequence` for the arguments and what is raised.
    """
    values = check_scores(scores, limit)
    n, d = values.shape
    penalty = TURN_PENALTY * _cells(limit.directions)
    ids = np.empty(n, dtype=np.int64)
    for waypoint in range(n):
        value = values[waypoint]
        if waypoint > 0:
            near = limit.neighbours[ids[waypoint - 1]]
            allowed = np.bincount(near, minlength=d + 1)[:d] > 0
            value = np.where(allowed, value - penalty[ids[waypoint - 1]], -np.inf)
        check_reached(value, waypoint, limit)
        ids[waypoint] = value.argmax()
    return ViewSequence(ids, values[np.arange(n), ids])


def resample_path(points: ArrayLike, spacing_m: float = SPACING_M) -> Float:
    """Return waypoints (W, 3) m along a polyline (P, 3) m: its first point, one every `spacing_m` along it, and its last.

    The last leg may be shorter than the others.
    """
    path = np.asarray(points, dtype=np.float64)
    at = lengths_along(path)
    # a remainder that is only rounding adds no waypoint
    return between(at, path, np.append(np.arange(0, at[-1] - 1e-9 * spacing_m, spacing_m), at[-1]))


def _cells(directions: Float) -> Float:
    """Compute differences (D, D) of pitch plus, the short way round, of yaw between directions, in steps of 20 degrees."""
    yaw, pitch = map(np.degrees, pan_tilt_angles(directions))
    across = np.abs(yaw[:, None] - yaw)
    return np.asarray((np.abs(pitch[:, None] - pitch) + np.minimum(across, 360 - across)) / CELL_DEG)
