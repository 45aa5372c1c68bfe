"""Choice of views, oracle, expectation of random choice and bootstrap, by hand and by brute force."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from wheretolook.evaluation.bootstrap import LocationBootstrap
from wheretolook.evaluation.config import EvaluateConfig, threshold_key, threshold_label
from wheretolook.evaluation.ranking import TestViews, choose_at_random, choose_best, choose_by_truth
from wheretolook.evaluation.scores import score_table

HAND = TestViews(
    # location 0 has four views, location 1 has one, location 2 has three, in mixed order
    location=np.array([2, 0, 0, 1, 0, 2, 0, 2]),
    viewpoint_id=np.array([5, 12, 11, 9, 10, 6, 13, 7]),
    good=np.array([[1, 1], [0, 1], [1, 1], [0, 0], [0, 0], [0, 1], [1, 1], [0, 0]], dtype=bool),
    location_scene=np.array([0, 0, 1]),
)
HAND_SCORES = np.array([0.2, 0.9, 0.5, 0.1, 0.5, 0.2, 0.4, 0.9])


def random_views(rng: np.random.Generator, n_locations: int = 40) -> TestViews:
    location = np.repeat(np.arange(n_locations), rng.integers(1, 15, n_locations))
    order = rng.permutation(len(location))
    quality = rng.random(len(location))
    good = quality[:, None] < [0.3, 0.5]
    scene = np.sort(rng.integers(0, 3, n_locations))
    return TestViews(location[order], np.arange(len(location))[order], good[order], scene)


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
def test_best_views_by_hand(n: int, chosen: list[int], good: list[list[int]]) -> None:
    top = choose_best(HAND, HAND_SCORES, n)
    np.testing.assert_array_equal(top.chosen, chosen)
    np.testing.assert_array_equal(top.good, good)
    np.testing.assert_array_equal(top.any_good, np.array(good) > 0)


def test_ties_do_not_depend_on_the_order_of_rows() -> None:
    rng = np.random.default_rng(0)
    order = rng.permutation(len(HAND.location))
    shuffled = TestViews(HAND.location[order], HAND.viewpoint_id[order], HAND.good[order], HAND.location_scene)
    for n in (1, 2, 3):
        for scores in (HAND_SCORES, np.zeros(8)):
            expected = choose_best(HAND, scores, n).good
            np.testing.assert_array_equal(choose_best(shuffled, scores[order], n).good, expected)


def test_oracle_by_hand() -> None:
    np.testing.assert_array_equal(choose_by_truth(HAND, 1).good, [[1, 1], [0, 0], [1, 1]])
    np.testing.assert_array_equal(choose_by_truth(HAND, 2).good, [[2, 2], [0, 0], [1, 2]])


@pytest.mark.parametrize("seed", range(5))
def test_nothing_beats_the_oracle(seed: int) -> None:
    rng = np.random.default_rng(seed)
    views = random_views(rng)
    for n in (1, 2, 5, 20):
        oracle = choose_by_truth(views, n).good
        truth = choose_best(views, views.good.sum(1).astype(float), n).good
        np.testing.assert_array_equal(truth, oracle)  # nested thresholds: one order is best by all of them
        assert np.all(choose_best(views, rng.random(len(views.location)), n).good <= oracle)
        assert np.all(choose_at_random(views, n).good <= oracle + 1e-12)


@pytest.mark.parametrize("n", [1, 2, 3, 9])
def test_random_choice_by_enumeration(n: int) -> None:
    top = choose_at_random(HAND, n)
    for location in range(3):
        good = HAND.good[HAND.location == location]
        draws = [good[list(rows)] for rows in combinations(range(len(good)), min(n, len(good)))]
        np.testing.assert_allclose(top.good[location], np.mean([draw.sum(0) for draw in draws], axis=0))
        np.testing.assert_allclose(top.any_good[location], np.mean([draw.any(0) for draw in draws], axis=0), atol=1e-12)


def test_table_by_hand() -> None:
    config = EvaluateConfig(methods=("bins",), top_n=(1, 3), thresholds=((0.05, 0.4), (5.0, 10.0)), resamples=200)
    table = score_table(HAND, {("bins", ""): HAND_SCORES}, ["a", "b"], config)
    assert len(table) == 2 * 2 * 3  # methods (with the oracle) x N x scenes (with all)
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
    assert row["bins", 3, "b"]["raw_5m_10deg"] == pytest.approx(2 / 3)
    assert row["bins", 3, "a"]["n_views"] == 4

    # scores of the good views: 0.2, 0.5, 0.4; of the others: 0.9, 0.1, 0.5, 0.2, 0.9
    pairs = [0.5 if good == bad else good > bad for good in (0.2, 0.5, 0.4) for bad in (0.9, 0.1, 0.5, 0.2, 0.9)]
    assert top1["roc_auc"] == pytest.approx(np.mean(pairs))
    # precision and gain in recall at the scores 0.5, 0.4 and 0.2
    assert top1["average_precision"] == pytest.approx((1 / 4 + 2 / 5 + 3 / 7) / 3)


def test_without_a_good_view_shares_are_zero_and_quotients_unknown() -> None:
    views = TestViews(np.array([0, 0, 1]), np.arange(3), np.zeros((3, 4), dtype=bool), np.array([0, 0]))
    table = score_table(views, {("bins", ""): np.arange(3.0)}, ["a"], EvaluateConfig(resamples=10))
    assert (table["raw_0.05m_0.4deg"] == 0).all()
    assert table["normalized_0.05m_0.4deg"].isna().all()
    assert table[table["method"] == "bins"][["average_precision", "roc_auc"]].isna().all(axis=None)


def test_scores_that_know_nothing_do_as_random_choice() -> None:
    rng = np.random.default_rng(0)
    views = random_views(rng, 3000)
    config = EvaluateConfig(resamples=200)
    scores = {("random", ""): rng.random(len(views.location)), ("mlp", "2d"): rng.random(len(views.location))}
    table = score_table(TestViews(views.location, views.viewpoint_id, views.good.repeat(2, 1), views.location_scene),
                        scores, ["a", "b", "c"], config)  # fmt: skip
    pooled = table[table["scene"] == "all"].set_index(["method", "top_n"])
    for n in config.top_n:
        drawn, exact = pooled.loc[("mlp", n)], pooled.loc[("random", n)]
        assert drawn["raw_0.05m_0.4deg"] == pytest.approx(exact["raw_0.05m_0.4deg"], abs=0.03)
        assert drawn["any_0.05m_0.4deg"] == pytest.approx(exact["any_0.05m_0.4deg"], abs=0.03)
    assert pooled.loc[("mlp", 1)]["roc_auc"] == pytest.approx(0.5, abs=0.02)
    assert pooled.loc[("mlp", 1)]["average_precision"] == pytest.approx(views.good[:, 0].mean(), abs=0.02)


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


def test_threshold_names() -> None:
    assert [threshold_key(limits) for limits in EvaluateConfig().thresholds] == [
        "0.05m_0.4deg",
        "0.25m_2deg",
        "0.5m_5deg",
        "5m_10deg",
    ]
    assert threshold_label("0.05m_0.4deg") == "5 cm, 0.4°"
    assert threshold_label("5m_10deg") == "5 m, 10°"
