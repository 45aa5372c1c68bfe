"""Refine views along a path, and add further ones at waypoints with a low score."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit
from tqdm.auto import tqdm

from wheretolook.geometry.poses import Float, angles_to_axis_deg, poses_looking_along
from wheretolook.geometry.views import Views
from wheretolook.looks.selection import (
    CANDIDATES,
    SEPARATION_DEG,
    Rotations,
    SetScoreModel,
    candidate_views,
    candidates,
    score_of_set,
    select_views,
)
from wheretolook.planning.config import PathConfig, StopConfig
from wheretolook.planning.routes import Stop, turning_deg
from wheretolook.scorers.base import Scorer, finite_log_odds
from wheretolook.scorers.registry import is_probability
from wheretolook.utils.errors import ConfigError, PlanningError


def refine_directions(
    scorer: Scorer,
    locations: ArrayLike,
    axes: ArrayLike,
    max_angle_deg: float = 10.0,
    first_step_deg: float = 4.0,
    last_step_deg: float = 0.25,
) -> Views:
    """Improve axes by a pattern search on the sphere (Hooke and Jeeves 1961; compass search, Kolda et al. 2003).

    Eight axes one step away from the current one are scored; the best of them replaces it if it scores higher,
    otherwise the step is halved, until it falls below the last. All views are searched together, so that the scorer
    gets batches. Scores need not be continuous.

    The search begins at locations (B, 3) m with axes (B, 3) of any length, such as the best of a lattice. The default
    `max_angle_deg` from there exceeds the distance of neighbours on a lattice of 500 directions; about half that
    distance works well as the first step. Returns views with their scores, none below that of its start. Raises ValueError if locations or axes are not finite, have no length or
    differ in number, or an angle is not positive.
    """
    if not (max_angle_deg > 0 and first_step_deg > 0 and last_step_deg > 0):
        raise ValueError("angles must be positive")
    at, start = (np.asarray(values, dtype=np.float64).reshape(-1, 3) for values in (locations, axes))
    scores = scorer.score(poses_looking_along(at, start))  # raises on what is not finite
    start = start / np.linalg.norm(start, axis=1, keepdims=True)
    current = start.copy()
    step_deg = np.full(len(start), float(min(first_step_deg, max_angle_deg)))
    while len(active := np.flatnonzero(step_deg >= last_step_deg)):
        candidates = _neighbour_directions(current[active], step_deg[active])
        candidates = _within(candidates, start[active, None], max_angle_deg)
        values = scorer.score(poses_looking_along(np.repeat(at[active], 8, axis=0), candidates.reshape(-1, 3)))
        values = values.reshape(-1, 8)
        best = values.argmax(axis=1)
        value = values[np.arange(len(active)), best]
        better = value > scores[active]
        moved = active[better]
        current[moved] = candidates[better, best[better]]
        scores[moved] = value[better]
        step_deg[active[~better]] /= 2
    return Views(poses_looking_along(at, current), method=scorer.name, score=scores)


def _neighbour_directions(axes: Float, step_deg: Float) -> Float:
    """Return eight unit vectors (B, 8, 3) at angles of `step_deg` (B,) around axes (B, 3)."""
    u = np.cross(axes, np.eye(3)[np.abs(axes).argmin(axis=1)])  # with a coordinate axis that is not parallel
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    angle = np.radians(step_deg)[:, None, None]
    at = np.arange(8)[:, None] * np.pi / 4  # in the plane that touches the sphere at the axis
    across = np.cos(at) * u[:, None] + np.sin(at) * np.cross(axes, u)[:, None]
    return np.asarray(np.cos(angle) * axes[:, None] + np.sin(angle) * across)


def _within(candidates: Float, start: Float, max_angle_deg: float) -> Float:
    """Move candidates (B, 8, 3) that are too far from their start (B, 1, 3) back to the limit."""
    outside = angles_to_axis_deg(candidates, start)[..., None] > max_angle_deg
    limit = np.radians(max_angle_deg)
    across = candidates - (candidates * start).sum(-1, keepdims=True) * start
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
    return np.where(outside, np.cos(limit) * start + np.sin(limit) * across, candidates)


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
    near = np.flatnonzero(apart @ view.axis > math.cos(math.radians(60.0)))
    # further ones near the path's view, so that small rotations are possible
    rows = np.union1d(candidates(apart, scores, CANDIDATES), near[candidates(apart[near], scores[near], 8)])
    axes = np.concatenate([view.axis[None], apart[rows]])
    single = np.append(view.score, scores[rows])
    visible = candidate_views(scorer, view.position, axes, single)
    set_score = SetScoreModel.bundled()
    rotations = Rotations(axes, view.axis)
    before = score_of_set(visible, set_score, [0])
    best = None
    best_gain = 0.0
    for n in range(2, min(config.looks, len(axes)) + 1):
        for limit in (45.0, 90.0, 180.0, None):  # degrees from the path's view to the last look
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
    a, b, c = finite_log_odds([probability, before, after], 1e-3)
    return float(expit(a + c - b))
