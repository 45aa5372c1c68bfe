"""The probability that a visible landmark is matched as an inlier: the learned model behind the expected-* baselines."""

from __future__ import annotations

from wheretolook.scorers.matchability.config import MatchabilityConfig
from wheretolook.scorers.registry import Method, MethodStyle, imported

METHODS = (
    Method(
        position=70,
        name="matchability",
        about="The probability that a visible landmark is detected.",
        style=MethodStyle("matchability", "#CC79A7", "8", (0, (1, 1))),
        group="learned",
        learn=imported("wheretolook.scorers.matchability.learn:learn_matchability"),
        config=MatchabilityConfig,
        folder="matchability",
    ),
)
