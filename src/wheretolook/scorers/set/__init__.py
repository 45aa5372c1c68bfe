"""A network over the set of visible landmarks."""

from __future__ import annotations

from wheretolook.scorers.registry import Learner, Method, imported, network_scorer
from wheretolook.scorers.set.config import SetConfig

METHODS = (
    Method(
        name="set",
        about="Network over the set of visible landmarks: their probabilities of detection and their information on "
        "the pose.",
        build=network_scorer(
            "wheretolook.scorers.set.score:SetScorer", "wheretolook.scorers.set.network:SetNetwork", "set"
        ),
        weights="set",
        probability=True,
        learner=Learner(imported("wheretolook.scorers.set.learn:learn_set"), SetConfig),
    ),
)
