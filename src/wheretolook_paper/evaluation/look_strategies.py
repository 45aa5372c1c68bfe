"""Strategies of choosing sets of views that the paper's tables compare with the product's selection."""

from __future__ import annotations

import numpy as np

from wheretolook.geometry.poses import Float
from wheretolook.looks.selection import Detections, Rotations, SetScoreModel, select_views
from wheretolook_paper.fisher.metrics import metric_of


def information_score(sums: Float, p_none: Float) -> Float:
    """Return the log determinant (B,) of the information in sums (B, N_SUMS)."""
    return metric_of(np.asarray(sums)[..., 1:], "logdet")


def count_score(sums: Float, p_none: Float) -> Float:
    """Return how many different landmarks are expected to be detected, (B,)."""
    return np.asarray(sums)[..., 0]


def best_separated(scores: Float, directions: Float, n: int, separation_deg: float = 40.0) -> list[int]:
    """Return the n views with the best single-view scores (D,), separated by an angle if there are as many."""
    order = np.argsort(-np.asarray(scores), kind="stable").tolist()
    near = np.cos(np.radians(separation_deg))
    views: list[int] = []
    for view in order:
        if all(directions[view] @ directions[other] <= near for other in views):
            views.append(view)
    return (views + [view for view in order if view not in views])[:n]


def evenly_spread(directions: Float, n: int, first: int) -> list[int]:
    """Return n views spread from a first one on: always the one whose nearest is farthest."""
    views = [first]
    while len(views) < n:
        nearest = (directions @ directions[views].T).max(1)
        nearest[views] = np.inf
        views.append(int(nearest.argmin()))
    return views


def choose_set(
    strategy: str, n: int, axes: Float, scores: Float, views: Detections, certain: Detections, rng: np.random.Generator
) -> list[int]:
    """Return the rows of n views along axes (D, 3) with scores (D,) that a strategy of the tables chooses."""
    if strategy == "random":
        return [int(row) for row in rng.choice(len(axes), n, replace=False)]
    if strategy == "one-by-one":
        return best_separated(scores, axes, n)
    if strategy == "even":
        return evenly_spread(axes, n, int(np.argmax(scores)))
    rotations = Rotations(axes)
    if strategy in ("visible", "fisher"):
        objective = count_score if strategy == "visible" else information_score
        return list(select_views(certain, objective, n, rotations).rows)
    options = {"exchanges": 0} if strategy == "in-turn" else {}
    chosen = select_views(views, SetScoreModel.bundled(), n, rotations, single=scores, **options)
    return list(chosen.rows)
