"""A network that scores all directions at a location at once, like ActLoc (2025).

Landmarks and mapping cameras are input tokens, logits of 6 pitches x 18 yaws the output. A pose's logit is interpolated
at its direction; roll is ignored.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor, nn

from wheretolook.geometry.lattices import axes_of_angles, yaw_pitch_angles
from wheretolook.training.config import FittingConfig
from wheretolook.training.data import check_classes, validation_views
from wheretolook.training.fit import home_device
from wheretolook.training.learner import TrainingJob, TrainingResult, train_network
from wheretolook.training.provenance import training_scenes
from wheretolook.training.trained_network import StoredNetwork
from wheretolook.utils.errors import WeightsError
from wheretolook_paper.scorers.sphere import SphereConfig
from wheretolook_paper.scorers.sphere.views import FEATURES, TOWARDS, TURNING, SphereDataModule, load_sphere_views

PITCHES = 6  # rows and columns of the lattice, `wheretolook.geometry.lattices.yaw_pitch_angles`
YAWS = 18

LOWEST_PITCH_DEG = -60.0
FIRST_YAW_DEG = -180.0
STEP_DEG = 20.0
"""Where the lattice begins, and the angle between its neighbours."""


def on_lattice(values: Tensor, rows: Tensor, axes: Tensor) -> Tensor:
    """Interpolate values (B,) of lattices `rows` (B,) among (L, PITCHES, YAWS) at directions (B, 3), world axes.

    Yaw wraps, pitch ends at the outer rows. The directions need not be of unit length.
    """
    x, y, z = axes.unbind(1)
    yaw = torch.rad2deg(torch.atan2(y, x))
    pitch = torch.rad2deg(torch.atan2(z, torch.hypot(x, y)))
    column = (yaw - FIRST_YAW_DEG) / STEP_DEG
    row = ((pitch - LOWEST_PITCH_DEG) / STEP_DEG).clamp(0, PITCHES - 1)
    left = column.floor()
    low = row.floor().clamp(max=PITCHES - 2)
    across = column - left
    up = row - low
    left = left.long() % YAWS
    low = low.long()
    right = (left + 1) % YAWS
    below = values[rows, low, left] * (1 - across) + values[rows, low, right] * across
    above = values[rows, low + 1, left] * (1 - across) + values[rows, low + 1, right] * across
    return below * (1 - up) + above * up


class SphereNetwork(StoredNetwork):
    """Attention among tokens, then among the directions of the lattice and from these to the tokens.

    The directions of tokens and of the lattice share one encoding.
    """

    lattice: Tensor

    def __init__(self, config: SphereConfig) -> None:
        super().__init__()
        self.config = config
        width = config.width
        options: dict[str, Any] = {"nhead": config.heads, "dim_feedforward": 2 * width, "dropout": config.dropout}
        options |= {"activation": "gelu", "batch_first": True, "norm_first": True}
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
        """Return logits (L, PITCHES, YAWS) of all directions at locations of tokens (L, T, len(FEATURES)).

        The padding (L, T) is True where there is no token; None if all are.
        """
        hidden = self.token(tokens) + self.direction(tokens[..., TOWARDS])
        for layer in self.among_tokens:
            hidden = layer(hidden, src_key_padding_mask=padding)
        queries = (self.query + self.direction(self.lattice)).expand(len(tokens), -1, -1)
        cells = self.to_tokens(queries, self.memory_norm(hidden), memory_key_padding_mask=padding)
        logits: Tensor = self.logit(cells).view(len(tokens), PITCHES, YAWS)
        return logits

    def forward(self, tokens: Tensor, padding: Tensor, rows: Tensor, axes: Tensor) -> Tensor:
        """Return logits (B,) of views with optical axes (B, 3), world, at the locations `rows` (B,) of `encode`."""
        if not len(rows):  # one process's share of a small batch
            return axes.sum(1) + 0 * sum(parameter.sum() for parameter in self.parameters())
        return on_lattice(self.encode(tokens, padding), rows, axes)

    def augment(self, options: FittingConfig, tokens: Tensor, padding: Tensor, rows: Tensor, axes: Tensor) -> Any:
        """Rotate each location and its views about the vertical by a random angle."""
        angle = 2 * torch.pi * torch.rand(len(tokens), device=tokens.device)
        cos = angle.cos()
        sin = angle.sin()
        none = torch.zeros_like(angle)
        turn = torch.stack([cos, -sin, none, sin, cos, none, none, none, none + 1], dim=1).view(-1, 3, 3)
        vectors = tokens[..., :TURNING].unflatten(-1, (-1, 3)) @ turn.mT[:, None]
        turned = torch.cat([vectors.flatten(-2), tokens[..., TURNING:]], dim=-1)
        return turned, padding, rows, torch.einsum("bij,bj->bi", turn[rows], axes)

    def description(self) -> dict[str, Any]:
        """Return the features of tokens, and the options."""
        return {"features": list(FEATURES), "options": asdict(self.config)}

    @classmethod
    def of_description(cls, stored: Mapping[str, Any]) -> SphereNetwork:
        """Return the untrained network of a description; a WeightsError if it was trained on other tokens."""
        if stored.get("features") != list(FEATURES):
            raise WeightsError("these weights were trained on other features of tokens")
        return cls(SphereConfig(**stored["options"]))


def learn_sphere(task: TrainingJob) -> TrainingResult:
    """Train a `SphereNetwork` on a dataset's train scenes, calibrated on the validation views.

    Raises a TableError if there is no train scene, no labels, or labels of one class only; a MapError if a scene's
    mapping cameras are not known.
    """
    dataset = task.dataset
    config = task.config
    scenes = training_scenes(dataset)
    device = home_device(config)
    views = load_sphere_views(dataset, scenes, config, task.options, device, task.progress)
    held_out = validation_views(dataset, views.scene, views.location, config)
    labels = views.labels.numpy() > 0
    check_classes(dataset, config, labels[~held_out], labels[held_out])
    data = SphereDataModule(views, held_out, task.options.batch_size, config)
    return train_network(SphereNetwork(task.options), data, task)
