"""Export a set network to ONNX, from the landmarks of views to the probability that they localize."""

from __future__ import annotations

import io
import warnings
from copy import deepcopy
from math import sqrt
from typing import Any

import numpy as np
import onnx
import torch
from torch import Tensor, nn
from torch.nn.functional import logsigmoid

from wheretolook.dataset.thresholds import Accuracy
from wheretolook.scorers.set.accuracy import AccuracyModel
from wheretolook.scorers.set.network import CELLS, SetNetwork
from wheretolook.training.trained_network import TrainedNetwork

OPSET = 17  # of 2022: onnxruntime 1.12 and later reads the file
IR_VERSION = 8
INPUTS = ("values", "taken", "n_visible", "axis_height")
OUTPUTS = ("probability", "expected_inliers")


def pose_variances(information: Tensor) -> tuple[Tensor, Tensor]:
    """Invert information matrices (B, 6, 6) by Gauss-Jordan elimination, since ONNX has no Cholesky decomposition.

    Returns the diagonals of the inverses (B, 6) and the logarithms of the determinants (B,). Positive definite matrices
    need no pivoting.
    """
    unit = torch.eye(6, dtype=information.dtype)
    rows = torch.cat([information, unit.expand_as(information)], dim=-1)
    log_det = torch.zeros_like(information[:, 0, 0])
    for k in range(6):
        pivot = rows[:, k, k]
        log_det = log_det + pivot.log()
        row = (rows[:, k] / pivot[:, None])[:, None]
        rows = torch.where(unit[k, :, None] > 0, row, rows - rows[:, :, k, None] * row)
    return (rows[:, :, 6:] * unit).sum(-1), log_det


TAIL = (
    0.17087277,
    -0.82215223,
    1.48851587,
    -1.13520398,
    0.27886807,
    -0.18628806,
    0.09678418,
    0.37409196,
    1.00002368,
    -1.95865941,
)
"""Polynomial in the log of half the complementary error function, within 1.2e-7 (Numerical Recipes in C, 6.2)."""


def log_ndtr(x: Tensor) -> Tensor:
    """Return the log of the standard normal distribution function at x (...), which ONNX lacks."""
    t = 1 / (1 + x.abs() / sqrt(8))
    polynomial = torch.zeros_like(t)
    for coefficient in TAIL:
        polynomial = polynomial * t + coefficient
    below = t.log() - x * x / 2 + polynomial  # at -|x|
    return torch.where(x > 0, torch.log1p(-below.exp()), below)


class RobotNetwork(nn.Module):
    """A calibrated set network, with probabilities at an accuracy, on views padded with landmarks that are not theirs."""

    borders: Tensor

    def __init__(self, trained: TrainedNetwork[SetNetwork], accuracy: Accuracy) -> None:
        super().__init__()
        self.trained = trained
        self.accuracy = accuracy
        self.network = deepcopy(trained.network).cpu().eval()
        self.network.pose_variances = pose_variances
        # tangents of the borders of the cells, rounded up, so that no rounding of an arctangent decides
        exact = np.tan((np.arange(1, CELLS) / CELLS - 0.5) * np.pi)
        single = exact.astype(np.float32)
        single = np.where(single < exact, np.nextafter(single, np.float32(np.inf)), single)
        self.register_buffer("borders", torch.from_numpy(single))

    def forward(
        self, values: Tensor, n_sampled: Tensor, n_visible: Tensor, axis_height: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Score B views.

        Args:
            values: (B, K, A) float32, attributes of at most K landmarks of each view.
            n_sampled: (B,) int64, number of these landmarks that are the view's.
            n_visible: (B,) int64, number of visible landmarks.
            axis_height: (B,) float32, z of the optical axis in the world.

        Returns:
            Probabilities to localize (B,) float64 and expected inliers (B,) float32.
        """
        network = self.network
        log_odds = network.matchability(values)
        own = torch.arange(values.shape[1]) < n_sampled[:, None]
        each = (n_visible.double() / n_sampled.clamp(min=1))[:, None]  # visible landmarks per sampled one
        sums = (network.parts(values, log_odds).double() * own[..., None]).sum(1) * each
        is_own = self.accuracy == self.trained.accuracy
        cells = self._expected_cells(values, log_odds, own, each) if network.needs_cells or not is_own else None
        view = sums, n_visible, axis_height, cells
        probability = self.trained.calibrated(network.logits(*view).double()).sigmoid()
        if not is_own:
            known = self.trained.accuracy, probability, network.statistics_of(*view).double()
            probability = AccuracyModel.bundled().at(self.accuracy, *known, torch, log_ndtr)
        return probability, sums[:, 0].float()

    def _expected_cells(self, values: Tensor, log_odds: Tensor, own: Tensor, each: Tensor) -> Tensor:
        """Compute `expected_cells` (B,) of padded views."""
        column, row = (
            (values[..., self.network.attributes.index(name), None] >= self.borders).sum(-1)
            for name in ("across", "down")
        )
        missed = torch.where(own, logsigmoid(-log_odds).double(), torch.zeros((), dtype=torch.float64))
        log_missed = torch.zeros(values.shape[0], CELLS**2, dtype=torch.float64)
        log_missed = log_missed.scatter_add(1, row * CELLS + column, missed)
        return (1 - (log_missed * each).exp()).sum(1)


def set_graph(trained: TrainedNetwork[SetNetwork], accuracy: Accuracy) -> Any:
    """Return the `onnx.ModelProto` of a `RobotNetwork`, with its inputs and outputs."""
    example = (torch.zeros(2, 3, len(trained.network.attributes)), torch.tensor([3, 2]), torch.tensor([5, 2]))
    axes = {name: {0: "B"} for name in (*INPUTS, *OUTPUTS)}
    axes["values"] = {0: "B", 1: "K"}
    file: Any = io.BytesIO()
    with warnings.catch_warnings(action="ignore"):  # the default exporter needs another package
        torch.onnx.export(
            RobotNetwork(trained, accuracy),
            (*example, torch.zeros(2)),
            file,
            dynamo=False,
            opset_version=OPSET,
            input_names=INPUTS,
            output_names=OUTPUTS,
            dynamic_axes=axes,
        )
    model = onnx.load_from_string(file.getvalue())
    model.ir_version = IR_VERSION
    onnx.checker.check_model(model, full_check=True)
    return model
