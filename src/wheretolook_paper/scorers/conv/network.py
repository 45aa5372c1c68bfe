"""A small convolutional network over the grid of bins, the paper's input, and its training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import relu

from wheretolook.inputs.statistics import FeatureStatistics
from wheretolook.scorers.mlp.network import BinnedNetwork, StandardBins, statistics_of_record, statistics_record
from wheretolook.training.data import ViewpointDataModule
from wheretolook.training.fit import home_device
from wheretolook.training.learner import TrainingJob, TrainingResult, train_network


@dataclass(frozen=True)
class ConvSpec:
    """Everything that defines a convolutional network but its weights."""

    statistics: FeatureStatistics  # of its channels over the training views; their names are those of its input
    bins: int  # bins along each side of the image
    widths: tuple[int, ...]  # channels after each convolution
    dropout: float  # share of pooled values dropped in training


class ConvNetwork(BinnedNetwork):
    """Convolutions of 3 x 3 bins with ReLU between, the mean and the maximum over the image, one logit out.

    Inputs are the standardized channels and which bins are filled. There are no normalization layers, because the
    number of landmarks in view matters most and a normalization would hide it.
    """

    scored_at_once = 512  # the first convolution of one view takes 115 kB

    def __init__(self, spec: ConvSpec) -> None:
        super().__init__()
        self.spec = spec
        self.statistics = spec.statistics
        self.bins = spec.bins
        self.standard = StandardBins(spec.statistics)
        before = (len(spec.statistics.names) + 1, *spec.widths)
        strides = (1, *[2] * (len(spec.widths) - 1))
        sizes = zip(before, spec.widths, strides, strict=False)
        self.convolutions = nn.ModuleList(nn.Conv2d(n_in, n_out, 3, stride, padding=1) for n_in, n_out, stride in sizes)
        self.dropout = nn.Dropout(spec.dropout)
        self.last = nn.Linear(2 * spec.widths[-1], 1)

    def forward(self, means: Tensor, filled: Tensor) -> Tensor:
        """Return uncalibrated logits (B,) of the channels' means (B, C, bins, bins) and filled bins (B, bins, bins)."""
        values = torch.cat([self.standard(means, filled), filled[:, None].to(means.dtype)], dim=1)
        for convolution in self.convolutions:
            values = relu(convolution(values))
        pooled = torch.cat([values.mean((2, 3)), values.amax((2, 3))], dim=1)
        logits: Tensor = self.last(self.dropout(pooled))
        return logits.squeeze(-1)

    def description(self) -> dict[str, Any]:
        """Return the fields of `ConvSpec`."""
        return asdict(self.spec) | {"statistics": statistics_record(self.statistics)}

    @classmethod
    def of_description(cls, stored: Mapping[str, Any]) -> ConvNetwork:
        """Return the untrained network of a description; ValueError if it names an unknown channel of the bins."""
        widths = tuple(stored["widths"])
        return cls(ConvSpec(statistics_of_record(stored), int(stored["bins"]), widths, float(stored["dropout"])))


def learn_conv(task: TrainingJob) -> TrainingResult:
    """Train a convolutional network on a dataset's train scenes, calibrated on validation views; raises as `load_views`."""
    options = task.options
    device = home_device(task.config)
    data = ViewpointDataModule(task.dataset, task.config, options, options.bins, device, task.progress, True)
    network = ConvNetwork(ConvSpec(data.statistics, options.bins, options.widths, options.dropout))
    return train_network(network, data, task)
