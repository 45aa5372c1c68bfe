"""What a set of looks is worth: the probability that they localize together.

It goes by two numbers. The log-odds that one of them localizes alone, each for itself, tells most. That looks which see
the same do not fail each for itself, it does not know: so the second is the variance of the position that the landmarks
to be found by all together leave, which falls more with landmarks elsewhere than with more of the same.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from wheretolook.geometry.poses import Float
from wheretolook.looks.joint_visibility import log_position_variance
from wheretolook.utils.shipped_model import LogisticRegression

TOLD = ("log_odds_alone", "log_position_variance")

LEAST_CHANCE = 1e-3  # of localizing alone, or of not

SHIPPED = Path(__file__).with_name("worth.json")


class SetWorth(LogisticRegression):
    """One model for sets of any size, single looks among them; it ships fitted to sets of 1 to 5 drawn at random."""

    names = TOLD
    about = "what looks are worth"
    file = SHIPPED

    def __call__(self, sums: Float, failed: Float) -> Float:
        """Probabilities (B,) of sets from their sums (B, N_SUMS), and the chances (B,) that no look localizes alone."""
        chance = np.clip(1 - np.asarray(failed, dtype=np.float64), LEAST_CHANCE, 1 - LEAST_CHANCE)
        told = np.stack([np.log(chance / (1 - chance)), log_position_variance(np.asarray(sums))], axis=-1)
        return self.probabilities(told)


def fisher_worth(sums: Float, failed: Float) -> Float:
    """For comparison: log det of the information, (B,), as of `fisher.metrics`; with exact chances that of the rig."""
    from wheretolook_paper.fisher.metrics import metric_of

    return metric_of(np.asarray(sums)[..., 1:], "logdet")


def count_worth(sums: Float, failed: Float) -> Float:
    """For comparison: how many different landmarks are expected to be found, (B,)."""
    return np.asarray(sums)[..., 0]
