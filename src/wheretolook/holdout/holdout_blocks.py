"""Which photographs are left out together: blocks of neighbours, so that the rest covers them from well to badly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.holdout.photo_map import PhotographedMap
from wheretolook.localization.config import LocalizerConfig
from wheretolook.utils.errors import MapError

PARTS = 8  # blocks that share out all photographs among them
SPREAD = 4.0  # the largest of these over the smallest
KEPT = tuple(LocalizerConfig().min_inliers * share for share in (16, 8, 4, 2))
"""Landmarks that the rest still has of what a photograph observes, at most, of the worse covered quarter of each grown
block: from plenty for a pose to hardly enough, since not all are found again."""
COVERED_WORSE = 0.25
LEAST_REST = 0.1  # share of the photographs that is never left out
LEAST_LANDMARKS = 50  # that a map without a block has; with fewer it is none
SAME = 0.95  # of two blocks together, photographs in both: from there on only the one that is grown further is taken
VIEWS = 60  # photographs of a block that are localized, at most; then evenly spread ones
_GOLDEN = 0.6180339887


@dataclass(frozen=True, eq=False)
class Block:
    """Photographs that are left out together, by their rows."""

    number: int  # from 1
    left_out: NDArray[np.int64]  # (B,) ascending
    looked_at: NDArray[np.int64]  # (V,) those that are localized, ascending
    is_part: bool  # whether it is one of those that share out all photographs, and so left out nowhere else of these


def choose_blocks(source: PhotographedMap, views: int = VIEWS) -> list[Block]:
    """8 blocks of several sizes that share out all photographs, and 4 more, grown until the rest hardly covers them.

    Photographs are neighbours by the landmarks that they share, not by name or place: so a second walk past the same
    wall is a neighbour, and a photograph of the next room is not. A block grows by the photograph that has most of its
    landmarks in common with it. The first 8 (fewer of few moments) have sizes in geometric progression, the largest 4
    times the smallest. The others grow from four places until a quarter of the photographs in them observe no more than
    `KEPT` landmarks that the rest still has; so they hold views of all kinds, well covered ones at their edges and
    badly covered ones within. No block takes more than nine tenths of the photographs, and blocks that are mostly the
    same are taken once. What a rig took at one moment stays together. The same map gives the same blocks.

    Raises MapError if fewer than two blocks leave a map.
    """
    sees = observation_matrix(source)
    shared = np.asarray((sees @ sees.T).toarray(), dtype=np.float64)
    observed = np.maximum(np.diag(shared).copy(), 1)
    np.fill_diagonal(shared, 0)
    share = shared / observed[:, None]  # of a moment's landmarks, those that it has in common with each other
    centers = camera_centers(source.poses)
    sums = np.stack([np.bincount(source.moment, weights=axis) for axis in centers.T], axis=1).astype(np.float64)
    places = sums / np.bincount(source.moment)[:, None]
    parts = _share_out(share, places)
    walk = np.concatenate(parts)  # all moments, neighbours next to one another
    groups = [(part, True) for part in parts]
    for number, kept in enumerate(KEPT, 1):
        order = _grow(share, places, int(walk[int(number * _GOLDEN % 1 * len(walk))]), np.ones(len(share), dtype=bool))
        groups.append((order[: _enough(sees, order, kept)], False))
    taken = list[tuple[NDArray[np.int64], bool]]()
    for group, is_part in reversed(groups):
        left_out = np.flatnonzero(np.isin(source.moment, group))
        leaves_map = _landmarks_without(sees, group) >= LEAST_LANDMARKS
        if leaves_map and not any(_same(left_out, other) for other, _ in taken):
            taken.append((left_out, is_part))
    blocks = list[Block]()
    for left_out, is_part in reversed(taken):
        looked_at = left_out[
            np.unique(np.linspace(0, len(left_out) - 1, min(views, len(left_out))).round().astype(int))
        ]
        blocks.append(Block(len(blocks) + 1, left_out, looked_at, is_part))
    if len(blocks) < 2:
        problem = f"without a block of neighbouring photographs fewer than {LEAST_LANDMARKS} landmarks are left"
        fix = "Take more photographs, each part of the place from several sides, and map them all."
        raise MapError(problem, path=source.path, value=f"{len(source.poses)} photographs", fix=fix)
    return blocks


def _same(one: NDArray[np.int64], other: NDArray[np.int64]) -> bool:
    return len(np.intersect1d(one, other)) >= SAME * len(np.union1d(one, other))


def observation_matrix(source: PhotographedMap) -> csr_array:
    """Which moments (rows) observe which landmarks of the map (columns), ones in a sparse matrix."""
    arrays = source.arrays
    point = np.repeat(np.arange(len(arrays.points)), np.diff(arrays.observation_start))
    of_image = source.moment[arrays.observation_image]
    shape = (int(source.moment.max()) + 1, len(arrays.points))
    sees = coo_array((np.ones(len(point), dtype=np.float32), (of_image, point)), shape=shape).tocsr()
    sees.data[:] = 1
    return sees


def _share_out(share: Float, places: Float) -> list[NDArray[np.int64]]:
    """All moments in blocks of neighbours of different sizes. Each grows from what is least connected with the rest."""
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
    """All free moments, in the order in which a block takes them up that starts with one of them.

    Next is the one with most of its landmarks in common with the block, of equals the nearest to the first.
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


def _enough(sees: csr_array, order: NDArray[np.int64], kept: float) -> int:
    """How many of the moments of a growing block to leave out, so that the median one keeps no more landmarks."""
    low = 2
    high = max(2, int((1 - LEAST_REST) * len(order)))
    while low < high:  # the larger the block, the less is left
        middle = (low + high) // 2
        if np.quantile(landmarks_kept(sees, order[:middle]), COVERED_WORSE) <= kept:
            high = middle
        else:
            low = middle + 1
    while low > 2 and _landmarks_without(sees, order[:low]) < LEAST_LANDMARKS:
        low = low * 9 // 10
    return low


def landmarks_kept(sees: csr_array, group: NDArray[np.int64]) -> NDArray[np.int64]:
    """Of the landmarks that each moment of a group observes, how many two or more of the others observe, too."""
    return np.asarray((sees[group] @ _left(sees, group)), dtype=np.int64).reshape(-1)


def _left(sees: csr_array, group: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.asarray(sees.sum(0) - sees[group].sum(0) >= 2, dtype=np.float64).reshape(-1)


def _landmarks_without(sees: csr_array, group: NDArray[np.int64]) -> int:
    return int(_left(sees, group).sum())
