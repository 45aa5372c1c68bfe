"""The score of a network over the set of landmarks in view."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from wheretolook.geometry.poses import Float, check_poses
from wheretolook.inputs.landmarks_in_view import LandmarkDescriber
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.methods.base import Scorer
from wheretolook.methods.field_of_view import check_field_of_view, naming
from wheretolook.methods.set.learn import SetModel

MOST = 1024
"""Landmarks of a view that are looked at; of more, so many evenly spread ones stand for all. The network has learnt
from samples of a fifth of that; against looking at all, log-odds differ by 0.05 where a view sees thousands."""


class SetScorer(Scorer):
    """Network over the set of landmarks in view: each by its chance of being found, all by what they tell of the pose.

    Args:
        localization_map: the map.
        model: trained for cameras of the same field of view.

    Raises:
        WeightsError: trained for another field of view than the map's camera.
    """

    name: ClassVar[str] = "set"
    local = True

    def __init__(self, localization_map: LocalizationMap, model: SetModel) -> None:
        super().__init__(localization_map)
        check_field_of_view(model.camera, localization_map.camera)
        self.model = model
        model.network.to(localization_map.device)
        self._describer = LandmarkDescriber(localization_map)

    @classmethod
    def load(cls, weights: str | Path, localization_map: LocalizationMap) -> SetScorer:
        """Build a scorer from a weights file that the train stage wrote.

        Raises:
            WeightsError: the file cannot be used, or was trained for another field of view than the map's camera.
        """
        model = SetModel.load(weights, localization_map.device)
        with naming(weights):
            return cls(localization_map, model)

    def score(self, cam_from_world: Float) -> Float:
        """(B,) probabilities in [0, 1]."""
        cam_from_world = check_poses(cam_from_world)
        scores = np.empty(len(cam_from_world))
        for rows, described, visible in self._describer.in_blocks(cam_from_world, MOST):
            height = torch.from_numpy(cam_from_world[rows, 2, 2]).to(described.values)
            scores[rows] = self.model.log_odds(described, visible, height).sigmoid().cpu().numpy()
        return scores
