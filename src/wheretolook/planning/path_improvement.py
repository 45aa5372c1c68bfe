"""Improving a route by a random local search over its corners."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.poses import Float
from wheretolook.planning.polylines import between, lengths_along


class Space(Protocol):
    """Where a camera may be: `wheretolook.space.free_space.FreeSpace`, or anything that answers the same."""

    def is_free(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether a camera may be at points (N, 3) m; (N,)."""

    def segments_are_free(self, a: ArrayLike, b: ArrayLike) -> NDArray[np.bool_]:
        """Whether it may go straight from points a to points b, (N, 3) m each; (N,)."""


STEPS_M = (0.05, 1.0)
"""Range of the standard deviation by which a corner is moved."""


def improve(
    places: Float,
    cost_below: Callable[[Float, float], float | None],
    cost: float,
    space: Space,
    bounds: Float,
    seconds: float,
    rng: np.random.Generator,
    most: int | None = None,
) -> Float:
    """Improve a route by shortcuts and by moving, adding and removing corners; returns the cheapest found, (S', 3) m.

    Every route tried lies in free space and keeps its ends.

    Args:
        places: (S, 3) corners of a free route, metres.
        cost_below: the cost of a route if that is less than a limit, else None.
        cost: cost of the route given.
        space: where a camera can go.
        bounds: (2, 3) lowest and highest corner of the space to plan in, metres.
        seconds: time to search.
        rng: random numbers.
        most: routes to try at most.
    """
    end, tried = time.monotonic() + seconds, 0
    while time.monotonic() < end and (most is None or tried < most):
        tried += 1
        candidate, first, last = _varied(places, bounds, rng)
        # only the changed segments need to be tested
        if not space.segments_are_free(candidate[first:last], candidate[first + 1 : last + 1]).all():
            continue
        found = cost_below(candidate, cost)
        if found is not None:
            places, cost = candidate, found
    return places


def _varied(places: Float, bounds: Float, rng: np.random.Generator) -> tuple[Float, int, int]:
    """A random variation of a route, and the first and last corner between which it differs."""
    n, step = len(places), np.exp(rng.uniform(*np.log(STEPS_M)))
    kind = rng.integers(4) if n > 2 else rng.integers(2)
    if kind == 0:  # a new corner beside a random point of the route
        after = int(rng.integers(1, n))
        t = rng.random()
        new = places[after - 1] * (1 - t) + places[after] * t + rng.normal(0, step, 3)
        return np.insert(places, after, new.clip(*bounds), axis=0), after - 1, after + 1
    if kind == 1:  # a shortcut between two random points of the route
        at = lengths_along(places)
        a, b = np.sort(rng.uniform(0, at[-1], 2))
        ends = between(at, places, np.array([a, b]))
        before, after = int((at < a).sum()), int((at <= b).sum())
        return np.concatenate([places[:before], ends, places[after:]]), before - 1, before + 2
    row = int(rng.integers(1, n - 1))
    if kind == 2:  # remove a corner
        return np.delete(places, row, axis=0), row - 1, row
    moved = places.copy()
    moved[row] = (moved[row] + rng.normal(0, step, 3)).clip(*bounds)
    return moved, row - 1, row + 1
