"""Networks over binned landmarks, their input statistics, and the scorer of a trained one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from wheretolook.geometry.poses import Float, check_poses
from wheretolook.inputs.bins import BinnedViews
from wheretolook.inputs.channels import ALL_CHANNELS, CHANNELS, Layout
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.inputs.statistics import FeatureStatistics
from wheretolook.scorers.base import BLOCK, BinnedScorer, check_field_of_view
from wheretolook.scorers.mlp import MlpConfig
from wheretolook.training.trained_network import (
    RangeWatch,
    StoredNetwork,
    TrainedNetwork,
    TrainingRange,
    bin_quantities,
)


class BinnedNetwork(StoredNetwork):
    """A network with inputs means (B, C, bins, bins) of its channels and filled bins (B, bins, bins)."""

    statistics: FeatureStatistics
    bins: int
    scored_at_once: int = 4096


def statistics_record(statistics: FeatureStatistics) -> dict[str, Any]:
    """Return statistics of channels as the JSON values of a header."""
    return {"channels": statistics.names, **statistics.record()}


def statistics_of_record(stored: Mapping[str, Any]) -> FeatureStatistics:
    """Return the statistics of channels in the header of weights; ValueError for an unknown channel."""
    record = stored["statistics"]
    return FeatureStatistics.of_record(tuple(record["channels"]), record, ALL_CHANNELS)


class StandardBins(nn.Module):
    """Standardizes the channels of binned views by the mean and deviation of their kind (paper, Sec. 3.3 "Data").

    Empty bins become zero, the mean; so do unknown values of landmark channels. Positions, in the first channels, are
    always known: a NaN there stays, since it is an error.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, statistics: FeatureStatistics) -> None:
        super().__init__()
        channels = statistics.names
        self.n_certain = next((i for i, name in enumerate(channels) if name not in CHANNELS), len(channels))
        # not persistent: the header of weights stores them
        self.register_buffer("mean", torch.tensor(statistics.mean)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(statistics.std)[:, None, None], persistent=False)

    def forward(self, means: Tensor, filled: Tensor) -> Tensor:
        """Return standardized means (B, C, bins, bins), zero where bins are not `filled` (B, bins, bins)."""
        values = (means - self.mean) / self.std * filled[:, None]
        if values.shape[1] > self.n_certain:
            of_landmarks = values[:, self.n_certain :]
            of_landmarks.masked_fill_(of_landmarks.isnan(), 0.0)
        return values


class BinnedNetworkScorer(BinnedScorer):
    """Predicts the probability that a view localizes, by a network over its binned landmarks.

    Pixels of a camera with another resolution but the training camera's field of view are scaled; a camera with another
    field of view raises a CameraError. Views are in range if the mean depth of their bins is; `score` warns once if not.
    """

    def __init__(self, localization_map: LocalizationMap, trained: TrainedNetwork[Any]) -> None:
        network: BinnedNetwork = trained.network
        self.channels = network.statistics.names
        super().__init__(localization_map, network.bins, not {*self.channels} <= {*CHANNELS})
        camera = localization_map.camera
        self.device = localization_map.device
        trained_camera = check_field_of_view(trained.camera, camera)
        self.name = trained.method
        self.trained = trained
        self.training_range = trained.training_range or TrainingRange({})
        self._watch = RangeWatch(bool(self.training_range.bounds))
        self.network: Any = network.to(self.device).eval()
        pixels = {"u": trained_camera.width / camera.width, "v": trained_camera.height / camera.height}
        scales = [pixels.get(name, 1.0) for name in self.channels]
        self._scale = torch.tensor(scales, device=self.device)[:, None, None]

    def score_bins(self, binned: BinnedViews) -> Float:
        """(B,) probabilities in [0, 1]."""
        if self._watch.watching and "z" in binned.channels:
            self._watch.check(self.name, self.training_range, [_depths(binned)])
        binned = binned if binned.channels == self.channels else binned.select(self.channels)
        scores = np.empty(len(binned))
        block = self.network.scored_at_once
        # TF32 would let a score depend on how many views are scored with it
        with torch.inference_mode(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            for begin in range(0, len(scores), block):
                rows = slice(begin, begin + block)
                means = torch.from_numpy(binned.means[rows]).to(self.device) * self._scale
                filled = torch.from_numpy(binned.counts[rows] > 0).to(self.device)
                # float64 keeps views apart whose probabilities round to 1 in float32
                logits = self.network(means, filled).double()
                scores[rows] = self.trained.calibrated(logits).sigmoid().cpu().numpy()
        return scores

    def in_range(self, cam_from_world: Float) -> NDArray[np.bool_]:
        """Return which poses (B, 3, 4) have depths in the range of the training views, (B,) bool."""
        cam_from_world = check_poses(cam_from_world)
        inside = np.ones(len(cam_from_world), dtype=bool)
        for begin in range(0, len(inside) if self.training_range.bounds else 0, BLOCK):
            binned = self.localization_map.bin_views(cam_from_world[begin : begin + BLOCK], self.bins)
            inside[begin : begin + BLOCK] = self.training_range.contains(_depths(binned))
        return inside


def _depths(binned: BinnedViews) -> Float:
    depths = binned.means[:, binned.channels.index("z")].sum((1, 2), dtype=np.float64)
    return bin_quantities(depths, binned.n_filled)


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
        return cls(
            NetworkSpec(
                statistics_of_record(stored),
                int(stored["bins"]),
                stored["layout"],
                tuple(stored["hidden"]),
                float(stored["dropout"]),
                float(stored["input_dropout"]),
            )
        )

    @property
    def stored(self) -> nn.Module:
        """The layers: the rest follows from the description."""
        return self.layers
