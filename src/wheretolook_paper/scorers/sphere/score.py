"""The score of the network for all directions at a location."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from wheretolook.geometry.poses import Float, check_poses
from wheretolook.inputs.localization_map import LocalizationMap, shared_locations
from wheretolook.scorers.base import Scorer, check_field_of_view
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook_paper.scorers.sphere.network import SphereNetwork, on_lattice
from wheretolook_paper.scorers.sphere.views import LocationDescriber


class SphereScorer(Scorer):
    """Like ActLoc: one pass over a location's landmarks and the mapping cameras scores 6 x 18 directions.

    A pose's score is the probability that it localizes, interpolated between those directions; roll does not count.
    Raises a WeightsError if it was trained for another field of view than the map's camera, a MapError if the map has
    no mapping cameras.
    """

    def __init__(self, localization_map: LocalizationMap, trained: TrainedNetwork[SphereNetwork]) -> None:
        super().__init__(localization_map)
        check_field_of_view(trained.camera, localization_map.camera)
        self.name = trained.method
        self.trained = trained
        self.network = trained.network.to(localization_map.device)
        self._describer = LocationDescriber(localization_map, self.network.config)

    def score(self, cam_from_world: Float) -> Float:
        """Return probabilities (B,) in [0, 1]."""
        cam_from_world = check_poses(cam_from_world)
        if not len(cam_from_world):
            return np.empty(0)
        locations, rows = shared_locations(cam_from_world)
        device = self.localization_map.device
        described = self._describer.describe(locations)
        lattices = torch.stack([self._log_odds(tokens.to(device)) for tokens in described])
        axes = torch.from_numpy(np.ascontiguousarray(cam_from_world[:, 2, :3], dtype=np.float64)).to(device)
        logits = on_lattice(lattices, torch.from_numpy(rows).to(device), axes)
        return np.asarray(logits.sigmoid().cpu().numpy())

    def _log_odds(self, tokens: Tensor) -> Tensor:
        """Return calibrated log-odds (PITCHES, YAWS) float64 of all directions at the location of tokens (T, len(FEATURES)).

        Locations are encoded one by one, because batching changes the last digits of logits.
        """
        with torch.inference_mode():
            return self.trained.calibrated(self.network.encode(tokens[None])[0].double())
