"""A network over the set of visible landmarks."""

from __future__ import annotations

from wheretolook.scorers.registry import Method, MethodStyle, imported, network_scorer
from wheretolook.scorers.set.config import SetConfig

METHODS = (
    Method(
        position=100,
        name="set",
        about="Network over the set of visible landmarks: their probabilities of detection and their information on "
        "the pose.",
        style=MethodStyle("set of landmarks", "#CC3311", "o", "-"),
        group="learned",
        build=network_scorer(
            "wheretolook.scorers.set.score:SetScorer", "wheretolook.scorers.set.network:SetNetwork", "set"
        ),
        weights="set",
        probability=True,
        reference=2,
        of_the_few=True,
        learn=imported("wheretolook.scorers.set.learn:learn_set"),
        config=SetConfig,
        folder="set",
        trained_unasked=True,
    ),
)
