"""Stops: where along a path one look will not do, and where else to look from there."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import expit
from tqdm.auto import tqdm

from wheretolook.geometry.poses import Float, poses_looking_along
from wheretolook.looks.joint_visibility import candidate_views
from wheretolook.looks.selection import CANDIDATES, SEPARATION_DEG, Rotations, candidates, score_of_set, select_views
from wheretolook.looks.set_score import SetScoreModel
from wheretolook.planning.config import PathConfig, StopConfig
from wheretolook.planning.routes import Stop, turning_deg
from wheretolook.utils.errors import ConfigError, PlanningError
from wheretolook.utils.probability import finite_log_odds

if TYPE_CHECKING:
    from wheretolook.scorers.base import Scorer

TURNS_DEG = (45.0, 90.0, 180.0, None)
"""Limits on the turn from the path's view to the last look that are tried one after another; None for no limit."""

NEAR_DEG = 60.0
NEAR = 8
"""So many of the candidates for further looks lie no farther from the path's view, so that small turns are possible."""

MIN_PROBABILITY = 1e-3  # probabilities are clipped to this distance from 0 and 1 before odds are taken


def stops_along(
    scorer: Scorer,
    positions: Float,
    axes: Float,
    directions: Float,
    config: StopConfig,
    planner: PathConfig = PathConfig(),
    progress: str | None = None,
) -> tuple[Stop, ...]:
    """The stops of a path through positions (W, 3) m with views along unit axes (W, 3), such as `best_sequence` gives.

    A place whose view scores below `config.least_score` becomes a stop with the fewest further looks, along some of
    unit directions (D, 3), by which all looks together reach that score, and of as many those that turn least. Where no
    set of `config.looks` does, the stop is made if it gains more than it costs, and of those that do the one that gains
    most: `planner.score_weight` for every metre of the path around the place times the rise of its score, less
    `planner.turn_weight_m` for every radian there and back.

    What several looks score is told from the score of the path's view: its odds rise as those of the shipped
    `SetScoreModel` do when the further looks are added. Raises a ConfigError if scores are no probabilities
    (`check_stopping`). `progress` is the text of the progress bar; None shows none.
    """
    if config.looks < 2:
        return ()
    check_stopping(scorer.name)
    own = scorer.score(poses_looking_along(positions, axes))
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    metres = (np.append(steps, 0.0) + np.append(0.0, steps)) / 2
    found = []
    places = np.flatnonzero(own < config.least_score)
    for place in tqdm(places.tolist(), desc=progress, unit="stop", disable=progress is None):
        view = positions[place], axes[place], float(own[place])
        stop = _stop(scorer, place, *view, directions, config, planner, float(metres[place]))
        if stop is not None:
            found.append(stop)
    return tuple(found)


def within_pitch(directions: Float, planner: PathConfig) -> Float:
    """Those of unit directions (D, 3) that a planner's camera can look along."""
    low, high = np.sin(np.radians(planner.pitch_deg))
    return directions[(directions[:, 2] >= low) & (directions[:, 2] <= high)]


def can_stop(method: str) -> bool:
    """Whether a method's scores are probabilities, which can be asked to reach one."""
    from wheretolook.scorers.registry import find

    known = find(method)
    return known is not None and known.probability


def check_stopping(method: str) -> None:
    """Raise a ConfigError if paths of a method cannot have stops (`can_stop`)."""
    if not can_stop(method):
        fix = "Use a method that tells one, such as set, or leave stops out."
        raise ConfigError("stops need scores that are probabilities", value=method, fix=fix)


def _stop(
    scorer: Scorer,
    place: int,
    at: Float,
    axis: Float,
    own: float,
    directions: Float,
    config: StopConfig,
    planner: PathConfig,
    metres: float,
) -> Stop | None:
    """The stop at a place (3,) m whose view along an axis (3,) has a score of its own; None if none is worth it."""
    apart = directions[directions @ axis < math.cos(math.radians(SEPARATION_DEG))]
    if len(apart) == 0:
        return None
    scores = scorer.score_around(at[None], apart)[0]
    near = np.flatnonzero(apart @ axis > math.cos(math.radians(NEAR_DEG)))
    rows = np.union1d(candidates(apart, scores, CANDIDATES), near[candidates(apart[near], scores[near], NEAR)])
    looked = np.concatenate([axis[None], apart[rows]])
    alone = np.append(own, scores[rows])
    seen = candidate_views(scorer, at, looked, alone)
    set_score = SetScoreModel.bundled()
    rotations = Rotations(looked, axis)
    before = score_of_set(seen, set_score, [0])
    best = None
    most = 0.0
    for n in range(2, min(config.looks, len(looked)) + 1):
        for limit in TURNS_DEG:
            try:
                chosen = select_views(seen, set_score, n, rotations, limit, required=0)
            except PlanningError:  # nothing lies so near
                continue
            further = [look for look in chosen.rows if look != 0]
            turn = turning_deg(np.concatenate([axis[None], looked[further], axis[None]]))
            together = _raised(own, before, chosen.score)
            stop = Stop(place, looked[further], alone[further], together, turn)
            if together >= config.least_score:
                return stop
            cost = planner.turn_weight_m * math.radians(turn)
            gain = planner.score_weight * metres * (together - own) - cost
            if gain > most:
                best = stop
                most = gain
    return best


def _raised(probability: float, before: float, after: float) -> float:
    """Raise the odds of a probability by the ratio of the odds of `after` and `before`."""
    a, b, c = finite_log_odds([probability, before, after], MIN_PROBABILITY)
    return float(expit(a + c - b))
