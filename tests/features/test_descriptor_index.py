"""Nearest landmarks of a large map by an index, next to the exact search."""

import numpy as np
import pytest

from wheretolook.features import matching as descriptor_index
from wheretolook.features.matches import match
from wheretolook.features.matching import MAX_NEAREST, DescriptorIndex, DescriptorMatcher, has_index


def stored(values):
    """Descriptors (N, 128) uint8 of length 512."""
    positive = np.abs(values)
    return np.round(512 * positive / np.linalg.norm(positive, axis=1, keepdims=True)).astype(np.uint8)


def test_the_index_finds_what_the_exact_search_finds():
    pytest.importorskip("faiss")
    rng = np.random.default_rng(0)
    kinds = rng.normal(size=(200, 128)) ** 3  # landmarks are of 200 kinds that look alike
    landmarks = stored(kinds[rng.integers(0, 200, 8000)] + 0.6 * rng.normal(size=(8000, 128)))
    queries = stored(landmarks[:500] + rng.normal(0, 8, (500, 128)))
    index, exact = DescriptorIndex(landmarks, lists=64), DescriptorMatcher(landmarks)
    rows, squared = index.nearest(queries, MAX_NEAREST)
    true_rows, _ = exact.nearest(queries, MAX_NEAREST)
    assert rows.shape == squared.shape == (500, MAX_NEAREST) and (np.diff(squared) >= 0).all()
    differences = landmarks[rows].astype(np.int64) * queries[:, None]
    np.testing.assert_array_equal(squared, np.maximum(2 * (512**2 - differences.sum(-1)), 0))
    assert (rows[:, 0] == true_rows[:, 0]).mean() > 0.9
    found, expected = (match(matcher, [queries, queries[:0]], 0.85, MAX_NEAREST) for matcher in (index, exact))
    assert len(np.intersect1d(found[0].landmarks, expected[0].landmarks)) > 0.97 * len(expected[0].landmarks) > 150
    assert len(found[1].keypoints) == 0


def test_an_index_serves_large_maps_on_a_cpu(monkeypatch, caplog):
    monkeypatch.setattr(descriptor_index, "find_spec", lambda name: object())
    assert has_index(1_000_000, "cpu") and not has_index(1_000_000, "cuda:0") and not has_index(25_000, "cpu")
    monkeypatch.setattr(descriptor_index, "find_spec", lambda name: None)
    assert not has_index(1_000_000, "cpu") and "wheretolook[large]" in caplog.text
