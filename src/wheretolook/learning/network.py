"""The network that scores a viewpoint, from binned landmarks to a logit."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from wheretolook.errors import ConfigError
from wheretolook.features import ALL_CHANNELS, CHANNELS, INPUT_VARIANTS, Layout
from wheretolook.geometry import PinholeCamera
from wheretolook.learning.config import TrainConfig

STATISTICS_BLOCK = 256
"""Views worked through at a time when statistics are taken: few enough for a processor's cache."""


@dataclass(frozen=True)
class InputStatistics:
    """Mean and standard deviation of each kind of input over the filled bins of the training views.

    Attributes:
        channels: names of the channels, as in `wheretolook.features.ALL_CHANNELS`.
        mean: mean of each channel, in its unit (such as pixels or metres), over the values that are known.
        std: standard deviation of each channel, in its unit; 1 where it would be 0. Infinite where no value is known,
            so that a network does not look at a channel that it has never seen.
    """

    channels: tuple[str, ...]
    mean: tuple[float, ...]
    std: tuple[float, ...]

    @classmethod
    def of(cls, means: Tensor, filled: Tensor, rows: Tensor, channels: tuple[str, ...] = CHANNELS) -> InputStatistics:
        """Statistics over the filled bins of some views.

        Args:
            means: (B, C, bins, bins) binned views, empty bins zero, NaN where a value is not known.
            filled: (B, bins, bins) bool.
            rows: views to use, (n,) int64.
            channels: names of the C channels.
        """
        rows = rows.to(means.device)
        total = torch.zeros(len(channels), dtype=torch.float64, device=means.device)
        n_filled, unknown = torch.zeros_like(total), torch.zeros_like(total)
        for block in rows.split(STATISTICS_BLOCK):  # empty bins are zero: they add nothing to the sum
            values = means[block]
            n_filled += filled[block].sum()
            unknown += values.isnan().sum((0, 2, 3))
            total += values.nan_to_num_().sum((0, 2, 3), dtype=torch.float64)
        count = (n_filled - unknown).clamp(min=1)
        mean = total / count
        squares = torch.zeros_like(total)
        for block in rows.split(STATISTICS_BLOCK):  # a second pass: no cancellation between large numbers
            centred = (means[block] - mean.float()[:, None, None]) * filled[block][:, None]
            squares += centred.nan_to_num_().square_().sum((0, 2, 3), dtype=torch.float64)
        std = (squares / count).sqrt()
        std = torch.where(std > 0, std, 1.0)
        std = torch.where((n_filled > 0) & (unknown == n_filled), torch.inf, std)
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


def standardize(means: Tensor, filled: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Standardize each channel by its kind (paper, Sec. 3.3 "Data").

    Empty bins are exactly zero afterwards, that is, the mean of their kind; so are landmark channels where a value is
    not known.

    Args:
        means: (B, C, bins, bins).
        filled: (B, bins, bins) bool.
        mean, std: (C, 1, 1).

    Returns:
        (B, C, bins, bins).
    """
    values = (means - mean) / std * filled[:, None]
    if values.shape[1] > len(CHANNELS):  # where landmarks lie is always known: a NaN there is an error to be seen
        of_landmarks = values[:, len(CHANNELS) :]
        of_landmarks.masked_fill_(of_landmarks.isnan(), 0.0)
    return values


class BinnedInput(nn.Module):
    """Turns binned views into a network's standardized, flat input.

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
        self.register_buffer(
            "index", torch.tensor([ALL_CHANNELS.index(name) for name in spec.channels]), persistent=False
        )
        self.register_buffer("mean", torch.tensor(spec.statistics.mean)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(spec.statistics.std)[:, None, None], persistent=False)

    def forward(self, means: Tensor, filled: Tensor) -> Tensor:
        """Means and filled, as `ViewpointNetwork.forward` takes them, to (B, input_size) float32."""
        if means.shape[1] != len(self.index):
            means = means.index_select(1, self.index)
        values = standardize(means, filled, self.mean, self.std)
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
        noise_m: standard deviation on x, y and z. What landmarks are like stays as it is.
        channels: names of the C channels.
    """
    of_kind = {"u": noise_px, "v": noise_px, "x": noise_m, "y": noise_m, "z": noise_m}
    scale = means.new_tensor([of_kind.get(name, 0.0) for name in channels])
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
            means: (B, C, bins, bins) float32, with all of `CHANNELS` or `ALL_CHANNELS`, or the variant's own alone.
            filled: (B, bins, bins) bool.
        """
        return self.layers(self.input(means, filled)).squeeze(-1)

    def augment(self, config: TrainConfig, means: Tensor, filled: Tensor) -> tuple[Tensor, Tensor]:
        """The views with the noise that the options ask for, if any."""
        if config.noise_px > 0 or config.noise_m > 0:
            means = add_noise(means, filled, config.noise_px, config.noise_m, self.spec.channels)
        return means, filled
