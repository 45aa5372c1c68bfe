"""Boosted trees on pooled statistics of the landmarks in view."""

from __future__ import annotations

from dataclasses import dataclass

from wheretolook.scorers.registry import Learner, Method, imported
from wheretolook.utils.errors import check_positive, check_range, no_option


@dataclass(frozen=True)
class TreesConfig:
    """Options of boosted trees (LightGBM's, Ke et al. 2017).

    Args:
        max_trees: rounds of boosting; those up to the best validation average precision are kept.
        learning_rate: shrinkage of each tree.
        max_leaves: leaves of a tree.
        min_leaf: viewpoints of a leaf.
        l2: penalty on the leaves' values.
    """

    max_trees: int = no_option(400)
    learning_rate: float = no_option(0.06)
    max_leaves: int = no_option(31)
    min_leaf: int = no_option(50)
    l2: float = no_option(1.0)

    def __post_init__(self) -> None:
        check_range("max_trees", self.max_trees, 1)
        check_range("max_leaves", self.max_leaves, 2)
        check_range("min_leaf", self.min_leaf, 1)
        check_positive("learning_rate", self.learning_rate)
        check_range("l2", self.l2, 0)


METHODS = (
    Method(
        name="trees",
        about="Probability that a view localizes, by boosted trees on positions and attributes of its visible landmarks.",
        build=imported("wheretolook_paper.scorers.trees.learn:build_trees"),
        weights="trees",
        probability=True,
        learner=Learner(imported("wheretolook_paper.scorers.trees.learn:learn_trees"), TreesConfig),
    ),
)
