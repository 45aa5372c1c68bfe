"""Score a set of views from one location: the probability that they localize jointly."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from wheretolook.geometry.poses import Float
from wheretolook.looks.joint_visibility import log_position_variance
from wheretolook.utils.shipped_model import LogisticRegression

MIN_PROBABILITY = 1e-3  # that some view localizes on its own, or that none does


class SetScoreModel(LogisticRegression):
    """Logistic regression fitted to random sets of 1 to 5 views; the same for every size.

    The log-odds that some view localizes on its own matter most, but treat views of the same landmarks as independent.
    The position variance left by all landmarks they detect jointly corrects for that: it falls more with new landmarks
    than with more detections of the same.
    """

    names = ("log_odds_alone", "log_position_variance")
    about = "scores of sets of views"
    file = Path(__file__).with_name("set_score.json")

    def __call__(self, sums: Float, p_none: Float) -> Float:
        """Return the probability (B,) of sets from their sums (B, N_SUMS) and p_none (B,), that no view localizes."""
        p_some = np.clip(1 - np.asarray(p_none, dtype=np.float64), MIN_PROBABILITY, 1 - MIN_PROBABILITY)
        log_odds = np.log(p_some / (1 - p_some))
        return self.predict_proba(np.stack([log_odds, log_position_variance(np.asarray(sums))], axis=-1))
