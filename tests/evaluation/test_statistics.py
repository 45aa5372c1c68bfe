"""Reliability, calibration error and temperature against closed forms and scikit-learn."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats
from scipy.special import expit
from sklearn.calibration import calibration_curve
from sklearn.metrics import log_loss

from wheretolook.evaluation.statistics import (
    BINS,
    ClusterBootstrap,
    calibration_rows,
    expected_calibration_error,
    fit_temperature,
    negative_log_likelihood,
    reliability,
    scale_probability,
)


def draw(rng, probability):
    return rng.random(len(probability)) < probability


def test_calibration_error_by_hand():
    probability = np.array([0.0, 0.1, 0.25, 0.3, 1.0])
    good = np.array([False, True, True, False, True])
    assert list(reliability(probability, good, bins=4)["n"]) == [2, 2, 0, 1]
    # (2 x 0.45 + 2 x 0.225 + 0) / 5
    assert expected_calibration_error(probability, good, 4) == pytest.approx(0.27)


def test_reliability_is_that_of_scikit_learn(rng):
    probability = rng.beta(0.5, 0.7, 5000)
    good = draw(rng, probability**1.5)
    curve = reliability(probability, good)
    share, predicted = calibration_curve(good, probability, n_bins=BINS)
    assert_allclose(curve["share_good"], share)
    assert_allclose(curve["mean_predicted"], predicted)
    assert curve["n"].sum() == 5000
    assert negative_log_likelihood(probability, good) == pytest.approx(log_loss(good, probability))


@pytest.mark.parametrize("factor", [0.5, 1.0, 3.0])
def test_temperature_is_recovered(factor):
    rng = np.random.default_rng(2)
    logits = rng.normal(0.5, 2, 200_000)
    good = draw(rng, expit(logits))
    sure = expit(factor * logits)
    temperature = fit_temperature(sure, good)
    assert temperature == pytest.approx(factor, rel=0.02)
    scaled = scale_probability(sure, temperature)
    assert_allclose(scaled, expit(factor * logits / temperature), atol=1e-6)
    assert expected_calibration_error(scaled, good) < 0.01
    # where the likelihood is greatest its derivative by 1/T vanishes
    assert np.mean((scaled - good) * factor * logits) == pytest.approx(0, abs=1e-4)
    if factor != 1:
        assert expected_calibration_error(sure, good) > 0.04
        assert negative_log_likelihood(scaled, good) < negative_log_likelihood(sure, good)


def test_temperature_of_one_class_is_unknown():
    for labels in (np.ones(5, dtype=bool), np.zeros(5, dtype=bool), np.empty(0, dtype=bool)):
        assert np.isnan(fit_temperature(np.linspace(0, 1, len(labels)), labels))
    certain = np.array([0.0, 1.0, 1.0, 0.0])  # logits beyond all bounds
    assert 1 < fit_temperature(certain, np.array([False, True, False, True])) < np.inf
    assert np.isfinite(negative_log_likelihood(certain, np.array([True, False, True, False])))


def test_rows_before_and_after():
    rng = np.random.default_rng(3)
    logits = rng.normal(0, 2, 20_000)
    good = draw(rng, expit(logits))
    rows = calibration_rows(expit(2 * logits), good, 2.0).groupby("when")
    for when, probability in (("before", expit(2 * logits)), ("after", expit(logits))):
        part = rows.get_group(when)
        assert len(part) == BINS and part["n"].sum() == len(good)
        assert part["ece"].iloc[0] == pytest.approx(expected_calibration_error(probability, good), abs=1e-9)
        assert part["nll"].iloc[0] == pytest.approx(log_loss(good, probability))
    assert set(calibration_rows(expit(logits), good, np.nan)["when"]) == {"before"}


# Bootstrap intervals and paired tests against closed forms, brute force and SciPy.


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
    assert_allclose(clustered.ratio_interval(good[copies], chosen[copies]), single.ratio_interval(good, chosen))
    assert_allclose(clustered.paired_p(good[copies] - 0.5), single.paired_p(good - 0.5))
    narrow, wide = (np.subtract(*b.ratio_interval(good[copies], chosen[copies])) for b in (independent, clustered))
    assert_allclose(wide / narrow, np.sqrt(3), rtol=0.15)


def test_paired_p_is_that_of_all_sign_flips(rng):
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
