"""Making a route better: a random local search over its corners, for as long as there is time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.poses import Float

STEPS_M = (0.05, 1.0)
"""Least and greatest typical distance by which a corner is moved."""


class Segments(Protocol):
    """Tells where a camera can go straight."""

    def segments_are_free(self, a: ArrayLike, b: ArrayLike) -> NDArray[np.bool_]:
        """Whether it may go straight from points a to points b, (N, 3) m each; (N,)."""


def improve(
    places: Float, cost_below: Callable[[Float, float], float | None], cost: float, space: Segments, bounds: Float,
    seconds: float, rng: np.random.Generator, most: int | None = None,
) -> Float:  # fmt: skip
    """The best route that is found from one by cutting it short, and by moving, adding and leaving out corners.

    Every route tried is free and keeps its ends; one is taken if it costs less.

    Args:
        places: (S, 3) corners of a free route, metres.
        cost_below: what a route costs, if that is less than a number; else None.
        cost: of the route given.
        space: where a camera can go.
        bounds: (2, 3) lowest and highest corner of the space to plan in.
        seconds: time to search.
        rng: draws.
        most: routes to try at most.
    """
    end, tried = time.monotonic() + seconds, 0
    while time.monotonic() < end and (most is None or tried < most):
        tried += 1
        candidate, first, last = _varied(places, bounds, rng)
        # only what is new between two corners needs to be looked at
        if not space.segments_are_free(candidate[first:last], candidate[first + 1 : last + 1]).all():
            continue
        found = cost_below(candidate, cost)
        if found is not None:
            places, cost = candidate, found
    return places


def _varied(places: Float, bounds: Float, rng: np.random.Generator) -> tuple[Float, int, int]:
    """Another route, and the corners between which it differs."""
    n, step = len(places), np.exp(rng.uniform(*np.log(STEPS_M)))
    kind = rng.integers(4) if n > 2 else rng.integers(2)
    if kind == 0:  # a new corner, somewhere beside a piece
        after = int(rng.integers(1, n))
        t = rng.random()
        new = places[after - 1] * (1 - t) + places[after] * t + rng.normal(0, step, 3)
        return np.insert(places, after, new.clip(*bounds), axis=0), after - 1, after + 1
    if kind == 1:  # straight from somewhere to somewhere else
        pieces = np.linalg.norm(np.diff(places, axis=0), axis=1)
        at = np.concatenate([[0.0], np.cumsum(pieces)])
        a, b = np.sort(rng.uniform(0, at[-1], 2))
        ends = np.stack([np.interp([a, b], at, column) for column in places.T], axis=1)
        before, after = int((at < a).sum()), int((at <= b).sum())
        return np.concatenate([places[:before], ends, places[after:]]), before - 1, before + 2
    row = int(rng.integers(1, n - 1))
    if kind == 2:  # without a corner
        return np.delete(places, row, axis=0), row - 1, row
    moved = places.copy()
    moved[row] = (moved[row] + rng.normal(0, step, 3)).clip(*bounds)
    return moved, row - 1, row + 1
