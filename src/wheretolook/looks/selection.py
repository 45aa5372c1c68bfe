"""What several views from one location can be expected to detect jointly.

A set of views detects a landmark if one of them does, with probability 1 - prod(1 - p) over the views. The information
of the detected landmarks on the pose is summed along the world's axes, which all views share. As sums over landmarks,
they serve sets of any size as they serve a single view (`scorers/set/network.py`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.pose_information import PRIOR, bearing_numbers, information_matrices
from wheretolook.geometry.poses import (
    TOLERANCE_DEG,
    Float,
    poses_looking_along,
    rotation_angle_deg,
    rotation_looking_along,
)
from wheretolook.localization.confidence import LogisticRegression
from wheretolook.scorers.registry import find
from wheretolook.utils.errors import ConfigError, PlanningError

if TYPE_CHECKING:
    from wheretolook.scorers.base import Scorer


@dataclass(frozen=True, eq=False)
class Detections:
    """What each of D views from one location detects of U landmarks."""

    p_detect: NDArray[np.float32]  # (D, U) probability that the view detects the landmark; 0 where it is not visible
    terms: Float  # (U, 16) float64, what a detected landmark adds to the sums: one, and its information on the pose
    n_visible: NDArray[np.int64]  # (D,) visible landmarks
    p_single: Float  # (D,) probability that the view localizes on its own; 0 where it is unknown

    def __len__(self) -> int:
        return len(self.p_detect)

    def sums_with_each(self, views: Sequence[int] = ()) -> Float:
        """Return the sums (D, 16) of a set of views with each view added, in single precision."""
        left = self.terms
        if len(views):
            left = self.p_missed(views).astype(np.float64)[:, None] * self.terms
        return np.asarray(self.terms.sum(0) - left.sum(0) + self.p_detect @ left.astype(np.float32))

    def p_missed(self, views: Sequence[int]) -> NDArray[np.float32]:
        """Return the probability (U,) that none of some views detects each landmark."""
        return np.asarray(np.prod(1 - self.p_detect[np.asarray(views, dtype=np.int64)], axis=0), dtype=np.float32)

    def p_none(self, views: Sequence[int]) -> float:
        """Return the probability that none of some views localizes on its own, if they were independent."""
        return float(np.prod(1 - self.p_single[np.asarray(views, dtype=np.int64)]))

    def joint_sums(self, views: Sequence[int]) -> Float:
        """Return the sums (16,) of a set of views, in double precision."""
        return np.asarray((1 - self.p_missed(views).astype(np.float64)) @ self.terms)


def candidate_views(
    scorer: Scorer, location: Float, directions: Float, scores: Float | None = None, certain: bool = False
) -> Detections:
    """Describe what views along directions (D, 3) from a location (3,) m detect.

    `scores` (D,) of the scorer are the views' probabilities of localizing, if its method predicts those. Where the
    scorer knows no landmark probabilities, and if `certain`, every visible landmark is detected with equal precision.
    """
    from wheretolook.visibility.frustum import LandmarkSets

    location = np.asarray(location, dtype=np.float64)
    poses = poses_looking_along(np.tile(location, (len(directions), 1)), directions)
    localization_map = scorer.localization_map
    starts, indices = localization_map.in_view_on_device(poses)
    n_visible = np.diff(starts)
    rows = indices.cpu().numpy().astype(np.int64)
    view = np.repeat(np.arange(len(poses)), n_visible)
    # of more than 12,000 visible landmarks of all views, an even share represents all
    stride = max(1, -(-len(rows) // 12_000))
    kept = rows % stride == 0  # the same landmarks for every view, so that views still share them
    rows = rows[kept]
    view = view[kept]
    landmarks, column = np.unique(rows, return_inverse=True)
    offsets = localization_map.landmarks.points[landmarks] - location
    terms = np.concatenate([np.ones((len(landmarks), 1)), bearing_numbers(offsets)], axis=1)
    p_detect = np.zeros((len(poses), len(landmarks)), dtype=np.float32)
    p_detect[view, column] = 1
    p_single = np.zeros(len(poses))
    if not certain:
        ends = np.concatenate([[0], np.bincount(view, minlength=len(poses)).cumsum()])
        known = scorer.landmark_probabilities(poses, LandmarkSets(ends, rows.astype(np.int32))) if len(rows) else None
        if known is not None:
            p_detect[view, column] = known.p_detect
            precision = np.ones(len(landmarks))
            precision[column] = known.precision  # the same from every view: it depends on the distance
            terms[:, 1:] *= precision[:, None]
        method = find(scorer.name)
        if method is not None and method.name != scorer.name:
            fix = "Leave the accuracy out for several views of a location."
            raise ConfigError("joint scores have the accuracy of the weights", value=scorer.name, fix=fix)
        if scores is not None and method is not None and method.probability:
            p_single = np.clip(np.asarray(scores, dtype=np.float64), 0, 1)
    return Detections(p_detect, terms * stride, n_visible, p_single)


def log_position_variance(sums: Float) -> Float:
    """Return the log (...,) of the trace of the position's covariance from sums (..., 16)."""
    information = information_matrices(sums[..., 1:]) + PRIOR * np.eye(6)
    covariance = np.linalg.inv(information)
    return np.log(np.trace(covariance[..., :3, :3], axis1=-2, axis2=-1))


