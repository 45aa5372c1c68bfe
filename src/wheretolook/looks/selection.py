"""Choosing a set of looks from a place: greedily, then by exchange, under a limit on how far the camera turns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera_turns import TOLERANCE_DEG
from wheretolook.geometry.poses import Float, rotation_angle_deg, rotation_looking_along
from wheretolook.utils.errors import ConfigError, PlanningError

if TYPE_CHECKING:
    from wheretolook.looks.joint_visibility import SeenAround

MOST_LOOKS = 6  # the order of so many is found by trying all
EXCHANGES = 3  # rounds in which each look may be exchanged for a better one

Worth = Callable[[Float, Float], Float]
"""Worths (B,) of sets from their sums (B, N_SUMS) and the chances (B,) that none of their looks localizes alone; higher
is better."""


@dataclass(frozen=True)
class ChosenLooks:
    """A set of looks in the order that turns least."""

    looks: tuple[int, ...]  # rows of the directions
    worth: float
    total_turn_deg: float  # from the first to the last, and from the current orientation to the first if there is one


class Turns:
    """Angles by which the camera turns between D directions (D, 3) without roll, and from where it looks now.

    `start` is the axis (3,) that it looks along now; None if any look may be the first.
    """

    def __init__(self, directions: Float, start: ArrayLike | None = None) -> None:
        rotations = rotation_looking_along(directions)
        self.between = rotation_angle_deg(rotations[:, None], rotations[None])
        self.start = None if start is None else rotation_angle_deg(rotations, rotation_looking_along(start))

    def shortest(self, looks: Sequence[int]) -> tuple[float, tuple[int, ...]]:
        """The least total turn in degrees over all orders of some looks, and the order; of equals the first."""
        orders = np.array(list(permutations(looks)))
        total = self.between[orders[:, :-1], orders[:, 1:]].sum(1)
        if self.start is not None:
            total = total + self.start[orders[:, 0]]
        best = int(np.argmin(np.round(total, 9)))
        return float(total[best]), tuple(int(look) for look in orders[best])

    def with_one_more(self, looks: Sequence[int]) -> Float:
        """The least total turn (D,) of some looks and each direction; `shortest` for all of them at once."""
        n = len(self.between)
        if not looks:
            return np.zeros(n) if self.start is None else self.start
        least = np.full(n, np.inf)
        for order in permutations(looks):
            path = np.asarray(order)
            legs = self.between[path[:-1], path[1:]]
            first = 0.0 if self.start is None else self.start[path[0]]
            before = self.between[path[0]] + (0.0 if self.start is None else self.start - first)  # the new one first
            least = np.minimum(least, first + legs.sum() + np.minimum(before, self.between[path[-1]]))
            for k, leg in enumerate(legs):
                extra = self.between[path[k]] + self.between[path[k + 1]] - leg
                least = np.minimum(least, first + legs.sum() + extra)
        return least


def choose_looks(
    seen: SeenAround,
    worth: Worth,
    n: int,
    turns: Turns,
    max_turn_deg: float | None = None,
    first: ArrayLike | None = None,
    exchanges: int | None = None,
    taken: int | None = None,
) -> ChosenLooks:
    """The n looks that are worth most together: greedily one after the other, then by exchange of single ones.

    `first` are single looks' own scores (D,): by them the first is chosen, the worth of one look unless given. The
    total turn keeps within `max_turn_deg`. There are `EXCHANGES` rounds of exchange unless told otherwise; a set is
    never worth less than what greedy choice alone gives. `taken` is a look that is in the set whatever it is worth.

    Raises a ConfigError for a number of looks that is none, or more than there are directions, and a PlanningError if
    no look can be reached.
    """
    _check(n, len(seen), max_turn_deg)
    limit = np.inf if max_turn_deg is None else max_turn_deg + TOLERANCE_DEG
    single = _added(seen, worth, []) if first is None else np.asarray(first, dtype=np.float64)
    begun = [] if taken is None else [taken]
    looks = _greedy(seen, worth, n, turns, np.full(n, limit), single, begun)
    if looks is None:  # the best look may lie so far off that no turn is left for the others
        looks = _greedy(seen, worth, n, turns, limit * np.arange(1, n + 1) / n, single, begun)
    if looks is None:
        fix = "Raise the limit on turning, or look along more directions."
        raise PlanningError(f"no {n} looks can be reached", value=max_turn_deg, fix=fix)
    now = worth_of(seen, worth, looks)
    rounds = EXCHANGES if exchanges is None else exchanges
    for _ in range(rounds if n > 1 else 0):
        before = now
        for k in range(len(begun), n):
            others = looks[:k] + looks[k + 1 :]
            value = _added(seen, worth, others)
            best = _best(value, turns.with_one_more(others) <= limit, others)
            if best is not None and value[best] > now + 1e-9:
                looks = [*others[:k], best, *others[k:]]
                now = float(value[best])
        if now <= before:
            break
    total, order = turns.shortest(looks)
    return ChosenLooks(order, now, total)


def _greedy(
    seen: SeenAround, worth: Worth, n: int, turns: Turns, limits: Float, single: Float, begun: list[int]
) -> list[int] | None:
    """n looks, added one by one to those begun with, the first k within the k-th limit; None if there are no such."""
    looks = list(begun)
    for limit in limits[len(begun) :]:
        best = _best(_added(seen, worth, looks) if looks else single, turns.with_one_more(looks) <= limit, looks)
        if best is None:
            return None
        looks.append(best)
    return looks


def choose_exhaustively(
    seen: SeenAround, worth: Worth, n: int, turns: Turns, max_turn_deg: float | None = None
) -> ChosenLooks:
    """What `choose_looks` approximates: the best of all sets of n looks; plain, for small numbers of directions."""
    _check(n, len(seen), max_turn_deg)
    limit = np.inf if max_turn_deg is None else max_turn_deg + TOLERANCE_DEG
    best: ChosenLooks | None = None
    for looks in combinations(range(len(seen)), n):
        total, order = turns.shortest(looks)
        value = worth_of(seen, worth, list(looks))
        if total <= limit and (best is None or value > best.worth):
            best = ChosenLooks(order, value, total)
    if best is None:
        raise PlanningError(f"no {n} looks can be reached", value=max_turn_deg, fix="Raise the limit on turning.")
    return best


def worth_of(seen: SeenAround, worth: Worth, looks: list[int]) -> float:
    """The worth of a set of looks."""
    return float(worth(seen.union(looks)[None], np.array([seen.failed(looks)]))[0])


def best_one_by_one(scores: Float, directions: Float, n: int, apart_deg: float = 40.0) -> list[int]:
    """The n looks with the highest scores (D,) of their own, at least so far apart if there are so many."""
    order = np.argsort(-np.asarray(scores), kind="stable").tolist()
    near = np.cos(np.radians(apart_deg))
    looks: list[int] = []
    for look in order:
        if all(directions[look] @ directions[other] <= near for other in looks):
            looks.append(look)
    return (looks + [look for look in order if look not in looks])[:n]


def evenly_spread(directions: Float, n: int, first: int) -> list[int]:
    """n looks as far apart as can be, from a first one on: always the one whose nearest is farthest."""
    looks = [first]
    while len(looks) < n:
        nearest = (directions @ directions[looks].T).max(1)
        nearest[looks] = np.inf
        looks.append(int(nearest.argmin()))
    return looks


def _added(seen: SeenAround, worth: Worth, looks: list[int]) -> Float:
    """The worth (D,) of some looks with each direction added."""
    return worth(seen.sums(seen.missed(looks) if looks else None), seen.failed(looks) * (1 - seen.alone))


def _best(value: Float, allowed: NDArray[np.bool_], looks: list[int]) -> int | None:
    free = allowed.copy()
    free[looks] = False
    return int(np.where(free, value, -np.inf).argmax()) if free.any() else None


def _check(n: int, n_directions: int, max_turn_deg: float | None) -> None:
    if not 1 <= n <= MOST_LOOKS:
        raise ConfigError(f"a set has 1 to {MOST_LOOKS} looks", value=n)
    if n > n_directions:
        raise ConfigError(f"there are only {n_directions} directions to choose from", value=n)
    if max_turn_deg is not None and not 0 <= max_turn_deg < np.inf:
        raise ConfigError("a limit on turning is degrees of at least 0", value=max_turn_deg)
