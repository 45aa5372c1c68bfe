"""The score of boosted trees."""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from wheretolook.geometry.poses import Float, check_poses
from wheretolook.inputs.channels import ATTRIBUTES
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.scorers.base import BLOCK
from wheretolook.scorers.set.score import LandmarkScorer
from wheretolook_paper.scorers.pooled_features import pool
from wheretolook_paper.scorers.trees.learn import BoostedTrees


class TreesScorer(LandmarkScorer):
    """Probability that a view localizes, by boosted trees on the positions and attributes of its visible landmarks."""

    name = "trees"
    local = True

    def __init__(self, localization_map: LocalizationMap, trees: BoostedTrees) -> None:
        super().__init__(localization_map, ATTRIBUTES, trees.training_range, trees.camera)
        self.trees = trees

    def score(self, cam_from_world: Float) -> Float:
        """Return probabilities (B,) in [0, 1]."""
        cam_from_world = check_poses(cam_from_world)
        scores = np.empty(len(cam_from_world))
        quantities: list[Float] = []
        for begin in range(0, len(scores), BLOCK):
            block = cam_from_world[begin : begin + BLOCK]
            described = self.describer.describe(block)
            quantities += self._quantities(described, described.counts)
            pooled = pool(described, block, self.localization_map.camera)
            scores[begin : begin + BLOCK] = expit(self.trees.logits(pooled.cpu().numpy()))
        self._watch.check(self.name, self.training_range, quantities)
        return scores
