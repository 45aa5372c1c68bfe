"""Reliability, calibration error and temperature against closed forms and scikit-learn."""

import numpy as np
import pytest
from scipy.special import expit
from sklearn.calibration import calibration_curve
from sklearn.metrics import log_loss, precision_recall_curve

from wheretolook.evaluation.statistics import (
    BINS,
    calibration_rows,
    expected_calibration_error,
    fit_temperature,
    negative_log_likelihood,
    precision_area,
    precision_over_coverage,
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


def test_reliability_is_that_of_scikit_learn():
    rng = np.random.default_rng(0)
    probability = rng.beta(0.5, 0.7, 5000)
    good = draw(rng, probability**1.5)
    curve = reliability(probability, good)
    share, predicted = calibration_curve(good, probability, n_bins=BINS)
    np.testing.assert_allclose(curve["share_good"], share)
    np.testing.assert_allclose(curve["mean_predicted"], predicted)
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
    np.testing.assert_allclose(scaled, expit(factor * logits / temperature), atol=1e-6)
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


def test_precision_over_coverage():
    """Precision as scikit-learn's at each threshold, ties included; queries without a pose only lower the coverage."""
    rng = np.random.default_rng(4)
    confidence = rng.integers(0, 20, 200) / 20
    right = draw(rng, confidence)
    coverage, precision = precision_over_coverage(confidence, right)
    expected, _, thresholds = precision_recall_curve(right, confidence)
    at = dict(zip(thresholds, expected, strict=False))
    np.testing.assert_allclose(precision, [at[value] for value in np.sort(confidence)[::-1]])
    assert coverage[0] == 1 / 200 and coverage[-1] == 1
    with_missing = np.append(confidence, np.full(200, np.nan)), np.append(right, np.zeros(200, dtype=bool))
    assert precision_over_coverage(*with_missing)[0][-1] == 0.5
    assert precision_area(*with_missing) == pytest.approx(precision_area(confidence, right) / 2)


def test_area_of_a_perfect_order():
    """Of n poses k are right and all more confident: 1 up to k / n, then k / i."""
    right = np.arange(10) < 4
    expected = (4 + sum(4 / i for i in range(5, 11))) / 10
    assert precision_area(-np.arange(10.0), right) == pytest.approx(expected)
    assert precision_area(np.full(3, np.nan), np.zeros(3, dtype=bool)) == 0
