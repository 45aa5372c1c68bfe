import math

import numpy as np
import pytest
from scipy.stats import lognorm

from wheretolook.dataset.config import ACCURACY
from wheretolook.localization.confidence import RIGHT_PLACE, ErrorModel
from wheretolook.localization.rig_localization import JointLocalization


def pose(n_inliers, deviation_m, rivals=()):
    """A result with inliers and a deviation, and no landmarks."""
    covariance = np.diag([deviation_m**2, 0, 0, (deviation_m / 5) ** 2, 0, 0])
    inliers = (np.ones(n_inliers, dtype=bool),)
    unique = (n_inliers // 3, 2)
    return JointLocalization(
        "localized", (), 2 * n_inliers, np.eye(3, 4), None, inliers, float(n_inliers), 5.0, unique, covariance, rivals
    )


def test_the_error_is_log_normal():
    model = ErrorModel(1.2, 0.3, 0.8)
    expected = lognorm(s=0.8, scale=math.exp(1.2 * math.log(0.02) + 0.3)).cdf(0.05)
    assert model.p_below(0.05, 0.02) == pytest.approx(expected)
    assert model.p_below(math.inf, math.inf) == 1 and model.p_below(0.05, math.inf) == 0 and model.p_below(0.05, 0) == 1


def test_a_coarser_accuracy_is_more_probable_up_to_the_right_place():
    found = [pose(200, 0.02).probability(limits) for limits in ((0.01, 0.1), ACCURACY, (0.25, 2.0), RIGHT_PLACE)]
    assert found == sorted(found) and found[0] < 0.5 < found[1]
    assert pose(200, 0.02).probability((1e6, 180.0)) == pytest.approx(found[-1], abs=1e-6)
    assert pose(5, 0.02).probability() == 0
    few, enough = (pose(n, 0.001).probability((1e6, 180.0)) for n in (11, 12))
    assert few <= 0.5 < enough


def test_poses_that_exclude_each_other_have_probabilities_up_to_one_together():
    strong = pose(300, 0.01)
    found = pose(300, 0.01, (strong, pose(30, 0.1))).probabilities(RIGHT_PLACE)
    assert found.shape == (3,) and found.sum() == pytest.approx(1) and found[0] == found[1] > found[2]
    assert JointLocalization("no_pose", (), 0).probabilities().tolist() == [0]
