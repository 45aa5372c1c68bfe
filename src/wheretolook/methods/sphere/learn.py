"""A network that scores the whole sphere of directions at a location at once, in the manner of ActLoc (2025).

Landmarks and mapping cameras go in as tokens, the logits of 6 pitches x 18 yaws come out. A pose's logit is read off
between them, at the direction it looks in; roll does not count.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import axes_of_angles, yaw_pitch_angles
from wheretolook.learning.config import SPHERE, TrainConfig
from wheretolook.learning.data import check_classes, training_scenes, validation_views
from wheretolook.learning.fit import home_device
from wheretolook.learning.learner import Learnt, Task, class_counts, fit_network, predict
from wheretolook.learning.platt import fit_platt
from wheretolook.learning.weights import check_kind, read_weights, write_weights
from wheretolook.methods.sphere.config import SphereConfig
from wheretolook.methods.sphere.views import FEATURES, TOWARDS, TURNING, SphereDataModule, load_sphere_views
from wheretolook.utils.errors import ConfigError, WeightsError

PITCHES, YAWS = 6, 18
"""Rows and columns of the lattice, `wheretolook.geometry.lattices.yaw_pitch_angles`."""

LOWEST_PITCH_DEG, FIRST_YAW_DEG, STEP_DEG = -60.0, -180.0, 20.0
"""Where the lattice begins, and the angle between its neighbours."""


def on_lattice(values: Tensor, rows: Tensor, axes: Tensor) -> Tensor:
    """Values of lattices at directions, interpolated between the four around; yaw wraps, pitch ends at the outer rows.

    Args:
        values: (L, PITCHES, YAWS).
        rows: (B,) int64, the lattice of each direction.
        axes: (B, 3) directions, world axes, need not be of unit length.

    Returns:
        (B,).
    """
    x, y, z = axes.unbind(1)
    yaw = torch.rad2deg(torch.atan2(y, x))
    pitch = torch.rad2deg(torch.atan2(z, torch.hypot(x, y)))
    column = (yaw - FIRST_YAW_DEG) / STEP_DEG
    row = ((pitch - LOWEST_PITCH_DEG) / STEP_DEG).clamp(0, PITCHES - 1)
    left, low = column.floor(), row.floor().clamp(max=PITCHES - 2)
    across, up = column - left, row - low
    left, low = left.long() % YAWS, low.long()
    right = (left + 1) % YAWS
    below = values[rows, low, left] * (1 - across) + values[rows, low, right] * across
    above = values[rows, low + 1, left] * (1 - across) + values[rows, low + 1, right] * across
    return below * (1 - up) + above * up


class SphereNetwork(nn.Module):
    """Tokens attend to each other; then the directions of the lattice to each other and to the tokens.

    The directions of tokens and of the lattice are told alike, so that each can find the other.

    Args:
        config: width, heads, layers and dropout.
    """

    lattice: Tensor

    def __init__(self, config: SphereConfig) -> None:
        super().__init__()
        width = config.width
        options: dict[str, Any] = {
            "nhead": config.heads, "dim_feedforward": 2 * width, "dropout": config.dropout, "activation": "gelu",
            "batch_first": True, "norm_first": True,
        }  # fmt: skip
        self.token = nn.Sequential(nn.Linear(len(FEATURES), width), nn.GELU(), nn.Linear(width, width))
        self.among_tokens = nn.ModuleList(nn.TransformerEncoderLayer(width, **options) for _ in range(config.layers))
        self.memory_norm = nn.LayerNorm(width)
        self.query = nn.Parameter(0.02 * torch.randn(PITCHES * YAWS, width))
        self.direction = nn.Sequential(nn.Linear(3, width), nn.GELU(), nn.Linear(width, width))
        self.to_tokens = nn.TransformerDecoderLayer(width, **options)
        self.logit = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 1))
        lattice = torch.from_numpy(axes_of_angles(yaw_pitch_angles())).float()
        self.register_buffer("lattice", lattice, persistent=False)

    def encode(self, tokens: Tensor, padding: Tensor | None = None) -> Tensor:
        """Logits (L, PITCHES, YAWS) of all directions at locations.

        Args:
            tokens: (L, T, len(FEATURES)).
            padding: (L, T) bool, True where there is no token; None if all are.
        """
        hidden = self.token(tokens) + self.direction(tokens[..., TOWARDS])
        for layer in self.among_tokens:
            hidden = layer(hidden, src_key_padding_mask=padding)
        queries = (self.query + self.direction(self.lattice)).expand(len(tokens), -1, -1)
        cells = self.to_tokens(queries, self.memory_norm(hidden), memory_key_padding_mask=padding)
        logits: Tensor = self.logit(cells).view(len(tokens), PITCHES, YAWS)
        return logits

    def forward(self, tokens: Tensor, padding: Tensor, rows: Tensor, axes: Tensor) -> Tensor:
        """Logits (B,) of views.

        Args:
            tokens: (L, T, len(FEATURES)), of the locations that they share.
            padding: (L, T) bool, True where there is no token.
            rows: (B,) int64, location of each view.
            axes: (B, 3) optical axes, world.
        """
        if not len(rows):  # one process's share of a small batch
            return axes.sum(1) + 0 * sum(parameter.sum() for parameter in self.parameters())
        return on_lattice(self.encode(tokens, padding), rows, axes)

    def augment(self, config: TrainConfig, tokens: Tensor, padding: Tensor, rows: Tensor, axes: Tensor) -> Any:
        """Each location and its views, turned about the vertical by an angle of its own."""
        angle = 2 * torch.pi * torch.rand(len(tokens), device=tokens.device)
        cos, sin, none = angle.cos(), angle.sin(), torch.zeros_like(angle)
        turn = torch.stack([cos, -sin, none, sin, cos, none, none, none, none + 1], dim=1).view(-1, 3, 3)
        vectors = tokens[..., :TURNING].unflatten(-1, (-1, 3)) @ turn.mT[:, None]
        turned = torch.cat([vectors.flatten(-2), tokens[..., TURNING:]], dim=-1)
        return turned, padding, rows, torch.einsum("bij,bj->bi", turn[rows], axes)


@dataclass(frozen=True, eq=False)
class SphereModel:
    """A trained network, calibrated.

    Attributes:
        network: gives log-odds.
        config: its options.
        camera: whose views it has learnt from.
        scale, offset: what turns its log-odds into calibrated ones: scale * logit + offset.
    """

    network: SphereNetwork
    config: SphereConfig
    camera: PinholeCamera
    scale: float = 1.0
    offset: float = 0.0

    def to(self, device: str) -> SphereModel:
        """The same model, ready to score on a device."""
        return replace(self, network=self.network.to(device).eval().requires_grad_(False))

    def lattice_logits(self, tokens: Tensor) -> Tensor:
        """Calibrated log-odds (PITCHES, YAWS) float64 of all directions at the location of tokens (T, len(FEATURES)).

        A location is encoded alone: beside others its logits would differ in their last digits.
        """
        with torch.inference_mode():
            return self.scale * self.network.encode(tokens[None])[0].double() + self.offset

    def save(self, path: Path, training: dict[str, Any] | None = None) -> None:
        """Write one safetensors file, atomically. The same model gives the same bytes.

        Args:
            path: file to write; its folder is made when needed.
            training: what else to keep about the training (JSON values).
        """
        header = {
            "kind": SPHERE, "features": list(FEATURES),
            "camera": asdict(self.camera), "options": asdict(self.config), "scale": self.scale, "offset": self.offset,
            "training": training or {},
        }  # fmt: skip
        write_weights(path, self.network.state_dict(), header)

    @classmethod
    def load(cls, path: str | Path) -> SphereModel:
        """Read what `save` wrote, ready to score.

        Raises:
            WeightsError: the file is missing, damaged, foreign, of another kind, or does not fit its own description.
        """
        tensors, header = read_weights(Path(path))
        check_kind(path, header, SPHERE)
        fix = "Train again, or give weights of sphere."
        if header.get("features") != list(FEATURES):
            raise WeightsError("these weights ask for other tokens", path=path, fix=fix)
        try:
            config, camera = SphereConfig(**header["options"]), PinholeCamera(**header["camera"])
            scale, offset = float(header["scale"]), float(header["offset"])
            network = SphereNetwork(config)
        except (KeyError, TypeError, ValueError, ConfigError) as error:
            raise WeightsError(f"damaged description in the header: {error}", path=path, fix=fix) from error
        try:
            network.load_state_dict(tensors)
        except RuntimeError as error:
            message = f"the weights do not fit the network they describe: {error}"
            raise WeightsError(message, path=path, fix=fix) from error
        return cls(network, config, camera, scale, offset).to("cpu")


def learn_sphere(task: Task) -> Learnt:
    """A `SphereNetwork` from a dataset's train scenes, calibrated on the validation views.

    Raises:
        TableError: no train scene, no labels, or labels of one class only.
        MapError: a scene's mapping cameras are not known.
    """
    dataset, config = task.dataset, task.config
    views = load_sphere_views(dataset, training_scenes(dataset), config, home_device(config), task.progress)
    held_out = validation_views(dataset, views.scene, views.location, config)
    labels = views.labels.numpy() > 0
    for name, side in (("training", ~held_out), ("validation", held_out)):
        check_classes(name, labels[side], dataset, config)
    data, network = SphereDataModule(views, held_out, config), SphereNetwork(config.sphere)
    metrics, history = fit_network(network, data, task)
    scale, offset = fit_platt(*predict(network, data))
    model = SphereModel(network, config.sphere, dataset.camera, scale, offset)
    return Learnt(model, metrics, class_counts(train=labels[~held_out], val=labels[held_out]), history)
