"""Choose one direction for each waypoint of a path, under a limit on the rotations between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.poses import (
    Float,
    check_axis,
    pan_tilt_turns_deg,
    rotation_looking_along,
    turns_deg,
    turns_from_deg,
    within,
)
from wheretolook.utils.errors import PlanningError


@dataclass(frozen=True, eq=False)
class TurnLimit:
    """Directions that can follow each other: those that a camera without roll reaches by one rotation within a limit.

    `directions` (D, 3) are unit optical axes in the world; `max_turn_deg` is the largest angle of the rotation between
    two waypoints, included, that of a pan-tilt head if `pan_tilt` (`pan_tilt_turns_deg`); `neighbours` (D, K) are
    the ids reachable from each direction, including itself, ascending, padded with D.
    """

    directions: Float
    max_turn_deg: float
    neighbours: NDArray[np.int64]
    pan_tilt: bool = False

    @classmethod
    def of(cls, directions: ArrayLike, max_turn_deg: float = 30.0, pan_tilt: bool = False) -> TurnLimit:
        """Make the limit for a lattice of unit vectors (D, 3), by default that of the Active Localization Benchmark.

        Raises ValueError for a limit that is negative or NaN.
        """
        axes = np.asarray(directions, dtype=np.float64)
        angles = pan_tilt_turns_deg(axes, axes) if pan_tilt else turns_deg(axes)
        reachable = within(angles, max_turn_deg)
        ids = np.sort(np.where(reachable, np.arange(len(axes)), len(axes)), axis=1)
        return cls(axes, float(max_turn_deg), ids[:, : int(reachable.sum(axis=1).max(initial=0))], pan_tilt)

    def from_start(self, start: ArrayLike | None) -> NDArray[np.bool_]:
        """Return which directions (D,) the first waypoint may have: those within the limit of `start`, all if it is None.

        `start` is the (3,) axis of a camera without roll or, not for a pan-tilt head, a (3, 3) cam_from_world rotation.
        """
        if start is None:
            return np.ones(len(self.directions), dtype=bool)
        if self.pan_tilt:
            angles = pan_tilt_turns_deg(check_axis(start)[None], self.directions)[0]
            return within(angles, self.max_turn_deg)
        return within(turns_from_deg(start, rotation_looking_along(self.directions)), self.max_turn_deg)


@dataclass(frozen=True, eq=False)
class ViewSequence:
    """Ids (W,) of the directions at W waypoints, and their scores (W,)."""

    direction_ids: NDArray[np.int64]
    scores: Float


def best_sequence(scores: ArrayLike, limit: TurnLimit, start: ArrayLike | None = None) -> ViewSequence:
    """Find the sequence with the greatest sum of scores among all that keep the limit, exactly.

    Dynamic programming over directions (Viterbi 1967), O(W D K). Of several with the same sum, the one with the lowest
    id at the last waypoint is chosen, then at the one before, and so on.

    `scores` (W, D) are of each waypoint and direction; -inf forbids one. `start` is the orientation before the first
    waypoint, see `TurnLimit.from_start`; None allows any direction there.

    Raises:
        PlanningError: no sequence keeps the limit; names the waypoint that cannot be reached.
        ValueError: scores of another shape, NaN or +inf.
    """
    values = check_scores(scores, limit)
    n, d = values.shape
    before = np.zeros((n, d), dtype=np.int64)  # best direction at the previous waypoint
    total = np.where(limit.from_start(start), values[0], -np.inf)
    check_reached(total, 0, limit)
    rows = np.arange(d)
    for waypoint in range(1, n):
        candidates = np.append(total, -np.inf)[limit.neighbours]  # being neighbours is symmetric
        chosen = candidates.argmax(axis=1)
        before[waypoint] = limit.neighbours[rows, chosen]
        total = candidates[rows, chosen] + values[waypoint]
        check_reached(total, waypoint, limit)
    ids = np.empty(n, dtype=np.int64)
    ids[-1] = total.argmax()
    for waypoint in range(n - 1, 0, -1):
        ids[waypoint - 1] = before[waypoint, ids[waypoint]]
    return ViewSequence(ids, values[np.arange(n), ids])


def lengths_along(route: Float) -> Float:
    """Return the length from the start of a polyline (S, 3) to each of its corners, (S,), in its unit."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(route, axis=0), axis=1))])


def between(knots: Float, values: Float, at: Float) -> Float:
    """Interpolate values (S, C) at ascending knots (S,) linearly at (W,); (W, C)."""
    return np.column_stack([np.interp(at, knots, column) for column in values.T])


def check_scores(scores: ArrayLike, limit: TurnLimit) -> Float:
    """Return scores (W, D) as an array; ValueError for another shape, NaN or +inf."""
    values = np.asarray(scores, dtype=np.float64)
    if values.shape != (max(1, len(values)), len(limit.directions)) or not np.all(values < np.inf):  # NaN is not less
        raise ValueError(f"scores must be (W, {len(limit.directions)}) numbers below infinity, got {values.shape}")
    return values


def check_reached(values: Float, waypoint: int, limit: TurnLimit) -> None:
    """Raise a PlanningError if no direction of a waypoint has a finite value (D,)."""
    if np.isneginf(values).all():
        fix = "Raise the limit, put waypoints closer, allow more directions, or use a finer lattice."
        problem = f"waypoint {waypoint} has no direction that is allowed within {limit.max_turn_deg:g} degrees"
        raise PlanningError(problem, value=waypoint, fix=fix)
