"""Sets of looks: what they see adds up, the choice is as good as the best of all sets, and limits on turning hold."""

from __future__ import annotations

from itertools import pairwise, permutations
from pathlib import Path

import numpy as np
import pytest

from selection.room import POINTS, WEIGHTS, write_room
from wheretolook import LocalizationMap, load_scorer
from wheretolook.geometry.lattices import direction_lattice
from wheretolook.geometry.poses import poses_looking_along, rotation_angle_deg, rotation_looking_along
from wheretolook.looks.around import best_looks, candidates
from wheretolook.looks.joint_visibility import SeenAround, log_position_variance, seen_around, union_plain
from wheretolook.looks.selection import (
    Turns,
    best_one_by_one,
    choose_exhaustively,
    choose_looks,
    evenly_spread,
    worth_of,
)
from wheretolook.looks.set_score import SetWorth, count_worth, fisher_worth
from wheretolook.scorers.base import Scorer
from wheretolook.utils.errors import ConfigError, PlanningError, WeightsError
from wheretolook_paper.fisher.exact import exact_information
from wheretolook_paper.scorers.expected import ExpectedScorer

AXES = direction_lattice(24)


@pytest.fixture(scope="module")
def scorer(tmp_path_factory: pytest.TempPathFactory) -> Scorer:
    return load_scorer(WEIGHTS, LocalizationMap.from_colmap(write_room(tmp_path_factory.mktemp("room") / "sparse")))


@pytest.fixture(scope="module")
def seen(scorer: Scorer) -> SeenAround:
    return seen_around(scorer, POINTS[0], AXES)


def some_seen(seed: int = 0, d: int = 9, u: int = 30) -> SeenAround:
    rng = np.random.default_rng(seed)
    chances = (rng.random((d, u)) * (rng.random((d, u)) < 0.4)).astype(np.float32)
    offsets = rng.normal(0, 2, (u, 3))
    from wheretolook.geometry.pose_information import bearing_numbers

    return SeenAround(
        chances, np.concatenate([np.ones((u, 1)), bearing_numbers(offsets)], 1), (chances > 0).sum(1), rng.random(d)
    )


def test_the_sums_of_a_set_are_those_added_landmark_by_landmark() -> None:
    seen = some_seen()
    for looks in ([0], [1, 4], [2, 3, 8], [0, 1, 2, 3, 4]):
        np.testing.assert_allclose(seen.union(looks), union_plain(seen, looks), rtol=1e-5, atol=1e-6)
    joined = seen.sums(seen.missed([1, 4]))
    for look in range(len(seen)):
        np.testing.assert_allclose(joined[look], seen.union([1, 4, look]), rtol=1e-4, atol=1e-4)
    assert (seen.union([1, 4, 4]) >= seen.union([1, 4]) - 1e-9)[0]


def test_a_set_of_one_is_what_the_scorer_tells_of_a_view(scorer: Scorer, seen: SeenAround) -> None:
    poses = poses_looking_along(np.tile(POINTS[0], (len(AXES), 1)), AXES)
    np.testing.assert_allclose(seen.sums()[:, 0], scorer.report(poses).expected_inliers, rtol=1e-5)
    expected = ExpectedScorer(scorer.localization_map, WEIGHTS / "matchability.safetensors", "inliers")
    np.testing.assert_allclose(
        seen_around(expected, POINTS[0], AXES).sums()[:, 0], expected.expected_inliers(poses), rtol=1e-4
    )


