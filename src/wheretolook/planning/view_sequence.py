"""Where to look along a given path: one direction for each waypoint, under a limit on the turns between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry import camera_turns as turns
from wheretolook.geometry.poses import Float, rotation_looking_along
from wheretolook.utils.errors import PlanningError

SPACING_M = 0.2
MAX_TURN_DEG = 30.0
"""Distance of waypoints, and the limit on turns between them, of the Active Localization Benchmark."""

CELL_DEG = 20.0
TURN_PENALTY = 0.02
"""Step of ActLoc's lattice of yaws and pitches, and the penalty of its greedy rule (lambda) for each step."""


@dataclass(frozen=True, eq=False)
class TurnLimit:
    """Which directions can follow each other: those that a camera without roll reaches by one rotation in the limit.

    `directions` (D, 3) are unit optical axes in the world; `max_turn_deg` is the largest angle of the rotation between
    two waypoints, included, that of a pan-tilt head if `pan_tilt` (`turns.pan_tilt_turns_deg`); `neighbours` (D, K) are
    the ids reachable from each direction, including itself, ascending, padded with D.
    """

    directions: Float
    max_turn_deg: float
    neighbours: NDArray[np.int64]
    pan_tilt: bool = False

    @classmethod
    def of(cls, directions: ArrayLike, max_turn_deg: float = MAX_TURN_DEG, pan_tilt: bool = False) -> TurnLimit:
        """For a lattice of unit vectors (D, 3), such as `direction_lattice` gives.

        Raises ValueError for directions of another shape or not of unit length, or a limit that is negative or NaN.
        """
        axes = np.asarray(directions, dtype=np.float64)
        if axes.ndim != 2 or axes.shape[1] != 3 or not np.allclose(np.linalg.norm(axes, axis=1), 1, atol=1e-6):
            raise ValueError(f"directions must be unit vectors (D, 3), got an array of shape {axes.shape}")
        angles = turns.pan_tilt_turns_deg(axes, axes) if pan_tilt else turns.turns_deg(axes)
        reachable = turns.within(angles, max_turn_deg)
        most = int(reachable.sum(axis=1).max(initial=0))
        ids = np.where(reachable, np.arange(len(axes)), len(axes))
        return cls(axes, float(max_turn_deg), np.sort(ids, axis=1)[:, :most], pan_tilt)

    def from_start(self, start: ArrayLike | None) -> NDArray[np.bool_]:
        """Which directions (D,) the first waypoint may have: those within the limit of `start`, or all if it is None.

        `start` is the (3,) axis of a camera without roll or, not for a pan-tilt head, a (3, 3) cam_from_world rotation.
        """
        if start is None:
            return np.ones(len(self.directions), dtype=bool)
        if self.pan_tilt:
            angles = turns.pan_tilt_turns_deg(turns.check_axis(start)[None], self.directions)[0]
            return turns.within(angles, self.max_turn_deg)
        return turns.within(turns.turns_from_deg(start, rotation_looking_along(self.directions)), self.max_turn_deg)


@dataclass(frozen=True, eq=False)
class ViewSequence:
    """The id (W,) int64 of the direction at each of W waypoints, and its score (W,)."""

    direction_ids: NDArray[np.int64]
    scores: Float

    @property
    def total(self) -> float:
        """Sum of the scores."""
        return float(self.scores.sum())


def best_sequence(scores: ArrayLike, limit: TurnLimit, start: ArrayLike | None = None) -> ViewSequence:
    """The sequence with the greatest sum of scores of all that keep the limit, exactly.

    Dynamic programming over directions (Viterbi 1967), O(W D K). Of several with the same sum, the one with the lowest
    id at the last waypoint is chosen, then at the one before, and so on.

    `scores` (W, D) are of each waypoint and direction; -inf forbids one. `start` is the orientation before the first
    waypoint, see `TurnLimit.from_start`; None allows any direction there.

    Raises:
        PlanningError: no sequence keeps the limit; names the waypoint that cannot be reached.
        ValueError: scores of another shape, NaN or +inf.
    """
    values = _check(scores, limit)
    n, d = values.shape
    before = np.zeros((n, d), dtype=np.int64)  # best direction at the previous waypoint
    total = np.where(limit.from_start(start), values[0], -np.inf)
    _check_reached(total, 0, limit, start)
    rows = np.arange(d)
    for waypoint in range(1, n):
        candidates = np.append(total, -np.inf)[limit.neighbours]  # being neighbours is symmetric
        chosen = candidates.argmax(axis=1)
        before[waypoint] = limit.neighbours[rows, chosen]
        total = candidates[rows, chosen] + values[waypoint]
        _check_reached(total, waypoint, limit, start)
    ids = np.empty(n, dtype=np.int64)
    ids[-1] = total.argmax()
    for waypoint in range(n - 1, 0, -1):
        ids[waypoint - 1] = before[waypoint, ids[waypoint]]
    return ViewSequence(ids, values[np.arange(n), ids])


