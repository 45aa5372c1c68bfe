"""Matching against its plain twin, exactly: all sizes, extremes, blocks, devices, and CPUs without VNNI."""

import os
import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from numpy.typing import NDArray

from twins.features import nearest
from wheretolook.features import matching, matching as descriptor_index
from wheretolook.features.extractor import quantize_descriptors, unit_descriptors
from wheretolook.features.matches import match
from wheretolook.features.matching import MAX_NEAREST, DescriptorIndex, DescriptorMatcher, has_index

Descriptors = NDArray[np.uint8]


def random_descriptors(n, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (n, 128), dtype=np.uint8)


def extreme_descriptors(n, seed=0):
    """Only values 0 and 255, so that sums are as large as possible; the first row is all 255, the second all 0."""
    values = 255 * np.random.default_rng(seed).integers(0, 2, (n, 128), dtype=np.uint8)
    values[:1] = 255
    values[1:2] = 0
    return values


def sift_like_descriptors(n, seed=0):
    """RootSIFT of length 512: many small values and a few large ones."""
    histograms = np.random.default_rng(seed).exponential(size=(n, 128)) ** 2
    return quantize_descriptors(unit_descriptors(np.sqrt(histograms)))


def views_of(landmarks, n, noise, seed=1):
    """Noisy descriptors of random landmarks, some of them chosen twice."""
    rng = np.random.default_rng(seed)
    seen = unit_descriptors(landmarks[rng.integers(0, len(landmarks), n)])
    return quantize_descriptors(unit_descriptors(np.abs(seen + rng.normal(size=seen.shape) * noise)))


KINDS = pytest.mark.parametrize("make", [random_descriptors, extreme_descriptors, sift_like_descriptors])


def assert_nearest(device, queries, landmarks, count=2):
    rows, products = DescriptorMatcher(landmarks, device).products(queries, count)
    assert rows.dtype == products.dtype == np.int64 and rows.shape == products.shape == (len(queries), count)
    plain_rows, plain_products = nearest(queries, landmarks, count + 1)
    there = min(count, len(landmarks))
    assert_array_equal(products[:, :there], plain_products[:, :there])
    assert (products[:, there:] < -(2**27)).all()
    of_named = (queries.astype(np.int64)[:, None] * landmarks[rows[:, :there]]).sum(2)
    assert_array_equal(of_named, plain_products[:, :there])
    # of several equally near, any may be named
    padded = np.pad(plain_products[:, :there], ((0, 0), (1, 1)), constant_values=-1)
    padded[:, -1] = plain_products[:, there] if plain_products.shape[1] > there else -1
    apart = (padded[:, 1:-1] != padded[:, :-2]) & (padded[:, 1:-1] != padded[:, 2:])
    assert_array_equal(rows[:, :there][apart], plain_rows[:, :there][apart])


@KINDS
def test_nearest_two_agree_with_their_twin_at_every_size(device, make):
    for n in [*range(2, 71), 5_000]:
        assert_nearest(device, make(40, seed=n + 1), make(n, seed=n))
        assert_nearest(device, make(40, seed=n + 1), make(n, seed=n), 16)


@pytest.mark.parametrize("n", [1, 63, 64, 65, 127, 128, 129, 500])
def test_blocks_leave_no_seam(device, n, monkeypatch):
    """Blocks of 64 descriptors, or of one where the product of more does not fit."""
    for block in (64, 1):
        monkeypatch.setattr(matching, "_PRODUCT_BYTES", dict.fromkeys(("cpu", "cuda"), 4 * 512 * block))
        assert_nearest(device, sift_like_descriptors(n, seed=1), sift_like_descriptors(300))


def lowe(queries, landmarks, max_ratio):
    """Keypoint to landmark, by brute force: ratio of distances, and of each landmark its nearest keypoint."""
    found = {}
    for keypoint, query in enumerate(queries.astype(np.int64)):
        squared = np.maximum(2 * (512**2 - landmarks.astype(np.int64) @ query), 0)
        nearest, second = np.argsort(squared, kind="stable")[:2]
        if squared[nearest] < max_ratio**2 * squared[second]:
            found[nearest] = min(found.get(nearest, (2**62, 0)), (squared[nearest], keypoint))
    return {keypoint: landmark for landmark, (_, keypoint) in found.items()}


@pytest.mark.parametrize("max_ratio", [0.6, 0.85, 1.0])
def test_matches_pass_lowes_test_and_take_each_landmark_once(device, max_ratio):
    landmarks = sift_like_descriptors(300)
    landmarks[10] = landmarks[11]  # twins never match: their keypoints are as near to the one as to the other
    queries = np.concatenate([views_of(landmarks, 200, noise) for noise in (0.0, 0.02, 0.06)])
    ((keypoints, rows, *_),) = match(DescriptorMatcher(landmarks, device), [queries], max_ratio)
    assert dict(zip(keypoints.tolist(), rows.tolist(), strict=True)) == lowe(queries, landmarks, max_ratio)
    assert 100 < len(rows) < len(queries)
    assert (np.diff(keypoints) > 0).all() and len(set(rows)) == len(rows) and not {10, 11} & set(rows)


def run_python(code, **environment):
    path = os.pathsep.join(sys.path)
    run = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": path, **environment}, capture_output=True
    )
    assert run.returncode == 0, run.stderr.decode()
    return run.stdout.decode().strip()


@pytest.mark.slow
@pytest.mark.parametrize("instructions", ["AVX2", "AVX512_CORE"])
def test_a_cpu_whose_byte_products_saturate_finds_the_same(instructions):
    """oneDNN does not use the newer instructions of this CPU."""
    code = (
        "from features import test_matching as tests\n"
        "for make in (tests.random_descriptors, tests.extreme_descriptors, tests.sift_like_descriptors):\n"
        "    for n, k in ((3, 1), (64, 17), (70, 5), (1000, 300)):\n"
        "        tests.assert_nearest('cpu', make(k, seed=1), make(n))\n"
        "print('done')\n"
    )
    assert run_python(code, ONEDNN_MAX_CPU_ISA=instructions) == "done"


# Nearest landmarks of a large map by an index, next to the exact search.


def stored(values):
    """Descriptors (N, 128) uint8 of length 512."""
    positive = np.abs(values)
    return np.round(512 * positive / np.linalg.norm(positive, axis=1, keepdims=True)).astype(np.uint8)


def test_the_index_finds_what_the_exact_search_finds(rng):
    pytest.importorskip("faiss")
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
