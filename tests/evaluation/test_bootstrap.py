"""Bootstrap intervals and paired tests against closed forms, brute force and SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from wheretolook.evaluation.bootstrap import LocationBootstrap


def test_bootstrap_interval_is_the_binomial_one_where_locations_count_alike() -> None:
    good = np.zeros((400, 1))
    good[:120] = 1
    bootstrap = LocationBootstrap(np.zeros(400, dtype=int), 4000, seed=0)
    low, high = bootstrap.ratio(good, np.ones((400, 1)))
    error = np.sqrt(0.3 * 0.7 / 400)
    assert low[0] == pytest.approx(0.3 - 1.96 * error, abs=0.006)
    assert high[0] == pytest.approx(0.3 + 1.96 * error, abs=0.006)
    again = LocationBootstrap(np.zeros(400, dtype=int), 4000, seed=0).ratio(good, np.ones((400, 1)))
    assert (low[0], high[0]) == (again[0][0], again[1][0])


def test_bootstrap_resamples_within_scenes() -> None:
    scene = np.repeat([0, 1], [30, 70])
    good = (scene == 0).astype(float)[:, None]  # a scene is all good or all bad: resampling within it changes nothing
    low, high = LocationBootstrap(scene, 500, seed=1).ratio(good, np.ones((100, 1)))
    assert (low[0], high[0]) == (0.3, 0.3)
    alone = LocationBootstrap(np.array([0, 1]), 500, seed=1).ratio(np.ones((2, 1)), np.ones((2, 1)))
    assert np.isnan(alone).all()


def test_a_ratio_is_unknown_only_where_its_denominator_is_zero() -> None:
    top = np.array([[1.0, 0.0], [1.0, 0.0]])
    bottom = np.array([[1.0, 0.0], [0.0, 0.0]])
    low, high = LocationBootstrap(np.zeros(2, dtype=int), 1000, seed=0).ratio(top, bottom)
    assert (low[0], high[0]) == (1, 2)  # 2 / 2, 2 / 1, or a quarter of the draws 2 / 0, which says nothing
    assert np.isnan([low[1], high[1]]).all()


def test_paired_p_against_all_signs() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, 5, (2, 10, 6)).astype(float)
    second[:, 1] -= 2  # one pair that differs
    second[:, 2] = first[:, 2]
    resamples = 20_000
    p = LocationBootstrap(np.zeros(10, dtype=int), resamples, seed=0).paired_p(first - second)
    for column in range(6):
        exact = stats.permutation_test(
            (first[:, column], second[:, column]), lambda x, y, axis: np.sum(x - y, axis=axis),
            permutation_type="samples", vectorized=True, n_resamples=np.inf,
        ).pvalue  # fmt: skip
        error = np.sqrt(exact * (1 - exact) / resamples)
        assert p[column] == pytest.approx(exact, abs=4 * error + 1 / resamples)
    assert p[1] < 0.05
    assert p[2] == 1


def test_paired_p_of_many_locations_is_that_of_a_normal_sum() -> None:
    rng = np.random.default_rng(1)
    differences = rng.choice([-1.0, 0.0, 1.0], p=[0.2, 0.55, 0.25], size=(2000, 5))
    resamples = 5000
    p = LocationBootstrap(np.zeros(2000, dtype=int), resamples, seed=2).paired_p(differences)
    normal = 2 * stats.norm.sf(np.abs(differences.sum(0)) / np.sqrt((differences**2).sum(0)))
    assert np.all(np.abs(p - normal) < 4 * np.sqrt(normal * (1 - normal) / resamples) + 0.01)


def test_paired_p_is_never_zero_and_the_same_again() -> None:
    bootstrap = LocationBootstrap(np.zeros(300, dtype=int), 500, seed=0)
    assert bootstrap.paired_p(np.ones((300, 1)))[0] == 1 / 501
    differences = np.random.default_rng(0).normal(size=(300, 4))
    np.testing.assert_array_equal(bootstrap.paired_p(differences), bootstrap.paired_p(differences))
    np.testing.assert_array_equal(bootstrap.paired_p(-differences), bootstrap.paired_p(differences))
    assert np.isnan(LocationBootstrap(np.empty(0, dtype=int), 10, seed=0).paired_p(np.empty((0, 2)))).all()


def test_copies_of_a_location_in_its_block_tell_nothing_new() -> None:
    rng = np.random.default_rng(3)
    good = rng.random((80, 2))
    chosen = rng.integers(1, 4, (80, 1)).astype(float)
    scene = np.repeat([0, 1], 40)
    alone = LocationBootstrap(scene, 1000, 0)
    copies = np.repeat(np.arange(80), 3)
    together = LocationBootstrap(scene[copies], 1000, 0, copies % 40)  # numbers of blocks need not differ by scene
    np.testing.assert_allclose(together.ratio(good[copies], chosen[copies]), alone.ratio(good, chosen))
    np.testing.assert_allclose(together.paired_p(good[copies] - 0.5), alone.paired_p(good - 0.5))
    apart = LocationBootstrap(scene[copies], 1000, 0)
    narrow, wide = (np.subtract(*b.ratio(good[copies], chosen[copies])[::-1]) for b in (apart, together))
    np.testing.assert_allclose(wide / narrow, np.sqrt(3), rtol=0.15)


def test_one_block_has_no_interval() -> None:
    bootstrap = LocationBootstrap(np.zeros(5, int), 100, 0, np.full(5, 7))
    assert np.isnan(bootstrap.ratio(np.ones((5, 1)), np.ones((5, 1)))).all()
