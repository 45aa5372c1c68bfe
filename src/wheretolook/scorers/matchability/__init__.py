"""The probability that a visible landmark is matched as an inlier: the learned model behind the expected-* baselines."""

from __future__ import annotations

from wheretolook.scorers.matchability.config import MatchabilityConfig
from wheretolook.scorers.registry import Learner, Method, imported

METHODS = (
    Method(
        name="matchability",
        about="The probability that a visible landmark is detected.",
        learner=Learner(imported("wheretolook.scorers.matchability.learn:learn_matchability"), MatchabilityConfig),
    ),
)
