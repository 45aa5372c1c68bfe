"""Expected scores where the robot's pose is uncertain."""

from types import SimpleNamespace

import numpy as np
import pandas as pd

from selection.room import POINTS
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.geometry.views import Views
from wheretolook.select.selection import PoseUncertainty, ScoredDirections
from wheretolook.select.waypoints import Waypoints

FREE_TO_X = 5.0  # beyond is geometry


def expected(prior, score):
    """Compute expected scores of a view along x at the origin, where only the direction y is allowed."""
    occlusion = SimpleNamespace(inside_geometry=lambda points: points[:, 0] > FREE_TO_X)
    scorer = SimpleNamespace(score_directions=score, localization_map=SimpleNamespace(occlusion=occlusion))
    candidates = ScoredDirections(scorer, Waypoints.of((0, 0, 0)), np.array([[0.0, 1.0, 0.0]]), np.ones((1, 1)))
    views = prior.with_expected_scores(
        Views(poses_looking_along([(0, 0, 0)], [(1, 0, 0)]), waypoint=np.array([0])), candidates
    )
    return views.expected_score, views.best_expected_score


def test_means_of_known_scores():
    along_x = expected(PoseUncertainty(0.0, 45.0), lambda points, axes: axes[None, :, 0])
    np.testing.assert_allclose(along_x[0], np.exp(-(np.radians(45) ** 2) / 2), atol=0.12)  # E cos of a normal angle
    squared = expected(
        PoseUncertainty(2.0, 0.0), lambda points, axes: np.tile((points**2).sum(1)[:, None], (1, len(axes)))
    )
    np.testing.assert_allclose(squared[0], 2 * 2.0**2, rtol=0.35)  # two coordinates: no error of height
    shifted = expected(
        PoseUncertainty(20.0, 0.0), lambda points, axes: np.tile(points[:, :1] <= FREE_TO_X, (1, len(axes)))
    )
    np.testing.assert_array_equal(shifted[0], 1)  # no draw inside geometry
    sideways = expected(PoseUncertainty(0.0, 0.0), lambda points, axes: axes[None, :, 1])
    np.testing.assert_allclose(sideways, [[0.0], [1.0]])


def test_views_report_expected_scores(look, tmp_path):
    plain, uncertain = look.best(POINTS, 2), look.best(POINTS, 2, sigma_m=0.5, yaw_sigma_deg=5)
    assert plain.expected_score is None
    np.testing.assert_array_equal(uncertain.cam_from_world, plain.cam_from_world)
    assert uncertain.expected_score is not None and uncertain.best_expected_score is not None
    assert (uncertain.expected_score <= uncertain.best_expected_score).all()
    certain = look.best(POINTS, 2, sigma_m=1e-9)
    assert certain.expected_score is not None
    np.testing.assert_allclose(certain.expected_score, certain.score, atol=1e-4)
    uncertain.save(tmp_path / "views.csv")
    table = pd.read_csv(tmp_path / "views.csv")
    np.testing.assert_allclose(table["expected_score"], uncertain.expected_score, rtol=1e-6)
    np.testing.assert_allclose(table["best_expected_score"], uncertain.best_expected_score, rtol=1e-6)
