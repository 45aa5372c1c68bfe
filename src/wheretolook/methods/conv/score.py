"""The score of the convolutional network, which sees the bins as an image and knows what landmarks are like."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from wheretolook.geometry.poses import Float
from wheretolook.inputs.bins import ALL_CHANNELS, BinnedViews
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.methods.base import BinnedScorer
from wheretolook.methods.conv.learn import ConvNetwork
from wheretolook.methods.field_of_view import channel_scales, check_field_of_view, naming

BLOCK = 512
"""Views at a time: the first convolution of one takes 115 kB."""


class ConvScorer(BinnedScorer):
    """A convolutional network on the binned landmarks and how they were mapped: the probability that a view localizes.

    Args:
        localization_map: the map.
        network: trained for cameras of the same field of view.

    Raises:
        WeightsError: trained for another field of view than the map's camera.
    """

    name: ClassVar[str] = "conv"
    local = True

    def __init__(self, localization_map: LocalizationMap, network: ConvNetwork) -> None:
        super().__init__(localization_map, network.spec.bins, landmark_channels=True)
        check_field_of_view(network.spec.camera, localization_map.camera)
        self.device = localization_map.device
        self.network = network.to(self.device).eval()
        scales = channel_scales(network.spec.camera, localization_map.camera, ALL_CHANNELS)
        self._scale = torch.tensor(scales, device=self.device)[:, None, None]

    @classmethod
    def load(cls, weights: str | Path, localization_map: LocalizationMap) -> ConvScorer:
        """Build a scorer from a weights file that the train stage wrote.

        Raises:
            WeightsError: the file cannot be used, or was trained for another field of view than the map's camera.
        """
        network = ConvNetwork.load(weights)
        with naming(weights):
            return cls(localization_map, network)

    def score_bins(self, binned: BinnedViews) -> Float:
        """(B,) probabilities in [0, 1]."""
        binned = binned.select(ALL_CHANNELS) if binned.channels != ALL_CHANNELS else binned
        scores = np.empty(len(binned))
        # TF32 would let a score depend on how many views are scored with it
        with torch.inference_mode(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            for begin in range(0, len(scores), BLOCK):
                rows = slice(begin, begin + BLOCK)
                means = torch.from_numpy(binned.means[rows]).to(self.device) * self._scale
                filled = torch.from_numpy(binned.counts[rows] > 0).to(self.device)
                scores[rows] = self.network.log_odds(means, filled).sigmoid().cpu().numpy()
        return scores
