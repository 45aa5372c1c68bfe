"""Numbers of a check against those of other implementations, and against ones worked out by hand."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from sklearn.metrics import roc_auc_score

from wheretolook.evaluation.calibration import expected_calibration_error
from wheretolook.holdout.metrics import BlockResamples, measure, places_of, regret_of_places


@pytest.fixture(scope="module")
def views() -> pd.DataFrame:
    rng = np.random.default_rng(3)
    score = rng.random(300).round(2)  # with ties
    good = rng.random(300) < score
    visible = (100 * score + rng.normal(0, 30, 300)).round()
    return pd.DataFrame(
        {
            "score": score, "good": good, "visible": visible, "block": rng.integers(1, 9, 300), "in_range": True,
            "n_inliers": rng.integers(0, 50, 300), "expected_inliers": rng.uniform(5, 50, 300),
        }
    )  # fmt: skip


def test_auc_is_that_of_scikit_learn_for_every_resample(views: pd.DataFrame) -> None:
    resamples = BlockResamples(views["block"].to_numpy(), resamples=20)
    good = views["good"].to_numpy()
    score = views["score"].to_numpy()
    found = resamples.auc(good, score)
    assert found[0] == pytest.approx(roc_auc_score(good, score), abs=1e-12)
    for times, value in zip(resamples.times[1:], found[1:], strict=True):
        weights = times[resamples.row]
        assert value == pytest.approx(roc_auc_score(good, score, sample_weight=weights), abs=1e-12)


def test_auc_within_blocks_takes_pairs_of_one_block_only(views: pd.DataFrame) -> None:
    good, score, block = (views[name].to_numpy() for name in ("good", "score", "block"))
    wins = pairs = 0.0
    for number in np.unique(block):
        mine = block == number
        n_pairs = int((good & mine).sum() * (~good & mine).sum())
        wins += roc_auc_score(good[mine], score[mine]) * n_pairs
        pairs += n_pairs
    assert BlockResamples(block).auc(good, score, within=True)[0] == pytest.approx(wins / pairs)
    # shifting the scores of whole blocks changes what is between blocks, not what is within
    shifted = score + 10 * block
    assert BlockResamples(block).auc(good, shifted, within=True)[0] == pytest.approx(wins / pairs)
    assert BlockResamples(block).auc(good, shifted)[0] < wins / pairs


def test_calibration_error_is_that_of_evaluations(views: pd.DataFrame) -> None:
    score = views["score"].to_numpy()
    good = views["good"].to_numpy()
    found = BlockResamples(views["block"].to_numpy()).calibration_error(score, good)
    assert found.value == pytest.approx(expected_calibration_error(score, good))
    assert found.low < found.value < found.high + 0.02


def test_intervals_are_as_wide_as_blocks_differ() -> None:
    block = np.repeat(np.arange(10), 20)
    resamples = BlockResamples(block)
    same = resamples.ratio(np.tile([1.0, 0.0], 100), np.ones(200))
    assert (same.value, same.low, same.high) == (0.5, 0.5, 0.5)
    apart = resamples.ratio((block < 5).astype(float), np.ones(200))
    # the mean of ten fair draws: binomial, whose 2.5 % points are 0.2 and 0.8
    assert apart.value == 0.5 and apart.low == pytest.approx(0.2) and apart.high == pytest.approx(0.8)


def test_one_block_has_no_interval() -> None:
    found = BlockResamples(np.ones(4, dtype=int)).ratio(np.ones(4), np.full(4, 2.0))
    assert found.value == 0.5 and np.isnan([found.low, found.high]).all()


def test_places_are_within_a_radius_and_a_block() -> None:
    centers = np.array([(0, 0, 0), (0.3, 0, 0), (0.8, 0, 0), (0, 0, 0)], dtype=float)
    place = places_of(centers, np.array([1, 1, 1, 2]), 0.5)
    assert place[0] == place[1] and len({place[0], place[2], place[3]}) == 3


def test_regret_is_of_places_where_another_view_was_better() -> None:
    place = np.array([0, 0, 1, 1, 2, 3, 3])
    good = np.array([True, False, True, False, True, False, False])
    rows, possible, chosen = regret_of_places(place, good, np.array([0.1, 0.9, 0.9, 0.1, 0.5, 0.2, 0.3]))
    assert rows.tolist() == [0, 2, 5]  # the third place has no choice
    assert possible.tolist() == [True, True, False] and chosen.tolist() == [False, True, False]


def test_measure_tells_methods_apart(views: pd.DataFrame) -> None:
    centers = np.random.default_rng(0).uniform(0, 2, (len(views), 3))
    found = measure(views, ["set", "visible"], ["score", "visible"], centers, 0.5, True)
    good = views["good"].to_numpy()
    score = views["score"].to_numpy()
    mine = found["methods"]["set"]
    other = found["methods"]["visible"]
    assert mine["auc"]["value"] == pytest.approx(roc_auc_score(good, score))
    assert mine["auc_above_visible"]["value"] == pytest.approx(mine["auc"]["value"] - other["auc"]["value"])
    assert other["auc_above_visible"] == {"value": 0.0, "low": 0.0, "high": 0.0}
    inliers = views["n_inliers"].to_numpy() * good
    expected = views["expected_inliers"].to_numpy()
    ratio = found["inliers_found_over_expected"]
    assert ratio["all"]["value"] == pytest.approx(inliers.sum() / expected.sum())
    assert ratio["localized"]["value"] == pytest.approx(inliers.sum() / expected[good].sum())
    assert 0 < mine["regret"]["value"] < other["regret"]["value"] and found["n_places_of_both_kinds"] > 10


def test_where_all_localize_there_is_no_auc(views: pd.DataFrame) -> None:
    found = measure(views.assign(good=True), ["set", "visible"], ["score", "visible"], np.zeros((300, 3)), 0.5, True)
    assert found["methods"]["set"]["auc"] == {"value": None, "low": None, "high": None}
    assert found["methods"]["set"]["regret"]["value"] == 0
