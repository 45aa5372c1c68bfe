"""A simulated camera that turns until it is localized: the summary of its poses."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from sklearn.metrics import precision_recall_curve

from wheretolook_paper.relocalization import precision_area, precision_over_coverage, summarize, summary_markdown
from wheretolook_paper.studies.fit_confidence import fit, is_within, predict


def poses_of(policy, place, good, confidence):
    """A place's chosen poses after each view, and a rival of each."""
    errors = [0.01 if right else 3.0 for right in good]
    chosen = pd.DataFrame(
        {"n_looks": range(1, len(good) + 1), "error_m": errors, "confidence": confidence, "hypothesis": 0}
    )
    both = pd.concat([chosen, chosen.assign(hypothesis=1, error_m=9.0, confidence=0.99)])
    return both.assign(scene="a", location_id=place, policy=policy, status="localized", error_deg=0.1)


def test_a_camera_stops_at_its_confidence_or_after_the_last_view():
    table = pd.concat(
        [
            poses_of("gain", 0, [False, True, True], [0.1, 0.96, 0.5]),  # stops after two, right
            poses_of("gain", 1, [False, False, True], [0.97, 0.99, 0.99]),  # stops after one, wrong
            poses_of("gain", 2, [False, True, True], [0.0, 0.2, 0.3]),  # never confident, right in the end
            poses_of("gain", 3, [True, True, False], [0.9, 0.9, 0.98]),  # confident at last, wrong
            poses_of("even", 0, [True, True, True], [0.99, 0.99, 0.99]),
        ],
        ignore_index=True,
    )
    summary = summarize(table, 0.95).set_index("policy")
    gain = summary.loc["gain"]
    assert gain["right_1"] == 0.25 and gain["right_2"] == gain["right_3"] == 0.75
    assert gain["views"] == (2 + 1 + 3 + 3) / 4 and gain["right"] == 0.5
    assert gain["confident"] == 0.75 and gain["precision"] == pytest.approx(1 / 3)
    assert gain["precision_area"] == pytest.approx((1 + 1 / 2 + 2 / 3 + 3 / 4) / 4)  # right, wrong, right, right
    assert gain["right_2_low"] <= 0.75 <= gain["right_2_high"]
    assert summary.loc["even", "views"] == 1 and summary.loc["even", "precision"] == 1
    assert "| gain   | 4" in summary_markdown(summary.reset_index(), 0.95)


def test_a_fit_recovers_the_distribution_of_errors():
    rng = np.random.default_rng(0)
    n = 4000
    place = rng.random(n) < 0.6
    deviation = np.exp(rng.normal(-4, 1, n))
    error = np.where(place, np.exp(1.1 * np.log(deviation) + 0.2 + rng.normal(0, 0.7, n)), 5.0)
    poses = pd.DataFrame({"n_inliers": 100, "n_matches": 200, "elsewhere": np.where(place, 5, 50), "own": 30})
    poses["rival_own"] = np.where(rng.random(n) < 0.9, np.where(place, 1, 40), 15)
    poses = poses.assign(deviation_m=deviation, deviation_deg=10 * deviation, error_m=error, error_deg=5 * error)
    model = fit(poses)
    near = place & (error < 0.5)
    assert model.errors[0].slope == pytest.approx(1.1, abs=0.05) and model.errors[0].deviation == pytest.approx(
        0.7, abs=0.05
    )
    found = predict(model, poses, (0.03, 0.3))
    assert found.mean() == pytest.approx(is_within(poses, (0.03, 0.3)).mean(), abs=0.02)
    assert predict(model, poses, (0.5, 5.0)).mean() == pytest.approx(near.mean(), abs=0.03)


def test_precision_over_coverage():
    """Precision as scikit-learn's at each threshold, ties included; queries without a pose only lower the coverage."""
    rng = np.random.default_rng(4)
    confidence = rng.integers(0, 20, 200) / 20
    right = rng.random(200) < confidence
    coverage, precision = precision_over_coverage(confidence, right)
    expected, _, thresholds = precision_recall_curve(right, confidence)
    at = dict(zip(thresholds, expected, strict=False))
    assert_allclose(precision, [at[value] for value in np.sort(confidence)[::-1]])
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
