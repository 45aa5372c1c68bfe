"""The score of a network that sees a location's landmarks and mapping cameras all around."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from wheretolook.geometry.poses import Float, check_poses
from wheretolook.inputs.localization_map import LocalizationMap, shared_locations
from wheretolook.methods.base import Scorer
from wheretolook.methods.field_of_view import check_field_of_view, naming
from wheretolook.methods.sphere.learn import SphereModel, on_lattice
from wheretolook.methods.sphere.views import LocationDescriber


class SphereScorer(Scorer):
    """In the manner of ActLoc: one pass over a location's landmarks and the mapping cameras scores 6 x 18 directions.

    A pose's score is the probability that it localizes, interpolated between those directions; roll does not count.

    Args:
        localization_map: the map, with its mapping cameras.
        model: trained for cameras of the same field of view.

    Raises:
        WeightsError: trained for another field of view than the map's camera.
        MapError: the map has no mapping cameras.
    """

    name: ClassVar[str] = "sphere"

    def __init__(self, localization_map: LocalizationMap, model: SphereModel) -> None:
        super().__init__(localization_map)
        check_field_of_view(model.camera, localization_map.camera)
        self._describer = LocationDescriber(localization_map, model.config)
        self.model = model.to(localization_map.device)

    @classmethod
    def load(cls, weights: str | Path, localization_map: LocalizationMap) -> SphereScorer:
        """Build a scorer from a weights file that the train stage wrote.

        Raises:
            WeightsError: the file cannot be used, or was trained for another field of view than the map's camera.
            MapError: the map has no mapping cameras.
        """
        model = SphereModel.load(weights)
        with naming(weights):
            return cls(localization_map, model)

    def score(self, cam_from_world: Float) -> Float:
        """(B,) probabilities in [0, 1]."""
        cam_from_world = check_poses(cam_from_world)
        if not len(cam_from_world):
            return np.empty(0)
        locations, rows = shared_locations(cam_from_world)
        device = self.localization_map.device
        described = self._describer.describe(locations)
        lattices = torch.stack([self.model.lattice_logits(tokens.to(device)) for tokens in described])
        axes = torch.from_numpy(np.ascontiguousarray(cam_from_world[:, 2, :3], dtype=np.float64)).to(device)
        logits = on_lattice(lattices, torch.from_numpy(rows).to(device), axes)
        return np.asarray(logits.sigmoid().cpu().numpy())
