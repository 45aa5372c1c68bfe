"""The network that scores a viewpoint, from binned landmarks to a logit."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from wheretolook.errors import ConfigError
from wheretolook.features import CHANNELS, INPUT_VARIANTS, Layout
from wheretolook.geometry import PinholeCamera
from wheretolook.learning.config import TrainConfig

STATISTICS_BLOCK = 256
"""Views worked through at a time when statistics are taken: few enough for a processor's cache."""


@dataclass(frozen=True)
class InputStatistics:
    """Mean and standard deviation of each kind of input over the filled bins of the training views.

    Attributes:
        channels: names of the channels, as in `wheretolook.features.CHANNELS`.
        mean: mean of each channel, in its unit (pixels or metres).
        std: standard deviation of each channel, in its unit; 1 where it would be 0.
    """

    channels: tuple[str, ...]
    mean: tuple[float, ...]
    std: tuple[float, ...]

    @classmethod
    def of(cls, means: Tensor, filled: Tensor, rows: Tensor, channels: tuple[str, ...] = CHANNELS) -> InputStatistics:
        """Statistics over the filled bins of some views.

        Args:
            means: (B, C, bins, bins) binned views, empty bins zero.
            filled: (B, bins, bins) bool.
            rows: views to use, (n,) int64.
            channels: names of the C channels.
        """
        rows = rows.to(means.device)
        count = torch.zeros((), dtype=torch.float64, device=means.device)
        total = torch.zeros(len(channels), dtype=torch.float64, device=means.device)
        for block in rows.split(STATISTICS_BLOCK):  # empty bins are zero: they add nothing to the sum
            count += filled[block].sum()
            total += means[block].sum((0, 2, 3), dtype=torch.float64)
        mean = total / count.clamp(min=1)
        squares = torch.zeros_like(total)
        for block in rows.split(STATISTICS_BLOCK):  # a second pass: no cancellation between large numbers
            centred = (means[block] - mean.float()[:, None, None]) * filled[block][:, None]
            squares += centred.square_().sum((0, 2, 3), dtype=torch.float64)
        std = (squares / count.clamp(min=1)).sqrt()
        std = torch.where(std > 0, std, 1.0)
        return cls(channels, tuple(mean.tolist()), tuple(std.tolist()))

    def select(self, channels: tuple[str, ...]) -> InputStatistics:
        """Statistics of some channels."""
        index = [self.channels.index(name) for name in channels]
        return InputStatistics(channels, tuple(self.mean[i] for i in index), tuple(self.std[i] for i in index))


@dataclass(frozen=True)
class NetworkSpec:
    """Everything that defines a network but its weights.

    Attributes:
        variant: name of the input variant.
        camera: camera of the training views; pixels mean something only with it.
        statistics: of the variant's channels over the training views.
        bins: bins along each side of the image.
        layout: order of the bins in the input.
        hidden: widths of the hidden layers.
        dropout: share of hidden units dropped in training.
        input_dropout: share of input values dropped in training.
    """

    variant: str
    camera: PinholeCamera
    statistics: InputStatistics
    bins: int = 30
    layout: Layout = "in_place"
    hidden: tuple[int, ...] = (300, 300)
    dropout: float = 0.5
    input_dropout: float = 0.0

    def __post_init__(self) -> None:
        if self.variant not in INPUT_VARIANTS:
            known = f"There are {', '.join(INPUT_VARIANTS)}."
            raise ConfigError("unknown input variant", value=self.variant, fix=known)
        if self.statistics.channels != self.channels:
            raise ConfigError(f"statistics of {self.statistics.channels} do not fit the input", value=self.variant)

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels of the input, in order."""
        return INPUT_VARIANTS[self.variant]

    @property
    def input_size(self) -> int:
        """Values the first layer takes in."""
        return len(self.channels) * self.bins**2


class BinnedInput(nn.Module):
    """Turns binned views into a network's standardized, flat input.

    Each channel is standardized by its kind (paper, Sec. 3.3 "Data"); empty bins are exactly zero afterwards, that is,
    the mean of their kind.

    Args:
        spec: variant, statistics, bins and layout.
    """

    index: Tensor
    mean: Tensor
    std: Tensor

    def __init__(self, spec: NetworkSpec) -> None:
        super().__init__()
        self.layout, self.input_size = spec.layout, spec.input_size
        # these follow from the specification, which is stored beside the weights: persistent=False
        self.register_buffer("index", torch.tensor([CHANNELS.index(name) for name in spec.channels]), persistent=False)
        self.register_buffer("mean", torch.tensor(spec.statistics.mean)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(spec.statistics.std)[:, None, None], persistent=False)

    def forward(self, means: Tensor, filled: Tensor) -> Tensor:
        """Means and filled, as `ViewpointNetwork.forward` takes them, to (B, input_size) float32."""
        if means.shape[1] != len(self.index):
            means = means.index_select(1, self.index)
        values = (means - self.mean) / self.std * filled[:, None]
        if self.layout == "compact":
            values = move_to_front(values, filled)
        return values.reshape(-1, self.input_size)


def move_to_front(values: Tensor, filled: Tensor) -> Tensor:
    """`wheretolook.features.arrange(..., "compact")` on tensors of any device.

    Args:
        values: (B, C, bins, bins), zero in empty bins.
        filled: (B, bins, bins) bool.
    """
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
    """Gaussian noise on filled bins, as the released code adds while training.

    Args:
        means: (B, C, bins, bins).
        filled: (B, bins, bins) bool; empty bins stay zero.
        noise_px: standard deviation on u and v.
        noise_m: standard deviation on x, y and z.
        channels: names of the C channels.
    """
    scale = means.new_tensor([noise_px if name in ("u", "v") else noise_m for name in channels])
    return means + torch.randn_like(means) * scale[:, None, None] * filled[:, None]


class ViewpointNetwork(nn.Module):
    """The paper's classifier (its architecture table): linear layers with ReLU and dropout between, one logit out.

    Args:
        spec: what defines it.
    """

    def __init__(self, spec: NetworkSpec) -> None:
        super().__init__()
        self.spec = spec
        self.input = BinnedInput(spec)
        layers: list[nn.Module] = [nn.Dropout(spec.input_dropout)] if spec.input_dropout > 0 else []
        width = spec.input_size
        for hidden in spec.hidden:
            layers += [nn.Linear(width, hidden), nn.ReLU(), nn.Dropout(spec.dropout)]
            width = hidden
        self.layers = nn.Sequential(*layers, nn.Linear(width, 1))

    def forward(self, means: Tensor, filled: Tensor) -> Tensor:
        """Logits (B,) of binned views.

        Args:
            means: (B, C, bins, bins) float32, with all of `CHANNELS` or with the variant's own alone.
            filled: (B, bins, bins) bool.
        """
        return self.layers(self.input(means, filled)).squeeze(-1)

    def augment(self, config: TrainConfig, means: Tensor, filled: Tensor) -> tuple[Tensor, Tensor]:
        """The views with the noise that the options ask for, if any."""
        if config.noise_px > 0 or config.noise_m > 0:
            means = add_noise(means, filled, config.noise_px, config.noise_m, self.spec.channels)
        return means, filled