def test_where_every_landmark_in_view_counts_it_is_the_exact_information_of_the_rig(scorer: Scorer) -> None:
    """Two looks that share nothing have the sum of both views' exact Fisher information."""
    around = scorer.localization_map
    sure = seen_around(scorer, POINTS[0], AXES, sure=True)
    opposite = [0, int((AXES @ AXES[0]).argmin())]
    poses = poses_looking_along(np.tile(POINTS[0], (2, 1)), AXES[opposite])
    exact = exact_information(around._views(poses))
    np.testing.assert_allclose(sure.union(opposite)[1:], exact.sum(0), rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(sure.n_visible[opposite], np.diff(around.in_view_on_device(poses)[0]))


@pytest.mark.parametrize("worth", [SetWorth.shipped(), fisher_worth, count_worth])
def test_greedy_choice_with_exchange_is_nearly_the_best_of_all_sets(worth: object) -> None:
    for seed in range(6):
        seen = some_seen(seed)
        turns = Turns(AXES[:9])
        for n in (1, 2, 3):
            chosen = choose_looks(seen, worth, n, turns)  # type: ignore[arg-type]
            best = choose_exhaustively(seen, worth, n, turns)
            assert len({*chosen.looks}) == n
            failed = np.prod(1 - seen.alone[list(chosen.looks)], keepdims=True)
            assert best.worth - 1e-9 <= chosen.worth + 0.05 * abs(best.worth)
            assert chosen.worth == pytest.approx(
                float(worth(union_plain(seen, list(chosen.looks))[None], failed)[0]), rel=1e-4
            )  # type: ignore[operator]


def test_the_order_turns_least_and_keeps_the_limit(seen: SeenAround) -> None:
    rotations = rotation_looking_along(AXES)
    for start in (None, (0.3, -1.0, 0.1)):
        turns = Turns(AXES, start)

        def length(order: tuple[int, ...], start: tuple[float, ...] | None = start) -> float:
            legs = sum(rotation_angle_deg(rotations[a], rotations[b]) for a, b in pairwise(order))
            return float(legs) + (
                0.0 if start is None else float(rotation_angle_deg(rotations[order[0]], rotation_looking_along(start)))
            )

        for looks in ([3, 17], [1, 9, 20], [0, 5, 11, 23]):
            total, order = turns.shortest(looks)
            assert total == pytest.approx(min(map(length, permutations(looks)))) == pytest.approx(length(order))
            added = turns.with_one_more(looks)
            for one in (2, 14, 21):
                assert added[one] == pytest.approx(turns.shortest([*looks, one])[0])
        for limit in (120.0, 160.0, 250.0):
            chosen = choose_looks(seen, SetWorth.shipped(), 3, turns, limit)
            assert chosen.total_turn_deg <= limit + 1e-4
            assert chosen.total_turn_deg == pytest.approx(length(chosen.looks))
    with pytest.raises(PlanningError, match="no 3 looks"):
        choose_looks(seen, SetWorth.shipped(), 3, Turns(AXES), 5.0)


def test_more_looks_are_worth_more_and_the_first_is_the_best_alone(scorer: Scorer) -> None:
    axes = direction_lattice(200)
    scores = scorer.score_around(POINTS[:1], axes)[0]
    found = [best_looks(scorer, POINTS[0], axes, scores, n) for n in (1, 2, 3, 5)]
    assert found[0].looks == (int(scores.argmax()),)
    assert [*np.argsort([one.worth for one in found])] == [0, 1, 2, 3]
    near = best_looks(scorer, POINTS[0], axes, scores, 3, 50.0, start=axes[7])
    assert near.total_turn_deg <= 50 + 1e-4 and near.worth <= found[2].worth + 1e-6


def test_candidates_are_the_best_that_lie_apart() -> None:
    axes = direction_lattice(500)
    rng = np.random.default_rng(0)
    scores = rng.random(500)
    rows = candidates(axes, scores, 24)
    assert rows[0] == scores.argmax() and len(rows) == 24
    cosines = axes[rows] @ axes[rows].T - 2 * np.eye(24)
    assert cosines.max() < np.cos(np.radians(15))
    close = candidates(axes, scores, 24, 40.0, axes[100])
    assert (axes[close] @ axes[100]).min() > np.cos(np.radians(80.1)) and close[0] in np.flatnonzero(
        axes @ axes[100] > np.cos(np.radians(40.1))
    )


def test_baselines() -> None:
    axes = direction_lattice(100)
    scores = np.random.default_rng(1).random(100)
    looks = best_one_by_one(scores, axes, 4)
    assert looks[0] == scores.argmax() and (axes[looks] @ axes[looks].T - 2 * np.eye(4)).max() <= np.cos(np.radians(40))
    assert sorted(best_one_by_one(scores[:3], axes[:3], 3, 180.0)) == [0, 1, 2]
    spread = evenly_spread(axes, 2, looks[0])
    assert axes[spread[0]] @ axes[spread[1]] < -0.95


def test_bad_input_is_refused(seen: SeenAround, tmp_path: Path) -> None:
    turns = Turns(AXES)
    worth = SetWorth.shipped()
    for n in (0, 7):
        with pytest.raises(ConfigError, match="1 to 6 looks"):
            choose_looks(seen, worth, n, turns)
    with pytest.raises(ConfigError, match="limit on turning"):
        choose_looks(seen, worth, 2, turns, float("nan"))
    with pytest.raises(ConfigError, match="only 4 directions"):
        choose_looks(some_seen(d=4), worth, 5, Turns(AXES[:4]))
    for text in ("{", '{"weights": {}, "bias": 0}', '{"weights": [], "bias": "x"}'):
        (tmp_path / "worth.json").write_text(text)
        with pytest.raises(WeightsError, match="worth"):
            SetWorth.load(tmp_path / "worth.json")


def test_nothing_seen_leaves_the_variance_of_the_prior() -> None:
    """1 / 1e-3 in each of three coordinates."""
    np.testing.assert_allclose(log_position_variance(np.zeros((2, 16))), np.log(3000))


def test_a_second_look_elsewhere_is_worth_more_than_one_at_the_same() -> None:
    """Of equal scores, by the worth that ships."""
    seen = some_seen(u=60)
    same = SeenAround(np.repeat(seen.chances[:1], 3, axis=0), seen.told, seen.n_visible[:3], np.full(3, 0.3))
    same.chances[2] = seen.chances[0, ::-1]
    worth = SetWorth.shipped()
    assert worth_of(same, worth, [0, 2]) > worth_of(same, worth, [0, 1]) > worth_of(same, worth, [0])
