"""Sequences of views along a given path by ActLoc's greedy rule, and evenly spaced waypoints."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.camera_turns import pan_tilt_angles
from wheretolook.geometry.poses import Float
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


def greedy_sequence(
    scores: ArrayLike,
    limit: TurnLimit,
    start: ArrayLike | None = None,
    turn_penalty: float = TURN_PENALTY,
    keep_limit: bool = True,
) -> ViewSequence:
    """Choose directions in the order of the waypoints: the best score less a penalty for turning (ActLoc).

    The penalty is for each step of 20 degrees of yaw and of pitch. With `keep_limit` only directions within the limit
    are allowed. See `best_sequence` for the other arguments and what is raised.
    """
    values = check_scores(scores, limit)
    if not turn_penalty >= 0:
        raise ValueError(f"the penalty must be at least 0, got {turn_penalty}")
    n, d = values.shape
    penalty = turn_penalty * _cells(limit.directions)
    ids = np.empty(n, dtype=np.int64)
    for waypoint in range(n):
        if waypoint == 0:
            allowed = limit.from_start(start if keep_limit else None)
            value = values[0]
        else:
            allowed = np.ones(d, dtype=bool)
            value = values[waypoint] - penalty[ids[waypoint - 1]]
            if keep_limit:
                near = limit.neighbours[ids[waypoint - 1]]
                allowed = np.bincount(near, minlength=d + 1)[:d] > 0
        value = np.where(allowed, value, -np.inf)
        check_reached(value, waypoint, limit, start)
        ids[waypoint] = value.argmax()
    return ViewSequence(ids, values[np.arange(n), ids])


def resample_path(points: ArrayLike, spacing_m: float = SPACING_M) -> Float:
    """Return waypoints (W, 3) m along a polyline (P, 3) m: its first point, one every `spacing_m` along it, and its last.

    The last leg may be shorter than the others. Raises ValueError for no point, another shape, values that are not
    finite, or a spacing that is not positive.
    """
    path = np.asarray(points, dtype=np.float64)
    if path.ndim != 2 or path.shape[1:] != (3,) or len(path) < 1 or not np.isfinite(path).all():
        raise ValueError(f"a path is (P, 3) finite metres, P > 0, got an array of shape {path.shape}")
    if not 0 < spacing_m < np.inf:
        raise ValueError(f"the spacing must be a distance above 0 m, got {spacing_m}")
    at = lengths_along(path)
    # a remainder that is only rounding adds no waypoint
    return between(at, path, np.append(np.arange(0, at[-1] - 1e-9 * spacing_m, spacing_m), at[-1]))


def _cells(directions: Float) -> Float:
    """Compute differences (D, D) of pitch plus, the short way round, of yaw between directions, in steps of 20 degrees."""
    yaw, pitch = map(np.degrees, pan_tilt_angles(directions))
    across = np.abs(yaw[:, None] - yaw)
    return np.asarray((np.abs(pitch[:, None] - pitch) + np.minimum(across, 360 - across)) / CELL_DEG)
