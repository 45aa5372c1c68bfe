"""The network that scores a viewpoint, from binned landmarks to a logit."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.inputs.bins import ALL_CHANNELS, CHANNELS, INPUT_VARIANTS, InputStatistics, Layout
from wheretolook.learning.config import TrainConfig
from wheretolook.utils.errors import ConfigError


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
    """`wheretolook.inputs.bins.arrange(..., "compact")` on tensors of any device.

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
