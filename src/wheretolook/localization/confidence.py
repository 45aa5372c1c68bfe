"""Predicts whether a joint pose is right, from what a robot knows without ground truth.

Where a map resembles itself, a wrong pose can have a hundred inliers. But then a competing pose has nearly as many, or
has fewer that the ambiguity does not explain; the right pose explains all views much better than any competing pose.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.poses import Float
from wheretolook.localization.pose_ambiguity import log_ratio
from wheretolook.utils.shipped_model import LogisticRegression

if TYPE_CHECKING:
    from wheretolook.localization.rig_localization import JointLocalization

FEATURE_NAMES = ("log_elsewhere", "log_share", "log_own", "log_deviation_deg")
"""log(1 + support of the best competing pose), log of the inlier ratio of the matches, log of the ratio of this pose's
unique support to that of its strongest rival (`pose_ambiguity.log_ratio`), log of one standard deviation of the
orientation (degrees)."""

MIN_INLIERS = 10  # with fewer, the localizer itself rejects a pose
MIN_DEVIATION_DEG = 1e-4
MAX_DEVIATION_DEG = 10.0


def confidence_features(
    n_inliers: ArrayLike,
    n_matches: ArrayLike,
    rival_support: ArrayLike,
    unique_support: ArrayLike,
    rival_unique_support: ArrayLike,
    deviation_deg: ArrayLike,
) -> Float:
    """`FEATURE_NAMES` (B, 4) of B joint poses."""
    inlier_ratio = (np.asarray(n_inliers, dtype=np.float64) + 0.5) / (np.asarray(n_matches, dtype=np.float64) + 1)
    deviation = np.clip(np.asarray(deviation_deg, dtype=np.float64), MIN_DEVIATION_DEG, MAX_DEVIATION_DEG)
    support_ratio = log_ratio(unique_support, rival_unique_support)
    rival = np.log1p(np.asarray(rival_support, dtype=np.float64))
    return np.stack([rival, np.log(inlier_ratio), support_ratio, np.log(deviation)], axis=-1)


class ConfidenceModel(LogisticRegression):
    """Probability that a pose is within 5 cm and 0.4 degrees; 0 with fewer inliers than `MIN_INLIERS`."""

    names = FEATURE_NAMES
    about = "confidence"
    file = Path(__file__).with_name("confidence.json")

    def of(self, localization: JointLocalization) -> float:
        """Confidence in a joint pose, 0 if there is none."""
        if localization.n_inliers < MIN_INLIERS:
            return 0.0
        features = confidence_features(
            localization.n_inliers,
            localization.n_matches,
            localization.rival_support,
            *localization.unique_support,
            localization.deviation[1],
        )
        return float(self.predict_proba(features))
