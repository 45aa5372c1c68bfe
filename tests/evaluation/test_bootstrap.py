"""Bootstrap intervals and paired tests against closed forms, brute force and SciPy."""

import numpy as np
import pytest
from scipy import stats

from wheretolook.evaluation.statistics import ClusterBootstrap


def test_interval_of_independent_observations_is_binomial():
    good = np.zeros((400, 1))
    good[:120] = 1
    low, high = ClusterBootstrap(np.arange(400), 4000, seed=0).ratio_interval(good, np.ones((400, 1)))
    error = np.sqrt(0.3 * 0.7 / 400)
    assert low[0] == pytest.approx(0.3 - 1.96 * error, abs=0.006)
    assert high[0] == pytest.approx(0.3 + 1.96 * error, abs=0.006)


def test_clusters_are_drawn_within_strata():
    stratum = np.repeat([0, 1], [30, 70])
    good = (stratum == 0).astype(float)[:, None]  # constant within a stratum
    low, high = ClusterBootstrap(np.arange(100), 500, 1, stratum).ratio_interval(good, np.ones((100, 1)))
    assert (low[0], high[0]) == (0.3, 0.3)


@pytest.mark.parametrize("clusters, strata", [(np.full(5, 7), None), (np.arange(2), np.arange(2))])
def test_no_interval_where_no_stratum_has_two_clusters(clusters, strata):
    ones = np.ones((len(clusters), 1))
    assert np.isnan(ClusterBootstrap(clusters, 100, 0, strata).ratio_interval(ones, ones)).all()


def test_resamples_without_a_denominator_do_not_count():
    top = np.array([[1.0, 0.0], [1.0, 0.0]])
    bottom = np.array([[1.0, 0.0], [0.0, 0.0]])
    low, high = ClusterBootstrap(np.arange(2), 1000, seed=0).ratio_interval(top, bottom)
    assert (low[0], high[0]) == (1, 2)  # 2 / 2, 2 / 1, or in a quarter of the draws 2 / 0
    assert np.isnan([low[1], high[1]]).all()


def test_copies_of_an_observation_in_its_cluster_change_nothing():
    rng = np.random.default_rng(3)
    good = rng.random((80, 2))
    chosen = rng.integers(1, 4, (80, 1)).astype(float)
    scene = np.repeat([0, 1], 40)
    single = ClusterBootstrap(np.arange(80), 1000, 0, scene)
    copies = np.repeat(np.arange(80), 3)
    clustered = ClusterBootstrap(copies % 40, 1000, 0, scene[copies])  # numbers may repeat in other strata
    independent = ClusterBootstrap(np.arange(240), 1000, 0, scene[copies])
    np.testing.assert_allclose(
        clustered.ratio_interval(good[copies], chosen[copies]), single.ratio_interval(good, chosen)
    )
    np.testing.assert_allclose(clustered.paired_p(good[copies] - 0.5), single.paired_p(good - 0.5))
    narrow, wide = (np.subtract(*b.ratio_interval(good[copies], chosen[copies])) for b in (independent, clustered))
    np.testing.assert_allclose(wide / narrow, np.sqrt(3), rtol=0.15)


def test_paired_p_is_that_of_all_sign_flips():
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, 5, (2, 10, 4)).astype(float)
    second[:, 1] -= 2  # different
    second[:, 2] = first[:, 2]
    resamples = 20_000
    p = ClusterBootstrap(np.arange(10), resamples, seed=0).paired_p(first - second)
    for column in range(4):
        exact = stats.permutation_test(
            (first[:, column], second[:, column]), lambda x, y, axis: np.sum(x - y, axis=axis),
            permutation_type="samples", vectorized=True, n_resamples=np.inf,
        ).pvalue  # fmt: skip
        error = np.sqrt(exact * (1 - exact) / resamples)
        assert p[column] == pytest.approx(exact, abs=4 * error + 1 / resamples)
    assert p[1] < 0.05
    assert p[2] == 1


def test_paired_p_is_never_zero():
    bootstrap = ClusterBootstrap(np.arange(300), 500, seed=0)
    assert bootstrap.paired_p(np.ones((300, 1)))[0] == 1 / 501
    assert np.isnan(ClusterBootstrap(np.empty(0, dtype=int), 10, seed=0).paired_p(np.empty((0, 2)))).all()