class SetScoreModel(LogisticRegression):
    """Logistic regression fitted to random sets of 1 to 5 views; the same for every size.

    The log-odds that some view localizes on its own matter most, but treat views of the same landmarks as independent.
    The position variance left by all landmarks they detect jointly corrects for that: it falls more with new landmarks
    than with more detections of the same.
    """

    names = ("log_odds_alone", "log_position_variance")
    about = "scores of sets of views"
    file = Path(__file__).with_name("set_score.json")

    def __call__(self, sums: Float, p_none: Float) -> Float:
        """Return the probability (B,) of sets from their sums (B, 16) and p_none (B,), that no view localizes."""
        p_some = np.clip(1 - np.asarray(p_none, dtype=np.float64), 1e-3, 1 - 1e-3)
        log_odds = np.log(p_some / (1 - p_some))
        return self.predict_proba(np.stack([log_odds, log_position_variance(np.asarray(sums))], axis=-1))


MAX_VIEWS = 6  # of a set: all orders are tried
CANDIDATES = 24  # directions with the best single-view scores that a set is selected from
SEPARATION_DEG = 15.0  # angle between candidates; nearer ones see the same

SetScore = Callable[[Float, Float], Float]
"""Scores (B,) of sets from their sums (B, 16) and the probability (B,) that no view localizes on its own."""


@dataclass(frozen=True)
class ViewSet:
    """A set of views in the order of least rotation."""

    rows: tuple[int, ...]  # of the directions
    score: float
    total_turn_deg: float  # from the first to the last, and from the current orientation to the first if there is one


class Rotations:
    """Angles by which a camera without roll rotates between directions (D, 3), and from its current axis `start` (3,).

    Without a start, any view may be the first.
    """

    def __init__(self, directions: Float, start: ArrayLike | None = None) -> None:
        rotations = rotation_looking_along(directions)
        self.between = rotation_angle_deg(rotations[:, None], rotations[None])
        self.start = None if start is None else rotation_angle_deg(rotations, rotation_looking_along(start))

    def shortest(self, views: Sequence[int]) -> tuple[float, tuple[int, ...]]:
        """Return the least total rotation in degrees over all orders of some views, and that order."""
        orders = np.array(list(permutations(views)))
        total = self.between[orders[:, :-1], orders[:, 1:]].sum(1)
        if self.start is not None:
            total = total + self.start[orders[:, 0]]
        best = int(np.argmin(np.round(total, 9)))
        return float(total[best]), tuple(int(view) for view in orders[best])

    def with_one_more(self, views: Sequence[int]) -> Float:
        """Return the least total rotation (D,) of some views and each direction."""
        n = len(self.between)
        start = np.zeros(n) if self.start is None else self.start
        if not views:
            return start
        least = np.full(n, np.inf)
        for order in permutations(views):
            path = np.asarray(order)
            legs = self.between[path[:-1], path[1:]]
            known = start[path[0]] + legs.sum()
            as_first = self.between[path[0]] + (start - start[path[0]])
            least = np.minimum(least, known + np.minimum(as_first, self.between[path[-1]]))
            for k, leg in enumerate(legs):
                detour = self.between[path[k]] + self.between[path[k + 1]] - leg
                least = np.minimum(least, known + detour)
        return least


def best_views(
    scorer: Scorer,
    location: Float,
    directions: Float,
    scores: Float,
    n: int,
    max_turn_deg: float | None = None,
    start: ArrayLike | None = None,
) -> ViewSet:
    """Select the n views from a location (3,) m with the best joint score, of directions (D, 3) with scores (D,).

    The total rotation stays within `max_turn_deg`, counted from the axis `start` (3,) if that is given.

    Raises:
        ConfigError: a number of views below 1 or above the number of directions, or a negative limit.
        PlanningError: no such views can be reached.
    """
    if n > len(directions):
        fix = "Ask for fewer views, score more directions, or widen the limits."
        raise ConfigError("there are fewer directions than views", value=f"{len(directions)} for {n}", fix=fix)
    rows = candidates(directions, scores, max(CANDIDATES, n), max_turn_deg, start)
    axes = directions[rows]
    views = candidate_views(scorer, location, axes, scores[rows])
    chosen = select_views(views, SetScoreModel.bundled(), n, Rotations(axes, start), max_turn_deg, scores[rows])
    return ViewSet(tuple(int(rows[view]) for view in chosen.rows), chosen.score, chosen.total_turn_deg)


