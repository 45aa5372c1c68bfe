"""Choose where a camera stops along a path, and in which further directions it looks there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit
from tqdm.auto import tqdm

from wheretolook.geometry.poses import Float, poses_looking_along
from wheretolook.looks.joint_visibility import candidate_views
from wheretolook.looks.selection import CANDIDATES, SEPARATION_DEG, Rotations, candidates, score_of_set, select_views
from wheretolook.looks.set_score import SetScoreModel
from wheretolook.planning.config import PathConfig, StopConfig
from wheretolook.planning.routes import Stop, turning_deg
from wheretolook.scorers.registry import is_probability
from wheretolook.utils.errors import ConfigError, PlanningError
from wheretolook.utils.probability import finite_log_odds

if TYPE_CHECKING:
    from wheretolook.scorers.base import Scorer

TURNS_DEG = (45.0, 90.0, 180.0, None)
"""Limits on the rotation from the path's view to the last look, in the order they are tried; None for no limit."""

NEAR_DEG = 60.0
N_NEAR = 8
"""Number of candidates within this angle of the path's view, so that small rotations are possible."""

MIN_PROBABILITY = 1e-3  # probabilities are clipped to this distance from 0 and 1 before odds are taken


def stops_along(
    scorer: Scorer,
    positions: Float,
    axes: Float,
    directions: Float,
    config: StopConfig,
    planner: PathConfig = PathConfig(),
    progress: str | None = None,
    allowed: NDArray[np.bool_] | None = None,
) -> tuple[Stop, ...]:
    """Choose the stops of a path through positions (W, 3) m with views along unit axes (W, 3).

    A position whose view scores below `config.least_score` becomes a stop with the fewest further looks, along some of
    unit directions (D, 3), at each position those `allowed` (W, D), by which all looks jointly reach that score; of equally many those with the smallest
    rotation. Where `config.looks` do not suffice, the stop with the largest gain is made, if positive:
    `planner.score_weight` for every metre of the path around the position times the rise of its score, less
    `planner.turn_weight_m` for every radian there and back.

    The joint score of several looks has the odds of the path's view, raised as those of the bundled `SetScoreModel`
    rise with the further looks. `progress` is the text of the progress bar; None shows none. Raises a ConfigError if
    scores are no probabilities (`check_stopping`).
    """
    if config.looks < 2:
        return ()
    check_stopping(scorer.name)
    scores = scorer.score(poses_looking_along(positions, axes))
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    metres = (np.append(steps, 0.0) + np.append(0.0, steps)) / 2
    stops = []
    rows = np.flatnonzero(scores < config.least_score)
    for row in tqdm(rows.tolist(), desc=progress, unit="stop", disable=progress is None):
        view = _View(row, positions[row], axes[row], float(scores[row]), float(metres[row]))
        choice = directions if allowed is None else directions[allowed[row]]
        stops.append(_best_stop(scorer, view, choice, config, planner))
    return tuple(filter(None, stops))


def within_pitch(directions: Float, planner: PathConfig) -> Float:
    """Return those of unit directions (D, 3) that a planner's camera can look along."""
    low, high = np.sin(np.radians(planner.pitch_deg))
    return directions[(directions[:, 2] >= low) & (directions[:, 2] <= high)]


def check_stopping(method: str) -> None:
    """Raise a ConfigError if paths of a method cannot have stops, which need scores that are probabilities."""
    if not is_probability(method):
        fix = "Use a method such as set, or leave stops out."
        raise ConfigError("stops need scores that are probabilities", value=method, fix=fix)


@dataclass(frozen=True, eq=False)
class _View:
    """A view of a path: its row, position (3,) m, axis (3,), score, and the metres of the path around it."""

    row: int
    position: Float
    axis: Float
    score: float
    metres: float


def _best_stop(scorer: Scorer, view: _View, directions: Float, config: StopConfig, planner: PathConfig) -> Stop | None:
    """Choose the further looks at a view; None if no stop gains more than it costs."""
    apart = directions[directions @ view.axis < math.cos(math.radians(SEPARATION_DEG))]
    if len(apart) == 0:
        return None
    scores = scorer.score_directions(view.position[None], apart)[0]
    near = np.flatnonzero(apart @ view.axis > math.cos(math.radians(NEAR_DEG)))
    rows = np.union1d(candidates(apart, scores, CANDIDATES), near[candidates(apart[near], scores[near], N_NEAR)])
    axes = np.concatenate([view.axis[None], apart[rows]])
    single = np.append(view.score, scores[rows])
    visible = candidate_views(scorer, view.position, axes, single)
    set_score = SetScoreModel.bundled()
    rotations = Rotations(axes, view.axis)
    before = score_of_set(visible, set_score, [0])
    best = None
    best_gain = 0.0
    for n in range(2, min(config.looks, len(axes)) + 1):
        for limit in TURNS_DEG:
            try:
                chosen = select_views(visible, set_score, n, rotations, limit, required=0)
            except PlanningError:  # no directions within the limit
                continue
            further = [row for row in chosen.rows if row != 0]
            turn = turning_deg(np.concatenate([view.axis[None], axes[further], view.axis[None]]))
            joint = _raised(view.score, before, chosen.score)
            stop = Stop(view.row, axes[further], single[further], joint, turn)
            if joint >= config.least_score:
                return stop
            cost = planner.turn_weight_m * math.radians(turn)
            gain = planner.score_weight * view.metres * (joint - view.score) - cost
            if gain > best_gain:
                best = stop
                best_gain = gain
    return best


def _raised(probability: float, before: float, after: float) -> float:
    """Raise the odds of a probability by the ratio of the odds of `after` and `before`."""
    a, b, c = finite_log_odds([probability, before, after], MIN_PROBABILITY)
    return float(expit(a + c - b))
