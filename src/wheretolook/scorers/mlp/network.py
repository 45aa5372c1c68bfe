"""The network that scores a viewpoint, from binned landmarks to a logit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn

from wheretolook.inputs.channels import CHANNELS, Layout
from wheretolook.inputs.statistics import FeatureStatistics
from wheretolook.scorers.binned_network import BinnedNetwork, StandardBins, statistics_of_record, statistics_record
from wheretolook.scorers.mlp.config import MlpConfig


@dataclass(frozen=True)
class NetworkSpec:
    """Everything that defines a network but its weights."""

    statistics: FeatureStatistics  # of its channels over the training views
    bins: int = 30  # bins along each side of the image
    layout: Layout = "in_place"  # order of the bins in the input
    hidden: tuple[int, ...] = (300, 300)  # widths of the hidden layers
    dropout: float = 0.5  # share of hidden units dropped in training
    input_dropout: float = 0.0  # share of input values dropped in training

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels of the input, in order."""
        return self.statistics.names

    @property
    def input_size(self) -> int:
        """Number of input values of the first layer."""
        return len(self.channels) * self.bins**2


class BinnedInput(nn.Module):
    """Turns binned views into a network's standardized, flat input."""

    def __init__(self, spec: NetworkSpec) -> None:
        super().__init__()
        self.layout = spec.layout
        self.standard = StandardBins(spec.statistics)

    def forward(self, means: Tensor, filled: Tensor) -> Tensor:
        """Return inputs (B, C * bins * bins) float32 of means and filled bins as in `ViewpointNetwork.forward`."""
        values = self.standard(means, filled)
        if self.layout == "compact":
            values = move_to_front(values, filled)
        return values.flatten(1)


def move_to_front(values: Tensor, filled: Tensor) -> Tensor:
    """Return means (B, C, bins, bins), zero in empty bins, with the filled bins first: the layout "compact"."""
    flat = filled.flatten(1)
    n_filled = flat.sum(1, keepdim=True)
    # the k-th filled bin goes to place k, the k-th empty bin behind all filled ones: a permutation
    place = torch.where(flat, flat.cumsum(1) - 1, n_filled + (~flat).cumsum(1) - 1)
    moved = torch.empty_like(values).flatten(2)
    moved.scatter_(2, place[:, None].expand_as(moved), values.flatten(2))
    return moved.view_as(values)


def add_noise(
    means: Tensor, filled: Tensor, noise_px: float, noise_m: float, channels: tuple[str, ...] = CHANNELS
) -> Tensor:
    """Add Gaussian noise to filled bins, as the released code does in training.

    `noise_px` is its deviation on u and v, `noise_m` on x, y and z; other channels stay.
    """
    of_kind = {"u": noise_px, "v": noise_px, "x": noise_m, "y": noise_m, "z": noise_m}
    scale = means.new_tensor([of_kind.get(name, 0.0) for name in channels])
    return means + torch.randn_like(means) * scale[:, None, None] * filled[:, None]


class ViewpointNetwork(BinnedNetwork):
    """The paper's classifier (its architecture table): linear layers with ReLU and dropout between, one logit out."""

    def __init__(self, spec: NetworkSpec) -> None:
        super().__init__()
        self.spec = spec
        self.statistics = spec.statistics
        self.bins = spec.bins
        self.input = BinnedInput(spec)
        layers: list[nn.Module] = [nn.Dropout(spec.input_dropout)] if spec.input_dropout > 0 else []
        width = spec.input_size
        for hidden in spec.hidden:
            layers += [nn.Linear(width, hidden), nn.ReLU(), nn.Dropout(spec.dropout)]
            width = hidden
        self.layers = nn.Sequential(*layers, nn.Linear(width, 1))

    def forward(self, means: Tensor, filled: Tensor) -> Tensor:
        """Return logits (B,) of means (B, C, bins, bins) float32 of its channels and filled bins (B, bins, bins)."""
        return self.layers(self.input(means, filled)).squeeze(-1)

    def augment(self, options: MlpConfig, means: Tensor, filled: Tensor) -> tuple[Tensor, Tensor]:
        """Return the views with the noise of the options, if any."""
        if options.noise_px > 0 or options.noise_m > 0:
            means = add_noise(means, filled, options.noise_px, options.noise_m, self.spec.channels)
        return means, filled

    def description(self) -> dict[str, Any]:
        """Return the fields of `NetworkSpec`."""
        return asdict(self.spec) | {"statistics": statistics_record(self.statistics)}

    @classmethod
    def of_description(cls, stored: Mapping[str, Any]) -> ViewpointNetwork:
        """Build the untrained network of a description; ValueError if it names an unknown channel."""
        bins = int(stored["bins"])
        hidden = tuple(stored["hidden"])
        dropouts = float(stored["dropout"]), float(stored["input_dropout"])
        return cls(NetworkSpec(statistics_of_record(stored), bins, stored["layout"], hidden, *dropouts))

    @property
    def stored(self) -> nn.Module:
        """The layers: the rest follows from the description."""
        return self.layers
