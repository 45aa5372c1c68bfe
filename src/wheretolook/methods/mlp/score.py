"""The learned score."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from wheretolook.geometry.poses import Float
from wheretolook.inputs.bins import ALL_CHANNELS, CHANNELS, BinnedViews
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.learning.weights import read_training
from wheretolook.methods.base import BLOCK, BinnedScorer
from wheretolook.methods.field_of_view import channel_scales, check_field_of_view, naming
from wheretolook.methods.mlp.network import ViewpointNetwork
from wheretolook.methods.mlp.weights import load_classifier


class LearnedScorer(BinnedScorer):
    """The paper's classifier: the predicted probability that a view localizes.

    A network knows the field of view it was trained with. A camera of another resolution but the same field of view is
    served by scaling its pixels; another field of view is refused, since the network has never seen one.

    Args:
        localization_map: the map.
        network: a trained network.
        inputs: name of its variant, if it is not that of its inputs.
    """

    name: ClassVar[str] = "mlp"
    local = True

    def __init__(self, localization_map: LocalizationMap, network: ViewpointNetwork, inputs: str | None = None) -> None:
        super().__init__(localization_map, network.spec.bins, not {*network.spec.channels} <= {*CHANNELS})
        self.inputs = network.spec.variant if inputs is None else inputs
        self.device = localization_map.device
        self.network = network.to(self.device).eval()
        trained, camera = network.spec.camera, localization_map.camera
        check_field_of_view(trained, camera)
        self._channels = ALL_CHANNELS if self.landmark_channels else CHANNELS
        self._scale = torch.tensor(channel_scales(trained, camera, self._channels), device=self.device)[:, None, None]

    @classmethod
    def load(cls, weights: str | Path, localization_map: LocalizationMap) -> LearnedScorer:
        """Build a scorer from a weights file that the train stage wrote.

        Raises:
            WeightsError: the file cannot be used, or was trained for another field of view than the map's camera.
        """
        network = load_classifier(weights)
        with naming(weights):
            return cls(localization_map, network, read_training(weights).get("variant"))

    def score_bins(self, binned: BinnedViews) -> Float:
        """(B,) probabilities in [0, 1]."""
        binned = binned.select(self._channels) if binned.channels != self._channels else binned
        scores = np.empty(len(binned))
        with torch.inference_mode():
            for begin in range(0, len(scores), BLOCK):
                rows = slice(begin, begin + BLOCK)
                means = torch.from_numpy(binned.means[rows]).to(self.device) * self._scale
                filled = torch.from_numpy(binned.counts[rows] > 0).to(self.device)
                # float64 keeps views apart whose probabilities round to 1 in float32
                scores[rows] = self.network(means, filled).double().sigmoid().cpu().numpy()
        return scores
