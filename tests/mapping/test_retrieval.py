"""Pairs of photographs to match."""

import numpy as np
import pytest

from wheretolook.features.extractor import SIFT
from wheretolook.mapping.triangulation import photograph_pairs

N = 80
SHARED = 5  # photographs that are fewer places apart show the same


@pytest.fixture(scope="module")
def walk():
    """Keypoints of photographs along a walk: each shows 5 of 85 groups of 20 landmarks, one more than the one before."""
    rng = np.random.default_rng(0)
    places = rng.gamma(0.3, size=(N + SHARED, 20, SIFT.dimension))

    def photograph(row):
        seen = places[row : row + SHARED].reshape(-1, SIFT.dimension)
        noisy = seen + rng.normal(0, 0.02, seen.shape).clip(0)
        return np.zeros((len(seen), 2), np.float32), SIFT.store(noisy / np.linalg.norm(noisy, axis=1)[:, None])

    return [photograph(row) for row in range(N)]


def test_all_pairs_of_few_are_matched(walk):
    assert photograph_pairs(walk[:4], SIFT, 10, 2).tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]


def test_photographs_in_order_are_matched_with_their_neighbours_by_name(walk):
    pairs = {*map(tuple, photograph_pairs(walk, SIFT, 60, 10).tolist())}
    assert all((i, i + step) in pairs for step in (1, 10, 16, 64) for i in range(N - step))


def test_photographs_in_any_order_are_matched_where_they_show_the_same(walk, caplog):
    caplog.set_level("INFO", "wheretolook")
    order = np.random.default_rng(1).permutation(N)
    pairs = photograph_pairs([walk[row] for row in order], SIFT, 60, 10, partners=6)
    assert "not the order of capture" in caplog.text
    assert (pairs[:, 0] < pairs[:, 1]).all() and len(np.unique(pairs, axis=0)) == len(pairs) <= 6 * N
    chosen = {tuple(sorted(order[pair])) for pair in pairs}
    assert np.mean([(i, i + step) in chosen for step in (1, 2) for i in range(N - step)]) > 0.95
