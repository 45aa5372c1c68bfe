"""Joint sums of views from one location, and the selection of sets of views."""

from itertools import pairwise, permutations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from selection.room import POINTS, WEIGHTS, write_room
from twins.looks import best_of_all_sets, joint_sums
from wheretolook import LocalizationMap, load_scorer
from wheretolook.geometry.lattices import direction_lattice
from wheretolook.geometry.pose_information import bearing_numbers
from wheretolook.geometry.poses import poses_looking_along, rotation_angle_deg, rotation_looking_along
from wheretolook.looks.selection import (
    Detections,
    Rotations,
    SetScoreModel,
    best_views,
    candidate_views,
    candidates,
    log_position_variance,
    score_of_set,
    select_views,
)
from wheretolook.utils.errors import ConfigError, PlanningError

AXES = direction_lattice(24)
MODEL = SetScoreModel.bundled()


@pytest.fixture(scope="module")
def scorer(tmp_path_factory):
    return load_scorer(LocalizationMap.from_colmap(write_room(tmp_path_factory.mktemp("room") / "sparse")), WEIGHTS)


@pytest.fixture(scope="module")
def views(scorer):
    return candidate_views(scorer, POINTS[0], AXES)


def random_views(seed=0, d=9, u=30):
    rng = np.random.default_rng(seed)
    p_detect = (rng.random((d, u)) * (rng.random((d, u)) < 0.4)).astype(np.float32)
    terms = np.concatenate([np.ones((u, 1)), bearing_numbers(rng.normal(0, 2, (u, 3)))], 1)
    return Detections(p_detect, terms, (p_detect > 0).sum(1), rng.random(d))


def test_sums_of_a_set():
    views = random_views()
    for rows in ([0], [1, 4], [2, 3, 8]):
        assert_allclose(views.joint_sums(rows), joint_sums(views, rows), rtol=1e-5, atol=1e-6)
    with_each = views.sums_with_each([1, 4])
    for row in range(len(views)):
        assert_allclose(with_each[row], views.joint_sums([1, 4, row]), rtol=1e-4, atol=1e-4)
    assert_allclose(log_position_variance(np.zeros((2, 16))), np.log(3 / 1e-3))  # the prior alone


def test_a_single_view_is_expected_to_detect_what_the_scorer_reports(scorer, views):
    poses = poses_looking_along(np.tile(POINTS[0], (len(AXES), 1)), AXES)
    assert_allclose(views.sums_with_each()[:, 0], scorer.report(poses).expected_inliers, rtol=1e-5)


def test_certain_detection_gives_the_exact_information_of_two_opposite_views(scorer):
    certain = candidate_views(scorer, POINTS[0], AXES, certain=True)
    opposite = [0, int((AXES @ AXES[0]).argmin())]
    poses = poses_looking_along(np.tile(POINTS[0], (2, 1)), AXES[opposite])
    seen = scorer.localization_map.landmarks_in_view(poses)
    offsets = scorer.localization_map.landmarks.points[np.concatenate([seen[0], seen[1]])] - POINTS[0]
    assert_allclose(certain.joint_sums(opposite)[1:], bearing_numbers(offsets).sum(0), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("set_score", [MODEL, lambda sums, p_none: np.asarray(sums)[..., 0]])
def test_greedy_selection_with_exchange_is_near_the_best_of_all_sets(set_score):
    rotations = Rotations(AXES[:9])
    for seed in range(3):
        views = random_views(seed)
        for n in (1, 2, 3):
            chosen = select_views(views, set_score, n, rotations)
            best = best_of_all_sets(views, set_score, n, rotations)
            assert len({*chosen.rows}) == n
            assert best.score - 1e-9 <= chosen.score + 0.05 * abs(best.score)


@pytest.mark.parametrize("start", [None, (0.3, -1.0, 0.1)])
def test_the_order_is_of_least_rotation_and_within_the_limit(views, start):
    rotations = Rotations(AXES, start)
    matrices = rotation_looking_along(AXES)

    def length(order):
        legs = sum(float(rotation_angle_deg(matrices[a], matrices[b])) for a, b in pairwise(order))
        first = 0.0 if start is None else rotation_angle_deg(matrices[order[0]], rotation_looking_along(start))
        return legs + float(first)

    for rows in ([3, 17], [0, 5, 11, 23]):
        total, order = rotations.shortest(rows)
        assert total == pytest.approx(min(map(length, permutations(rows)))) == pytest.approx(length(order))
        assert rotations.with_one_more(rows)[14] == pytest.approx(rotations.shortest([*rows, 14])[0])
    chosen = select_views(views, MODEL, 3, rotations, 160.0)
    assert chosen.total_turn_deg <= 160 + 1e-4 and chosen.total_turn_deg == pytest.approx(length(chosen.rows))


def test_more_views_score_higher_and_the_first_is_the_best_single_one(scorer):
    axes = direction_lattice(200)
    scores = scorer.score_directions(POINTS[:1], axes)[0]
    sets = [best_views(scorer, POINTS[0], axes, scores, n) for n in (1, 2, 3)]
    assert sets[0].rows == (int(scores.argmax()),)
    assert sets[0].score < sets[1].score < sets[2].score
    near = best_views(scorer, POINTS[0], axes, scores, 3, 50.0, start=axes[7])
    assert near.total_turn_deg <= 50 + 1e-4 and near.score <= sets[2].score + 1e-6


def test_candidates_are_separated_and_in_reach():
    axes = direction_lattice(500)
    scores = np.random.default_rng(0).random(500)
    rows = candidates(axes, scores, 24)
    assert rows[0] == scores.argmax() and len(rows) == 24
    assert (axes[rows] @ axes[rows].T - 2 * np.eye(24)).max() < np.cos(np.radians(15))
    close = candidates(axes, scores, 24, 40.0, axes[100])
    assert (axes[close] @ axes[100]).min() > np.cos(np.radians(40.1))


def test_new_landmarks_score_higher_than_the_same_again():
    views = random_views(u=60)
    p_detect = np.repeat(views.p_detect[:1], 3, axis=0)
    p_detect[2] = views.p_detect[0, ::-1]
    same = Detections(p_detect, views.terms, views.n_visible[:3], np.full(3, 0.3))
    assert score_of_set(same, MODEL, [0, 2]) > score_of_set(same, MODEL, [0, 1]) > score_of_set(same, MODEL, [0])


@pytest.mark.parametrize(
    ("n", "limit", "error"),
    [(0, None, ConfigError), (7, None, ConfigError), (2, float("nan"), ConfigError), (3, 5.0, PlanningError)],
)
def test_invalid_requests(views, n, limit, error):
    with pytest.raises(error):
        select_views(views, MODEL, n, Rotations(AXES), limit)
