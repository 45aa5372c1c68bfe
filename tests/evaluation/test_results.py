"""Choice of views, oracle, expectation of random choice and the table, by hand and by brute force."""

from itertools import combinations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from synthetic_scores import KEYS, make_scores
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.ranking import choose_at_random, choose_best, rank_views
from wheretolook.evaluation.results import best_in_words, reference_method, score_table, threshold_keys
from wheretolook.geometry.views import Views
from wheretolook.utils.errors import ConfigError

LOCATION = np.array([2, 0, 0, 1, 0, 2, 0, 2])
HAND = Views(
    np.zeros((8, 3, 4)),
    # location 0 has four views, location 1 has one, location 2 has three, in mixed order
    waypoint=LOCATION,
    viewpoint_id=np.array([5, 12, 11, 9, 10, 6, 13, 7]),
    good=np.array([[1, 1], [0, 1], [1, 1], [0, 0], [0, 0], [0, 1], [1, 1], [0, 0]], dtype=bool),
    scene=np.array([0, 0, 1])[LOCATION],
    block=LOCATION,
)
HAND_SCORES = np.array([0.2, 0.9, 0.5, 0.1, 0.5, 0.2, 0.4, 0.9])


@pytest.mark.parametrize(
    ("n", "chosen", "good"),
    [
        # location 0 by score: 12 (0.9), then 10 before 11 (0.5 each, lower id first), 13
        # location 2 by score: 7 (0.9), then 5 before 6 (0.2 each)
        (1, [1, 1, 1], [[0, 1], [0, 0], [0, 0]]),
        (2, [2, 1, 2], [[0, 1], [0, 0], [1, 1]]),
        (3, [3, 1, 3], [[1, 2], [0, 0], [1, 2]]),
        (9, [4, 1, 3], [[2, 3], [0, 0], [1, 2]]),
    ],
)
def test_best_views_by_hand(n, chosen, good):
    top = choose_best(HAND, rank_views(HAND, HAND_SCORES), n)
    assert_array_equal(top.chosen, chosen)
    assert_array_equal(top.good, good)
    assert_array_equal(top.any_good, np.array(good) > 0)


@pytest.mark.parametrize("n", [1, 2, 3, 9])
def test_random_choice_by_enumeration(n):
    top = choose_at_random(HAND, n)
    for location in range(3):
        good = HAND.good[HAND.waypoint == location]
        draws = [good[list(rows)] for rows in combinations(range(len(good)), min(n, len(good)))]
        assert_allclose(top.good[location], np.mean([draw.sum(0) for draw in draws], axis=0))
        assert_allclose(top.any_good[location], np.mean([draw.any(0) for draw in draws], axis=0), atol=1e-12)


def test_table_by_hand():
    config = EvaluateConfig(methods=("bins",), top_n=(1, 3), thresholds=((0.05, 0.4), (5.0, 10.0)), resamples=200)
    table = score_table(HAND, {"bins": HAND_SCORES}, ["a", "b"], config)
    row = {(r["method"], r["top_n"], r["scene"]): r for r in table.to_dict("records")}

    top1 = row["bins", 1, "all"]
    assert (top1["n_locations"], top1["n_views"]) == (3, 3)
    assert top1["raw_0.05m_0.4deg"] == 0
    assert top1["raw_5m_10deg"] == pytest.approx(1 / 3)
    assert top1["normalized_5m_10deg"] == pytest.approx(1 / 2)

    top3 = row["bins", 3, "all"]
    assert top3["n_views"] == 3 + 1 + 3
    assert top3["raw_0.05m_0.4deg"] == pytest.approx(2 / 7)
    assert top3["normalized_0.05m_0.4deg"] == pytest.approx(2 / 3)
    assert top3["any_0.05m_0.4deg"] == pytest.approx(2 / 3)
    assert row["oracle", 3, "all"]["raw_5m_10deg"] == pytest.approx(5 / 7)

    # scores of the good views: 0.2, 0.5, 0.4; of the others: 0.9, 0.1, 0.5, 0.2, 0.9
    pairs = [0.5 if good == bad else good > bad for good in (0.2, 0.5, 0.4) for bad in (0.9, 0.1, 0.5, 0.2, 0.9)]
    assert top1["roc_auc"] == pytest.approx(np.mean(pairs))
    # precision and gain in recall at the scores 0.5, 0.4 and 0.2
    assert top1["average_precision"] == pytest.approx((1 / 4 + 2 / 5 + 3 / 7) / 3)


def test_shares_by_both_localizers_by_hand():
    """The two columns are one threshold by several hypotheses, and by the first RANSAC result."""
    config = EvaluateConfig(methods=("bins",), top_n=(1, 3), thresholds=((5.0, 10.0),), resamples=20)
    table = score_table(HAND, {"bins": HAND_SCORES}, ["a", "b"], config)
    pooled = table[table["scene"] == "all"].set_index(["method", "top_n"])
    names = ["raw_5m_10deg", "first_raw_5m_10deg"]
    assert pooled.loc[("bins", 3), names].tolist() == pytest.approx([2 / 7, 4 / 7])
    assert pooled.loc[("oracle", 3), names].tolist() == pytest.approx([3 / 7, 5 / 7])
    assert threshold_keys(table) == ["5m_10deg"]