def candidates(
    directions: Float, scores: Float, limit: int, max_turn_deg: float | None = None, start: ArrayLike | None = None
) -> NDArray[np.int64]:
    """Return rows (C,) of directions to select from: the best separated ones, and near the best one if limited."""
    order = np.argsort(-np.asarray(scores), kind="stable")
    if start is not None and max_turn_deg is not None:
        axis = np.asarray(start, dtype=np.float64)
        # a camera that does not roll rotates at least by the angle of its axis
        order = order[directions[order] @ axis / np.linalg.norm(axis) >= _cosine(max_turn_deg)]
    rows = separated(directions, order, limit, SEPARATION_DEG)
    if max_turn_deg is not None and len(order):
        rows += order[directions[order] @ directions[order[0]] >= _cosine(max_turn_deg)][:limit].tolist()
    if len(rows) < limit:  # so few directions, or so close to one another
        rows += order[:limit].tolist()
    return np.array(list(dict.fromkeys(rows)), dtype=np.int64)


def separated(directions: Float, order: NDArray[np.integer], limit: int, apart_deg: float) -> list[int]:
    """Return the first rows, at most `limit`, of unit directions (D, 3) in an order that are so far from one another."""
    rows: list[int] = []
    free = np.ones(len(directions), dtype=bool)
    near = np.cos(np.radians(apart_deg))
    for row in order.tolist():
        if free[row] and len(rows) < limit:
            rows.append(row)
            free &= directions @ directions[row] < near
    return rows


def _cosine(limit_deg: float) -> float:
    return float(np.cos(np.radians(min(180.0, max(0.0, limit_deg) + TOLERANCE_DEG))))


def select_views(
    views: Detections,
    set_score: SetScore,
    n: int,
    rotations: Rotations,
    max_turn_deg: float | None = None,
    single: ArrayLike | None = None,
    exchanges: int = 3,
    required: int | None = None,
) -> ViewSet:
    """Select the n views with the best joint score: greedily one after the other, then by exchange of single ones in several rounds.

    `single` are single-view scores (D,) that decide the first; the score of a set of one unless given. The total
    rotation stays within `max_turn_deg`. A set never scores less than the greedy one. `required` is a row that is in
    the set in any case.

    Raises:
        ConfigError: a number of views below 1 or above the number of directions, or a negative limit.
        PlanningError: no such views can be reached.
    """
    if not 1 <= n <= min(MAX_VIEWS, len(views)):
        raise ConfigError(f"a set has 1 to {MAX_VIEWS} looks, of {len(views)} directions", value=n)
    if max_turn_deg is not None and not 0 <= max_turn_deg < np.inf:
        raise ConfigError("a limit on rotation is degrees of at least 0", value=max_turn_deg)
    limit = np.inf if max_turn_deg is None else max_turn_deg + TOLERANCE_DEG
    fixed = [] if required is None else [required]

    def best_addition(rows: list[int], limit: float) -> tuple[int, float] | None:
        values = _with_each(views, set_score, rows) if rows or single is None else np.asarray(single)
        allowed = rotations.with_one_more(rows) <= limit
        allowed[rows] = False
        best = int(np.where(allowed, values, -np.inf).argmax())
        return (best, float(values[best])) if allowed.any() else None

    def greedy(limits: Float) -> list[int] | None:
        chosen = list(fixed)
        for limit in limits[len(fixed) :]:
            addition = best_addition(chosen, limit)
            if addition is None:
                return None
            chosen.append(addition[0])
        return chosen

    # the best view may be so far off that no rotation remains for the others
    chosen = greedy(np.full(n, limit)) or greedy(limit * np.arange(1, n + 1) / n)
    if chosen is None:
        fix = "Raise the limit on rotation, which is in degrees, or offer more directions."
        raise PlanningError(f"no {n} looks can be reached", value=max_turn_deg, fix=fix)
    score = score_of_set(views, set_score, chosen)
    for _ in range(exchanges if n > 1 else 0):
        before = score
        for k in range(len(fixed), n):
            others = chosen[:k] + chosen[k + 1 :]
            addition = best_addition(others, limit)
            if addition is not None and addition[1] > score + 1e-9:
                chosen = [*others[:k], addition[0], *others[k:]]
                score = addition[1]
        if score <= before:
            break
    total, order = rotations.shortest(chosen)
    return ViewSet(order, score, total)


def score_of_set(views: Detections, set_score: SetScore, rows: list[int]) -> float:
    """Return the score of a set of views."""
    return float(set_score(views.joint_sums(rows)[None], np.array([views.p_none(rows)]))[0])


def _with_each(views: Detections, set_score: SetScore, rows: list[int]) -> Float:
    """Return the score (D,) of a set with each view added."""
    return set_score(views.sums_with_each(rows), views.p_none(rows) * (1 - views.p_single))
