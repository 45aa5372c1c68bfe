"""A small convolutional network over the grid of bins: the paper's input kept as the image that it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import relu

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.inputs.bins import ALL_CHANNELS, InputStatistics
from wheretolook.learning.config import CONV
from wheretolook.learning.data import ViewpointDataModule
from wheretolook.learning.fit import home_device
from wheretolook.learning.learner import Learnt, Task, class_counts, fit_network, predict
from wheretolook.learning.platt import fit_platt
from wheretolook.learning.weights import check_kind, read_weights, stored_statistics, write_weights
from wheretolook.methods.mlp.network import standardize
from wheretolook.utils.errors import ConfigError, WeightsError


@dataclass(frozen=True)
class ConvSpec:
    """Everything that defines a convolutional network but its weights.

    Attributes:
        camera: camera of the training views; pixels mean something only with it.
        statistics: of `ALL_CHANNELS` over the training views.
        bins: bins along each side of the image.
        widths: channels after each convolution.
        dropout: share of pooled values dropped in training.
    """

    camera: PinholeCamera
    statistics: InputStatistics
    bins: int
    widths: tuple[int, ...]
    dropout: float

    def __post_init__(self) -> None:
        if self.statistics.channels != ALL_CHANNELS:
            raise ConfigError("statistics of other channels than the network's", value=self.statistics.channels)


class ConvNetwork(nn.Module):
    """Convolutions of 3 x 3 bins with ReLU between, the mean and the maximum over the image, one logit out.

    It looks at all channels, standardized, and at which bins are filled. Nothing is normalized on the way: how much
    there is to see is what matters most, and a normalization would hide it.

    Args:
        spec: what defines it.

    Attributes:
        scale, offset: what turns its logit into calibrated log-odds: scale * logit + offset.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, spec: ConvSpec) -> None:
        super().__init__()
        self.spec, self.scale, self.offset = spec, 1.0, 0.0
        # these follow from the specification, which is stored beside the weights: persistent=False
        self.register_buffer("mean", torch.tensor(spec.statistics.mean)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(spec.statistics.std)[:, None, None], persistent=False)
        before = (len(ALL_CHANNELS) + 1, *spec.widths)
        self.convolutions = nn.ModuleList(
            nn.Conv2d(width_in, width_out, 3, stride=1 if index == 0 else 2, padding=1)
            for index, (width_in, width_out) in enumerate(zip(before, spec.widths, strict=False))
        )
        self.dropout = nn.Dropout(spec.dropout)
        self.last = nn.Linear(2 * spec.widths[-1], 1)

    def forward(self, means: Tensor, filled: Tensor) -> Tensor:
        """Logits (B,) of binned views, not calibrated.

        Args:
            means: (B, len(ALL_CHANNELS), bins, bins) float32.
            filled: (B, bins, bins) bool.
        """
        values = torch.cat([standardize(means, filled, self.mean, self.std), filled[:, None].to(means.dtype)], dim=1)
        for convolution in self.convolutions:
            values = relu(convolution(values))
        pooled = torch.cat([values.mean((2, 3)), values.amax((2, 3))], dim=1)
        logits: Tensor = self.last(self.dropout(pooled))
        return logits.squeeze(-1)

    def log_odds(self, means: Tensor, filled: Tensor) -> Tensor:
        """Calibrated log-odds (B,) float64 of binned views, as `forward` takes them."""
        # float64 keeps views apart whose probabilities round to 1 in float32
        return self.scale * self(means, filled).double() + self.offset

    def save(self, path: Path, training: Mapping[str, Any] | None = None) -> None:
        """Write one safetensors file, atomically. The same network gives the same bytes.

        Args:
            path: file to write; its folder is made when needed.
            training: what else to keep about the training (JSON values).
        """
        header = {
            "kind": CONV, **asdict(self.spec), "scale": self.scale, "offset": self.offset,
            "training": dict(training or {}),
        }  # fmt: skip
        write_weights(path, self.state_dict(), header)

    @classmethod
    def load(cls, path: str | Path, device: str = "cpu") -> ConvNetwork:
        """Read what `save` wrote, ready to score (dropout off).

        Args:
            path: a safetensors file.
            device: torch device of the network.

        Raises:
            WeightsError: the file is missing, damaged, foreign, of another kind, or does not fit its own description.
        """
        tensors, header = read_weights(Path(path))
        check_kind(path, header, CONV)
        fix = "Train again, or give weights of a convolutional network."
        try:
            network = cls(
                ConvSpec(
                    camera=PinholeCamera(**header["camera"]),
                    statistics=stored_statistics(header["statistics"]),
                    bins=int(header["bins"]),
                    widths=tuple(header["widths"]),
                    dropout=float(header["dropout"]),
                )
            )
            network.scale, network.offset = float(header["scale"]), float(header["offset"])
        except (KeyError, TypeError, ValueError, IndexError, ConfigError) as error:
            raise WeightsError(f"damaged description in the header: {error}", path=path, fix=fix) from error
        try:
            network.load_state_dict(tensors)
        except RuntimeError as error:
            raise WeightsError(
                f"the weights do not fit the network they describe: {error}", path=path, fix=fix
            ) from error
        return network.to(device).eval().requires_grad_(False)


def learn_conv(task: Task) -> Learnt:
    """A convolutional network from a dataset's train scenes, calibrated on the validation views.

    Raises:
        TableError: no train scene, no labels, or labels of one class only.
        MapError: a scene has no landmarks.
        ConfigError: there are fewer GPUs than asked for, or the views do not fit into memory shared by processes.
    """
    options = task.config.conv
    config, device = replace(task.config, bins=options.bins), home_device(task.config)
    data = ViewpointDataModule(task.dataset, config, device, task.progress, landmark_channels=True)
    data.setup()
    network = ConvNetwork(ConvSpec(task.dataset.camera, data.statistics, options.bins, options.widths, options.dropout))
    metrics, history = fit_network(network, data, task)
    network.scale, network.offset = fit_platt(*predict(network.to(device), data))
    labels = data.views.labels.cpu()
    counts = class_counts(train=labels[data.train_rows].numpy(), val=labels[data.val_rows].numpy())
    return Learnt(network.cpu(), metrics, counts, history)
