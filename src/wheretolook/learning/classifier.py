"""Training of a viewpoint network: loss, regularization, optimizer and validation metrics."""

from __future__ import annotations

from typing import Any

import torch
from lightning.pytorch import LightningModule
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits
from torchmetrics import MetricCollection
from torchmetrics.classification import BinaryAUROC, BinaryAveragePrecision, BinaryCalibrationError

from wheretolook.features import CHANNELS
from wheretolook.learning.config import TrainConfig
from wheretolook.learning.data import Batch
from wheretolook.learning.network import ViewpointNetwork

CALIBRATION_BINS = 15
"""Equal-width bins of the expected calibration error (Guo et al., ICML 2017)."""


def weighted_bce(logits: Tensor, labels: Tensor, class_weights: tuple[float, float]) -> Tensor:
    """Mean weighted binary cross-entropy on logits (paper, Sec. 3.3), a scalar.

    Args:
        logits: (B,).
        labels: (B,) float, 0 or 1.
        class_weights: weights of the negative and the positive class.
    """
    negative, positive = class_weights
    weights = negative + (positive - negative) * labels
    return binary_cross_entropy_with_logits(logits, labels, weight=weights)


def weight_penalty(module: nn.Module) -> Tensor:
    """Sum of the squares of all weight matrices, a scalar. Biases are left out (the paper's sum is over W_l)."""
    squares = [layer.weight.square().sum() for layer in module.modules() if isinstance(layer, nn.Linear)]
    return torch.stack(squares).sum()


def add_noise(means: Tensor, filled: Tensor, noise_px: float, noise_m: float) -> Tensor:
    """Gaussian noise on filled bins, as the released code adds while training.

    Args:
        means: (B, len(CHANNELS), bins, bins).
        filled: (B, bins, bins) bool; empty bins stay zero.
        noise_px: standard deviation on u and v.
        noise_m: standard deviation on x, y and z.
    """
    scale = means.new_tensor([noise_px if name in ("u", "v") else noise_m for name in CHANNELS])
    return means + torch.randn_like(means) * scale[:, None, None] * filled[:, None]


class ViewpointClassifier(LightningModule):
    """Learns whether a viewpoint localizes.

    Logged every epoch: `{train,val}_loss`, `{train,val}_bce`, `l2` (the weighted penalty), `train_average_precision`
    (with dropout on), `val_average_precision`, `val_roc_auc` and `val_calibration_error`. Balancing the classes shifts
    the probabilities towards one half, so the calibration error also shows how unbalanced the labels are.

    Args:
        network: what to train.
        config: optimizer and loss options.
        class_weights: weights of the negative and the positive class.
    """

    def __init__(self, network: ViewpointNetwork, config: TrainConfig, class_weights: tuple[float, float]) -> None:
        super().__init__()
        self.network, self.config, self.class_weights = network, config, class_weights
        self.train_metrics = MetricCollection({"average_precision": BinaryAveragePrecision()}, prefix="train_")
        self.val_metrics = MetricCollection(
            {
                "average_precision": BinaryAveragePrecision(),
                "roc_auc": BinaryAUROC(),
                "calibration_error": BinaryCalibrationError(n_bins=CALIBRATION_BINS, norm="l1"),
            },
            prefix="val_",
        )

    def forward(self, means: Tensor, filled: Tensor) -> Tensor:
        """Logits (B,) of binned views."""
        return self.network(means, filled)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Loss of one batch."""
        means, filled, labels = batch
        if self.config.noise_px > 0 or self.config.noise_m > 0:
            means = add_noise(means, filled, self.config.noise_px, self.config.noise_m)
        return self._step("train", self(means, filled), labels, self.train_metrics)

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Loss and metrics of one batch."""
        means, filled, labels = batch
        self._step("val", self(means, filled), labels, self.val_metrics)

    def configure_optimizers(self) -> Any:
        """Adam (paper, Sec. 4), with a constant or a cosine learning rate."""
        optimizer = torch.optim.Adam(self.parameters(), lr=self.config.learning_rate)
        if self.config.schedule == "constant":
            return optimizer
        return [optimizer], [torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, T_max=self.config.epochs)]

    def _step(self, split: str, logits: Tensor, labels: Tensor, metrics: MetricCollection) -> Tensor:
        bce = weighted_bce(logits, labels, self.class_weights)
        penalty = self.config.l2 * weight_penalty(self.network)
        values = {f"{split}_loss": bce + penalty, f"{split}_bce": bce}
        if split == "val":
            values["l2"] = penalty
        # the key "step" makes the logger count epochs instead of batches
        values["step"] = torch.tensor(float(self.current_epoch))
        self.log_dict(values, on_step=False, on_epoch=True, batch_size=len(labels))
        metrics.update(logits.sigmoid().detach(), labels.long())
        self.log_dict(metrics, on_step=False, on_epoch=True)  # type: ignore[arg-type]
        return bce + penalty