def greedy_sequence(
    scores: ArrayLike,
    limit: TurnLimit,
    start: ArrayLike | None = None,
    turn_penalty: float = TURN_PENALTY,
    keep_limit: bool = True,
) -> ViewSequence:
    """ActLoc's rule, for comparison: at each waypoint the greatest score minus a penalty on the turn to it.

    The penalty is lambda (|rows| + |columns|), where rows and columns are the steps of 20 degrees between pitches and,
    the short way round, between yaws (ActLoc, CoRL 2025, planning.py); on another lattice steps are fractions. ActLoc's
    code has no limit on turns and no penalty at the first waypoint; with `keep_limit` the rule chooses among directions
    within the limit, for a fair comparison with `best_sequence`, whose other arguments it shares.

    Raises:
        PlanningError: no direction is within the limit of the one chosen before; names the waypoint.
        ValueError: scores of another shape, NaN or +inf, or a negative penalty.
    """
    values = _check(scores, limit)
    if not turn_penalty >= 0:
        raise ValueError(f"the penalty must be at least 0, got {turn_penalty}")
    n, d = values.shape
    penalty = turn_penalty * _cells(limit.directions)
    ids = np.empty(n, dtype=np.int64)
    for waypoint in range(n):
        if waypoint == 0:
            allowed = limit.from_start(start if keep_limit else None)
            worth = values[0]
        else:
            allowed = np.ones(d, dtype=bool)
            worth = values[waypoint] - penalty[ids[waypoint - 1]]
            if keep_limit:
                near = limit.neighbours[ids[waypoint - 1]]
                allowed = np.bincount(near, minlength=d + 1)[:d] > 0
        worth = np.where(allowed, worth, -np.inf)
        _check_reached(worth, waypoint, limit, start)
        ids[waypoint] = worth.argmax()
    return ViewSequence(ids, values[np.arange(n), ids])


def resample_path(points: ArrayLike, spacing_m: float = SPACING_M) -> Float:
    """Waypoints (W, 3) m along a polyline (P, 3) m: its first point, one every `spacing_m` along it, and its last.

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


def lengths_along(places: Float) -> Float:
    """Length from the start of a polyline (S, 3) to each of its corners, (S,), in its unit."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])


def between(knots: Float, values: Float, at: Float) -> Float:
    """Values (S, C) at ascending knots (S,), linearly interpolated at (W,); (W, C)."""
    return np.column_stack([np.interp(at, knots, column) for column in values.T])


def _check(scores: ArrayLike, limit: TurnLimit) -> Float:
    values = np.asarray(scores, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] != len(limit.directions) or len(values) < 1:
        raise ValueError(f"scores must have shape (W, {len(limit.directions)}), W > 0, got {values.shape}")
    if not np.all(values < np.inf):  # NaN is not less
        raise ValueError("scores must be numbers below infinity")
    return values


def _check_reached(worth: Float, waypoint: int, limit: TurnLimit, start: ArrayLike | None) -> None:
    if np.isneginf(worth).all():
        from_where = "the start" if waypoint == 0 and start is not None else f"waypoint {waypoint - 1}"
        reach = f" within {limit.max_turn_deg:g} degrees of {from_where}" if waypoint or start is not None else ""
        fix = "Raise the limit, put waypoints closer, allow more directions, or use a finer lattice."
        raise PlanningError(f"waypoint {waypoint} has no direction that is allowed{reach}", value=waypoint, fix=fix)


def _cells(directions: Float) -> Float:
    """Differences (D, D) of pitch plus, the short way round, of yaw between directions, in steps of 20 degrees."""
    yaw, pitch = map(np.degrees, turns.pan_tilt_angles(directions))
    across = np.abs(yaw[:, None] - yaw)
    return np.asarray((np.abs(pitch[:, None] - pitch) + np.minimum(across, 360 - across)) / CELL_DEG)
