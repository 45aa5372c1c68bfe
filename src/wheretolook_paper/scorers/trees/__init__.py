"""Boosted trees on pooled statistics of the landmarks in view."""

from __future__ import annotations

from typing import TYPE_CHECKING

from wheretolook.scorers.method import Method, MethodStyle, ScorerOptions, imported
from wheretolook_paper.scorers.trees.config import TreesConfig

if TYPE_CHECKING:
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.scorers.base import Scorer


def _build(localization_map: LocalizationMap, options: ScorerOptions) -> Scorer:
    from wheretolook_paper.scorers.trees.learn import BoostedTrees
    from wheretolook_paper.scorers.trees.score import TreesScorer

    assert options.weights is not None
    return TreesScorer(localization_map, BoostedTrees.load(options.weights))


METHODS = (
    Method(
        position=80,
        name="trees",
        about="Probability that a view localizes, by boosted trees on positions and attributes of its visible landmarks.",
        style=MethodStyle("boosted trees, landmark attributes", "#882255", "*", "-"),
        group="learned",
        build=_build,
        weights="trees",
        probability=True,
        learn=imported("wheretolook_paper.scorers.trees.learn:learn_trees"),
        config=TreesConfig,
        folder="trees",
    ),
)
