"""Choose blocks of neighbouring photographs to hold out, so that the rest covers them from well to badly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.holdout.photo_map import PhotographedMap
from wheretolook.localization.config import LocalizerConfig
from wheretolook.mapping.colmap_model import observation_matrix
from wheretolook.utils.errors import MapError

PARTS = 8  # blocks that partition the photographs
SPREAD = 4.0  # ratio of the sizes of the largest and the smallest
KEPT = tuple(LocalizerConfig().min_inliers * share for share in (16, 8, 4, 2))
"""Landmarks that the rest may still have of what a photograph observes, at the quantile `COVERED_WORSE` of each grown
block: from plenty for a pose to hardly enough, since not all are matched again."""
COVERED_WORSE = 0.25
MIN_REST = 0.1  # share of the photographs that is never held out
MIN_LANDMARKS = 50  # of a map without a block
SAME = 0.95  # intersection over union from which on two blocks are the same
VIEWS = 60  # maximum number of photographs of a block that are localized; then evenly spread ones
_GOLDEN = 0.6180339887


@dataclass(frozen=True, eq=False)
class Block:
    """Photographs that are held out together, by their rows.

    Attributes:
        number: from 1.
        held_out: (B,) held-out photographs, ascending.
        tested: (V,) those of them that are localized, ascending.
        is_part: whether the block belongs to the partition of all photographs.
    """

    number: int
    held_out: NDArray[np.int64]
    tested: NDArray[np.int64]
    is_part: bool


def choose_blocks(source: PhotographedMap, views: int = VIEWS) -> list[Block]:
    """Choose 8 blocks of several sizes that partition the photographs, and 4 more, grown until the rest hardly covers them.

    Photographs are neighbours by shared landmarks, not by name or place: a second walk past the same wall is a
    neighbour, a photograph of the next room is not. A block grows by the photograph that shares most of its landmarks
    with the block. The sizes of the first 8 (fewer for few photographs) are a geometric progression. The others grow
    from four places until a quarter of their photographs observe at most `KEPT` landmarks that the rest still has, so
    that they hold well covered views at their edges and badly covered ones within. No block takes more than nine tenths
    of the photographs, and blocks that are mostly the same are chosen once. Photographs of a rig frame stay together.

    Raises MapError if fewer than two blocks leave a map.
    """
    observes = observation_matrix(source.arrays, source.frame)
    shared = np.asarray((observes @ observes.T).toarray(), dtype=np.float64)
    counts = np.maximum(np.diag(shared).copy(), 1)
    np.fill_diagonal(shared, 0)
    share = shared / counts[:, None]  # of a frame's landmarks, those that it shares with each other frame
    centers = camera_centers(source.poses)
    sums = np.stack([np.bincount(source.frame, weights=axis) for axis in centers.T], axis=1).astype(np.float64)
    places = sums / np.bincount(source.frame)[:, None]
    parts = _partition(share, places)
    walk = np.concatenate(parts)  # all frames, neighbours next to one another
    groups = [(part, True) for part in parts]
    for number, kept in enumerate(KEPT, 1):
        first = int(walk[int(number * _GOLDEN % 1 * len(walk))])
        order = _grow(share, places, first, np.ones(len(share), dtype=bool))
        groups.append((order[: _block_size(observes, order, kept)], False))
    chosen = list[tuple[NDArray[np.int64], bool]]()
    for group, is_part in reversed(groups):  # of two that are the same, the one that is grown further is chosen
        held_out = np.flatnonzero(np.isin(source.frame, group))
        leaves_map = _landmarks_without(observes, group) >= MIN_LANDMARKS
        if leaves_map and not any(_same(held_out, other) for other, _ in chosen):
            chosen.append((held_out, is_part))
    if len(chosen) < 2:
        problem = f"without a block of neighbouring photographs fewer than {MIN_LANDMARKS} landmarks are left"
        fix = "Take more photographs, each part of the scene from several sides, and map them all."
        raise MapError(problem, path=source.path, value=f"{len(source.poses)} photographs", fix=fix)
    return [
        Block(number, held_out, held_out[_spread(len(held_out), views)], is_part)
        for number, (held_out, is_part) in enumerate(reversed(chosen), 1)
    ]


def _spread(n: int, max_count: int) -> NDArray[np.int64]:
    """Return at most so many evenly spread rows of n."""
    return np.unique(np.linspace(0, n - 1, min(max_count, n)).round().astype(int))


def _same(one: NDArray[np.int64], other: NDArray[np.int64]) -> bool:
    return len(np.intersect1d(one, other)) >= SAME * len(np.union1d(one, other))


def _partition(share: Float, places: Float) -> list[NDArray[np.int64]]:
    """Partition all frames into blocks of neighbours; each grows from the frame least connected with the rest."""
    n = len(share)
    count = max(2, min(PARTS, n // 2))
    weights = SPREAD ** (np.arange(count) / max(1, count - 1))
    weights = weights[np.argsort(np.arange(1, count + 1) * _GOLDEN % 1, kind="stable")]  # large and small mixed
    ends = np.rint(np.cumsum(weights) / weights.sum() * n).astype(int)
    free = np.ones(n, dtype=bool)
    parts = []
    for size in np.diff(ends, prepend=0):
        rows = np.flatnonzero(free)
        if not size or not len(rows):
            continue
        loosest = rows[np.argmin(share[np.ix_(rows, rows)].sum(1))]
        block = _grow(share, places, int(loosest), free)[:size]
        free[block] = False
        parts.append(block)
    return parts


def _grow(share: Float, places: Float, first: int, free: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return all free frames in the order in which a block that starts with one of them takes them up.

    Next is the one with most of its landmarks in common with the block; ties go to the nearest to the first.
    """
    near = -np.linalg.norm(places - places[first], axis=1)
    near = near / max(1e-12, -near.min()) * 1e-6
    left = free.copy()
    bonds = share[:, first] + near
    order = [first]
    left[first] = False
    while left.any():
        following = int(np.argmax(np.where(left, bonds, -np.inf)))
        order.append(following)
        left[following] = False
        bonds = bonds + share[:, following]
    return np.array(order)


def _block_size(observes: csr_array, order: NDArray[np.int64], kept: float) -> int:
    """Return how many frames of a growing block to hold out, so that its worse covered quarter keeps `kept` landmarks."""
    low = 2
    high = max(2, int((1 - MIN_REST) * len(order)))
    while low < high:  # the larger the block, the less is left
        middle = (low + high) // 2
        if np.quantile(landmarks_kept(observes, order[:middle]), COVERED_WORSE) <= kept:
            high = middle
        else:
            low = middle + 1
    while low > 2 and _landmarks_without(observes, order[:low]) < MIN_LANDMARKS:
        low = low * 9 // 10
    return low


def landmarks_kept(observes: csr_array, group: NDArray[np.int64]) -> NDArray[np.int64]:
    """Count, for each frame of a group, the observed landmarks that at least two of the other frames observe, too."""
    return np.asarray((observes[group] @ _remaining(observes, group)), dtype=np.int64).reshape(-1)


def _remaining(observes: csr_array, group: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.asarray(observes.sum(0) - observes[group].sum(0) >= 2, dtype=np.float64).reshape(-1)


def _landmarks_without(observes: csr_array, group: NDArray[np.int64]) -> int:
    return int(_remaining(observes, group).sum())
