"""The next view of a camera that turns in place."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from selection.room import POINTS, WEIGHTS, write_room
from wheretolook import LocalizationMap, load_scorer
from wheretolook.geometry.lattices import direction_lattice
from wheretolook.geometry.poses import poses_looking_along, rotation_angle_deg, rotation_looking_along
from wheretolook.localization.confidence import RIGHT_PLACE
from wheretolook.localization.rig import Look
from wheretolook.localization.rig_localization import JointLocalization
from wheretolook.looks.next_look import MIN_ANGLE_DEG, N_DIRECTIONS, NextLookSelector, mean_scores_by_pitch
from wheretolook.utils.errors import PlanningError

CENTER = np.asarray(POINTS[0], dtype=np.float64)
FIRST = poses_looking_along(CENTER[None], [(1.0, 0.2, 0.1)])[0]


@pytest.fixture(scope="module")
def scorer(tmp_path_factory):
    return load_scorer(LocalizationMap.from_colmap(write_room(tmp_path_factory.mktemp("room") / "sparse")), WEIGHTS)


@pytest.fixture(scope="module")
def selector(scorer):
    return NextLookSelector(scorer, mean_scores_by_pitch(scorer, POINTS))


def localization(scorer, pose, n_inliers=2000, rivals=()):
    """A result of one view with a pose (3, 4): certain with many inliers."""
    none = np.zeros(0, dtype=np.int64)
    look = Look(np.eye(3, 4), np.zeros((0, 2)), none, scorer.localization_map.camera)
    if pose is None:
        return JointLocalization("too_few_matches", (look,), 0)
    inliers = (np.ones(n_inliers, dtype=bool),)
    unique = (n_inliers // 5, 0)
    covariance = np.eye(6) * 1e-8
    found = (float(n_inliers), 0.0, unique, covariance, rivals)
    return JointLocalization("localized", (look,), n_inliers, pose, pose[None], inliers, *found)


def test_of_a_known_pose_the_view_with_the_best_score_is_next(scorer, selector):
    certain = localization(scorer, FIRST)
    assert certain.probabilities(RIGHT_PLACE)[0] > 0.999
    chosen = selector.select(certain, pitch_deg=(-90, 90))
    axis = chosen.cam_from_rig[2] @ FIRST[:, :3]
    level = np.array([FIRST[2, 0], FIRST[2, 1], 0]) / np.hypot(*FIRST[2, :2])
    to_world = np.stack([level, np.cross((0, 0, 1), level), (0, 0, 1)])
    axes = direction_lattice(N_DIRECTIONS) @ to_world
    scores = scorer.score_directions(CENTER[None], axes)[0]
    scores[axes @ FIRST[2, :3] > np.cos(np.radians(MIN_ANGLE_DEG))] = 0
    assert axis @ axes[np.argmax(scores)] == pytest.approx(1, abs=1e-6) and chosen.gain == pytest.approx(
        scores.max(), abs=0.01
    )
    assert np.degrees(np.arcsin(axis[2])) == pytest.approx(chosen.pitch_deg, abs=0.02)
    turn = np.degrees(np.arctan2(axis[1], axis[0]) - np.arctan2(FIRST[2, 1], FIRST[2, 0]))
    assert (turn - chosen.pan_deg + 180) % 360 - 180 == pytest.approx(0, abs=0.02)
    rolled = chosen.cam_from_rig @ FIRST[:, :3]
    assert_allclose(rolled, rotation_looking_along(axis), atol=1e-3)


def test_the_gain_is_a_sum_over_hypotheses(scorer, selector):
    other = poses_looking_along(np.asarray(POINTS[1:2], dtype=np.float64), [(-0.3, 1.0, 0.0)])[0]
    weak = localization(scorer, other, 12)
    both = localization(scorer, FIRST, 14, (weak,))
    found = both.probabilities(RIGHT_PLACE)
    assert 0.02 < found[1] < found[0] < 0.98
    axes = direction_lattice(20)
    scores = [
        scorer.score_directions(p[None], axes @ pose[:, :3])[0] for p, pose in ((CENTER, FIRST), (POINTS[1], other))
    ]
    lost = selector.scores_if_lost(both, axes, np.zeros(20))
    expected = found @ scores + (1 - found.sum()) * lost
    assert_allclose(selector.gains(both, axes, np.zeros(20)), expected, atol=1e-6)
    ahead = np.array([(0, 0, 1.0), (np.sin(0.5), 0, np.cos(0.5)), (1.0, 0, 0), (0, 0, -1.0)])
    lost = selector.scores_if_lost(both, ahead, np.zeros(4))
    assert_allclose(lost / lost[3], [0, np.degrees(0.5) / 90, 1, 1], atol=1e-9)


def test_without_a_pose_a_level_camera_turns_within_limits(scorer, selector):
    lost = localization(scorer, None)
    chosen = selector.select(lost, pitch_deg=(-10, 10), pan_deg=(20, 60))
    assert -10 <= chosen.pitch_deg <= 10 and 20 <= chosen.pan_deg <= 60
    axis = chosen.cam_from_rig[2]  # in the camera: x right, y down
    assert np.degrees(np.arctan2(-axis[0], axis[2])) == pytest.approx(chosen.pan_deg)
    assert rotation_angle_deg(chosen.cam_from_rig, np.eye(3)) >= MIN_ANGLE_DEG
    tilted = selector.select(lost, up=(0, 0, -1), pitch_deg=(-10, 10))  # the camera looks straight down
    assert abs(tilted.cam_from_rig[2, 2]) <= np.sin(np.radians(10)) + 1e-9
    with pytest.raises(PlanningError, match="limits"):
        selector.select(lost, pitch_deg=(-5, 5), pan_deg=(-10, 10))
