"""Numbers of a check against those of other implementations, and against ones worked out by hand."""

import numpy as np
import pandas as pd
import pytest
from scipy.stats import gmean
from sklearn.metrics import roc_auc_score

from wheretolook.evaluation.statistics import ClusterBootstrap, expected_calibration_error
from wheretolook.holdout.metrics import (
    RESAMPLES,
    error_of_calibrated,
    measure,
    places_of,
    regret_of_places,
    resampled_auc,
    resampled_calibration_error,
)


@pytest.fixture(scope="module")
def views():
    rng = np.random.default_rng(3)
    score = rng.random(300).round(2)  # with ties
    good = rng.random(300) < score
    visible = (100 * score + rng.normal(0, 30, 300)).round()
    return pd.DataFrame(
        {
            "score": score, "good": good, "visible": visible, "block": rng.integers(1, 9, 300), "in_range": True,
            "n_inliers": rng.integers(0, 50, 300), "expected_inliers": rng.uniform(5, 50, 300), "right_place": good,
            **{f"error_{unit}": np.where(good, rng.lognormal(-4, 1, 300), np.nan) for unit in ("m", "deg")},
            **{f"expected_error_{unit}": rng.lognormal(-4, 0.5, 300) for unit in ("m", "deg")},
        }
    )  # fmt: skip


def test_auc_is_that_of_scikit_learn_for_every_resample(views):
    bootstrap = ClusterBootstrap(views["block"].to_numpy(), resamples=20, seed=0)
    good = views["good"].to_numpy()
    score = views["score"].to_numpy()
    areas = resampled_auc(bootstrap, good, score)
    for times, area in zip(bootstrap.times, areas, strict=True):
        weights = times[bootstrap.cluster]
        assert area == pytest.approx(roc_auc_score(good, score, sample_weight=weights), abs=1e-12)


def test_auc_within_blocks_counts_pairs_of_one_block(views):
    good, score, block = (views[name].to_numpy() for name in ("good", "score", "block"))
    bootstrap = ClusterBootstrap(block, 10, seed=0)
    wins = pairs = 0.0
    for number in np.unique(block):
        mine = block == number
        n_pairs = int((good & mine).sum() * (~good & mine).sum())
        wins += roc_auc_score(good[mine], score[mine]) * n_pairs
        pairs += n_pairs
    shifted = score + 10 * block  # changes the order between blocks only
    assert resampled_auc(bootstrap, good, score, within=True)[0] == pytest.approx(wins / pairs)
    assert resampled_auc(bootstrap, good, shifted, within=True)[0] == pytest.approx(wins / pairs)
    assert resampled_auc(bootstrap, good, shifted)[0] < wins / pairs


def test_places_are_within_a_radius_and_a_block():
    centers = np.array([(0, 0, 0), (0.3, 0, 0), (0.8, 0, 0), (0, 0, 0)], dtype=float)
    place = places_of(centers, np.array([1, 1, 1, 2]), 0.5)
    assert place[0] == place[1] and len({place[0], place[2], place[3]}) == 3


def test_regret_is_of_places_where_another_view_was_better():
    place = np.array([0, 0, 1, 1, 2, 3, 3])
    good = np.array([True, False, True, False, True, False, False])
    rows, possible, chosen = regret_of_places(place, good, np.array([0.1, 0.9, 0.9, 0.1, 0.5, 0.2, 0.3]))
    assert rows.tolist() == [0, 2, 5]  # the third place has no choice
    assert possible.tolist() == [True, True, False] and chosen.tolist() == [False, True, False]


def test_measure_compares_methods(views):
    centers = np.random.default_rng(0).uniform(0, 2, (len(views), 3))
    numbers = measure(views, {"set": "score", "visible": "visible"}, centers, 0.5, True)
    good, score = (views[name].to_numpy() for name in ("good", "score"))
    mine, other = (numbers["methods"][name] for name in ("set", "visible"))
    assert mine["auc"]["value"] == pytest.approx(roc_auc_score(good, score))
    bootstrap = ClusterBootstrap(views["block"].to_numpy(), 10, seed=0)
    errors = resampled_calibration_error(bootstrap, score, good)
    assert errors[0] == pytest.approx(expected_calibration_error(score, good))
    assert mine["auc_above_visible"]["value"] == pytest.approx(mine["auc"]["value"] - other["auc"]["value"])
    inliers = views["n_inliers"].to_numpy() * good
    expected = views["expected_inliers"].to_numpy()
    ratio = numbers["inliers_found_over_expected"]
    assert ratio["all"]["value"] == pytest.approx(inliers.sum() / expected.sum())
    assert ratio["localized"]["value"] == pytest.approx(inliers.sum() / expected[good].sum())
    assert 0 < mine["regret"]["value"] < other["regret"]["value"] and numbers["n_places_of_both_kinds"] > 10


def test_errors_are_compared_at_the_right_place_alone(views):
    columns = {"set": "score", "visible": "visible"}
    found = measure(views, columns, np.zeros((300, 3)), 0.5, True)["errors_at_right_place"]["m"]
    right = views[views["good"]]
    ratios = right["error_m"] / right["expected_error_m"]
    assert found["n"] == len(right) and found["observed_90%"] == pytest.approx(right["error_m"].quantile(0.9))
    assert found["expected_50%"] == pytest.approx(right["expected_error_m"].median())
    assert found["ratio"]["value"] == pytest.approx(gmean(ratios))
    assert found["ratio"]["low"] < gmean(ratios) < found["ratio"]["high"]
    unknown = views.assign(expected_error_m=np.nan)  # of methods that predict no errors
    assert measure(unknown, columns, np.zeros((300, 3)), 0.5, True)["errors_at_right_place"] is None


def test_exact_probabilities_exceed_their_own_calibration_error_once_in_twenty():
    rng = np.random.default_rng(5)
    exceeded = []
    for _ in range(200):
        probability = rng.random(60)
        error = expected_calibration_error(probability, rng.random(60) < probability)
        exceeded.append(error > error_of_calibrated(probability))
    assert 0.02 <= np.mean(exceeded) <= 0.09


def test_where_all_localize_there_is_no_auc(views):
    found = measure(views.assign(good=True), {"set": "score", "visible": "visible"}, np.zeros((300, 3)), 0.5, True)
    assert found["methods"]["set"]["auc"] == {"value": None, "low": None, "high": None}
    assert found["methods"]["set"]["regret"]["value"] == 0


def test_few_blocks_have_wide_intervals(views):
    def error_of(blocks):
        part = views.assign(block=views["block"] % blocks)
        found = measure(part, {"set": "score", "visible": "visible"}, np.zeros((300, 3)), 0.5, True)["ece"]
        bootstrap = ClusterBootstrap(part["block"].to_numpy(), RESAMPLES, seed=0)
        errors = resampled_calibration_error(bootstrap, part["score"].to_numpy(), part["good"].to_numpy())
        return found["value"] - found["low"], found["high"] - found["value"], bootstrap.interval(errors)[1] - errors[0]

    below, above, resampled = error_of(3)
    # Student's 97.5 % quantiles of 2 and of 10 degrees of freedom
    assert above == pytest.approx(resampled * 4.3027 / 2.2281, rel=1e-3) and below >= 0
    one_bad = views.assign(good=np.arange(300) > 0, score=np.arange(300) / 300)
    found = measure(one_bad, {"set": "score", "visible": "visible"}, np.zeros((300, 3)), 0.5, True)
    assert found["methods"]["set"]["auc"] == {"value": 1.0, "low": 0.0, "high": 1.0}