def test_regret_and_difference_by_hand():
    # location 0: 11, 13, 12, 10; location 2: 6, 7, 5
    reference = np.array([0.1, 0.3, 0.9, 0.5, 0.2, 0.8, 0.6, 0.4])
    scores = {"random": np.zeros(8), "bins": HAND_SCORES, "mlp-2d": reference}
    config = EvaluateConfig(top_n=(1, 3), thresholds=((0.05, 0.4), (5.0, 10.0)), resamples=2000)
    table = score_table(HAND, scores, ["a", "b"], config)
    row = {(r["method"], r["top_n"], r["scene"]): r for r in table.to_dict("records")}
    fine = "0.05m_0.4deg"
    coarse = "5m_10deg"
    for key, good, regret, difference in (
        # the best of bins are 12, 9, 7, those of the reference 11, 9, 6
        (("bins", 1, "all"), (0, 1), (2 / 3, 1 / 3), (-1 / 3, -1 / 3)),
        # three of each: bins 12, 10, 11, 9, 7, 5, 6; the reference 11, 13, 12, 9, 6, 7, 5
        (("bins", 3, "all"), (2, 4), (1 / 7, 1 / 7), (-1 / 7, -1 / 7)),
        # at random, 2 and 3 of 4 views of location 0 are good, and 1 and 2 of 3 of location 2
        (("random", 1, "all"), (1 / 2 + 1 / 3, 3 / 4 + 2 / 3), (7 / 18, 7 / 36), (-1 / 18, -7 / 36)),
        (("bins", 1, "b"), (0, 0), (1, 1), (0, -1)),  # location 2 alone
    ):
        for name, expected in (("good", good), ("regret", regret), ("difference", difference)):
            assert [row[key][f"{name}_{threshold}"] for threshold in (fine, coarse)] == pytest.approx(expected)
    bins = row["bins", 1, "all"]
    # within scene a locations 0 and 1 are resampled: each twice in a quarter of the draws
    assert (bins[f"regret_low_{fine}"], bins[f"regret_high_{fine}"]) == pytest.approx((1 / 3, 1))
    assert (bins[f"difference_low_{fine}"], bins[f"difference_high_{fine}"]) == pytest.approx((-2 / 3, 0))
    assert bins[f"p_{fine}"] == 1  # one location that differs may as well differ the other way
    assert bins[f"released_{coarse}"] == pytest.approx(1 / 3 / 0.527)


def test_reference_method():
    methods = ["random", "mlp-2d", "mlp-2d+3d", "visible"]
    assert reference_method(methods, "") == "mlp-2d+3d"
    assert reference_method(methods[:1], "") == ""
    assert reference_method(methods, "random") == "random"
    with pytest.raises(ConfigError):
        reference_method(methods, "mlp-2d+z")


def test_a_scene_without_candidates_has_no_shares():
    config = EvaluateConfig(top_n=(1,), thresholds=((0.05, 0.4), (5.0, 10.0)), resamples=50)
    in_a = HAND.waypoint < 2
    rows = score_table(HAND[in_a], {"mlp-2d": HAND_SCORES[in_a]}, ["a", "b"], config)
    rows = rows.set_index(["method", "scene"]).loc["mlp-2d"]
    assert rows.loc["b", "n_locations"] == 0 and np.isnan(rows.loc["b", "regret_5m_10deg"])
    assert rows.loc["all", "raw_5m_10deg"] == rows.loc["a", "raw_5m_10deg"] == 1 / 2


def test_calibration_columns_of_learned_methods():
    # predicted 0.8 for all, of which 3 in 8 are good; at temperature 2 it says sigmoid(log(4) / 2) = 2/3
    config = EvaluateConfig(top_n=(1,), thresholds=((0.05, 0.4), (5.0, 10.0)), resamples=10)
    scores = dict.fromkeys(("bins", "mlp-2d"), np.full(8, 0.8))
    table = score_table(HAND, scores, ["a", "b"], config, temperatures={"mlp-2d": 2.0})
    rows = table.set_index(["method", "scene"])[["ece", "ece_scaled", "temperature"]]
    assert_allclose(rows.loc[("mlp-2d", "all")], [0.8 - 3 / 8, 2 / 3 - 3 / 8, 2])
    assert_allclose(rows.loc[("mlp-2d", "b")], [0.8 - 1 / 3, 2 / 3 - 1 / 3, 2])
    assert rows.loc[["bins", "oracle"]].isna().all(axis=None)


# Which methods chose best, in words.


@pytest.mark.parametrize("reference", ["", "bins", "visible"])
@pytest.mark.parametrize("good, significant", [(0.62, False), (0.8, True)])
def test_summary_of_significance(reference, good, significant):
    """Against visible, whose share is 0.6; intervals reach 6 points, those of differences 3."""
    table = make_scores(("random", "bins", "visible"), reference or None, (1,), ("a",)).assign(reference=reference)
    shares = table["method"].map({"random": 0.4, "bins": good, "visible": 0.6, "oracle": 0.9})
    difference = shares - {"": np.nan, "bins": good, "visible": 0.6}[reference]
    for name, values, width in (("raw", shares, 0.06), ("difference", difference, 0.03)):
        table[f"{name}_{KEYS[0]}"] = values
        table[f"{name}_low_{KEYS[0]}"] = values - width
        table[f"{name}_high_{KEYS[0]}"] = values + width
    assert ("significantly better" in best_in_words(table)) == significant
