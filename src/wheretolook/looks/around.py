"""The best set of looks at a place, from a scorer's map and the scores of all directions there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera_turns import TOLERANCE_DEG
from wheretolook.geometry.poses import Float
from wheretolook.looks.joint_visibility import seen_around
from wheretolook.looks.selection import ChosenLooks, Turns, Worth, choose_looks
from wheretolook.looks.set_score import SetWorth
from wheretolook.utils.errors import ConfigError

if TYPE_CHECKING:
    from wheretolook.scorers.base import Scorer

CANDIDATES = 24
"""Directions of which a set is chosen: those with the best scores of their own that lie apart."""

APART_DEG = 15.0
"""Angle by which candidates lie apart; nearer ones see the same."""


def best_looks(
    scorer: Scorer,
    location: Float,
    directions: Float,
    scores: Float,
    n: int,
    max_turn_deg: float | None = None,
    start: ArrayLike | None = None,
    worth: Worth | None = None,
) -> ChosenLooks:
    """The n looks from a location (3,) m that are worth most together, of directions (D, 3) with scores (D,).

    The total turn keeps within `max_turn_deg`, counted from the axis `start` (3,) if that is given. The look that is
    best alone is the first that is taken, others are added by what all find together, and then exchanged; `looks` are
    rows of the directions in the order to look along them. `worth` is the one that ships unless given.

    Raises a ConfigError for a number of looks that is none or more than there are directions, or a limit that is none;
    a PlanningError if no such looks can be reached.
    """
    if n > len(directions):
        raise ConfigError(f"there are only {len(directions)} directions to choose from", value=n)
    rows = candidates(directions, scores, max(CANDIDATES, n), max_turn_deg, start)
    axes = directions[rows]
    seen = seen_around(scorer, location, axes, scores[rows])
    chosen = choose_looks(seen, worth or SetWorth.shipped(), n, Turns(axes, start), max_turn_deg, scores[rows])
    return ChosenLooks(tuple(int(rows[look]) for look in chosen.looks), chosen.worth, chosen.total_turn_deg)


def candidates(
    directions: Float, scores: Float, most: int, max_turn_deg: float | None = None, start: ArrayLike | None = None
) -> NDArray[np.int64]:
    """Rows (C,) of directions worth considering: the best that lie apart, and under a limit those near the best."""
    order = np.argsort(-np.asarray(scores), kind="stable")
    if start is not None and max_turn_deg is not None:
        axis = np.asarray(start, dtype=np.float64)
        # a camera that does not roll turns at least by the angle of its axis
        order = order[directions[order] @ axis / np.linalg.norm(axis) >= _cosine(max_turn_deg)]
    taken: list[int] = []
    free = np.ones(len(directions), dtype=bool)
    near = np.cos(np.radians(APART_DEG))
    for row in order:
        if free[row]:
            taken.append(int(row))
            free &= directions @ directions[row] < near
            if len(taken) == most:
                break
    if max_turn_deg is not None and len(order):
        close = order[directions[order] @ directions[order[0]] >= _cosine(max_turn_deg)][:most]
        taken += [int(row) for row in close]
    if len(taken) < most:  # so few directions, or so close to one another
        taken += order[:most].tolist()
    return np.array(list(dict.fromkeys(taken)), dtype=np.int64)


def _cosine(limit_deg: float) -> float:
    return float(np.cos(np.radians(min(180.0, max(0.0, limit_deg) + TOLERANCE_DEG))))
