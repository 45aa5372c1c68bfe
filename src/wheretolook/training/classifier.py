"""Training of a viewpoint network: loss, regularization, optimizer and validation metrics."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import torch
from lightning.pytorch import LightningModule
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits
from torchmetrics.functional.classification import binary_auroc, binary_average_precision, binary_calibration_error
from torchmetrics.utilities.distributed import gather_all_tensors

from wheretolook.training.batches import Batch
from wheretolook.training.config import FittingConfig

CALIBRATION_BINS = 15  # equal-width bins of the expected calibration error (Guo et al., ICML 2017)


def weighted_bce(
    logits: Tensor, labels: Tensor, class_weights: tuple[float, float], count: float | None = None
) -> Tensor:
    """Return the mean weighted binary cross-entropy of logits and labels (B,), 0 or 1 (paper, Sec. 3.3), a scalar.

    The weights are those of the negative and the positive class; a `count` divides the sum in place of B.
    """
    negative, positive = class_weights
    weights = negative + (positive - negative) * labels
    return binary_cross_entropy_with_logits(logits, labels, weight=weights, reduction="sum") / (count or len(labels))


def weight_penalty(module: nn.Module) -> Tensor:
    """Return the sum of the squares of all weights without biases (the paper's sum is over W_l), a scalar."""
    layers = [layer for layer in module.modules() if isinstance(layer, (nn.Linear, nn.Conv2d))]
    weights = torch.cat([layer.weight.flatten() for layer in layers])
    return weights.dot(weights)


@runtime_checkable
class Augmented(Protocol):
    """A network that augments its inputs in training."""

    def augment(self, options: FittingConfig, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return augmented inputs of a batch."""


@runtime_checkable
class HasFurtherLoss(Protocol):
    """A network with a further loss."""

    def learn_more(self, options: Any, count: float, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return logits (B,) of a batch's inputs, and a further loss divided by the `count` of views."""


class ViewpointClassifier(LightningModule):
    """Trains a network, with logits (B,) as output, to predict whether a viewpoint localizes.

    A network may augment its inputs (`Augmented`) or add a loss (`HasFurtherLoss`), which the logged ones exclude. The
    seed is that of dropout and noise where several processes train.

    Logged every epoch: `{train,val}_loss`, `{train,val}_bce`, `l2` (the weighted penalty), `train_average_precision`
    (with dropout on), `val_average_precision`, `val_roc_auc` and `val_calibration_error`. Balancing the classes shifts
    the probabilities towards one half, so the calibration error also shows how unbalanced the labels are.
    """

    def __init__(
        self, network: nn.Module, options: FittingConfig, class_weights: tuple[float, float], seed: int = 0
    ) -> None:
        super().__init__()
        self.network = network
        self.options = options
        self.class_weights = class_weights
        self.seed = seed
        # logits and labels of an epoch's batches: metrics of every step would take longer than the steps
        self._train_outputs: list[Tensor] = []
        self._val_outputs: list[Tensor] = []
        self._penalties: list[Tensor] = []

    def forward(self, *inputs: Tensor) -> Tensor:
        """Return logits (B,) of views."""
        logits: Tensor = self.network(*inputs)
        return logits

    def on_fit_start(self) -> None:
        """Give every process its own dropout and noise."""
        if self.trainer.world_size > 1:
            torch.manual_seed(self.seed + self.trainer.global_rank)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Return the loss of one process's share of a batch; the mean over processes is that of the batch."""
        inputs, labels, total = batch
        if isinstance(self.network, Augmented):
            inputs = self.network.augment(self.options, *inputs)
        count = total / self.trainer.world_size
        further_loss: Tensor | float = 0.0
        if isinstance(self.network, HasFurtherLoss):
            logits, further_loss = self.network.learn_more(self.options, count, *inputs)
        else:
            logits = self(*inputs)
        penalty = self._penalty()
        self._train_outputs.append(torch.stack([logits.detach(), labels]))
        self._penalties.append(penalty.detach() * total)
        return weighted_bce(logits, labels, self.class_weights, count) + further_loss + penalty

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Store the logits of one process's share of a batch."""
        self._val_outputs.append(torch.stack([self(*batch.inputs), batch.labels]))

    def on_validation_epoch_end(self) -> None:
        """Log the metrics of all validation views."""
        logits, labels = self._gather(self._val_outputs)
        bce = weighted_bce(logits, labels, self.class_weights)
        penalty = self._penalty()
        views: dict[str, Any] = {"preds": logits.sigmoid(), "target": labels.long(), "validate_args": False}
        values = {
            "val_loss": bce + penalty,
            "val_bce": bce,
            "l2": penalty,
            "val_average_precision": binary_average_precision(**views),
            "val_roc_auc": binary_auroc(**views),
            "val_calibration_error": binary_calibration_error(**views, n_bins=CALIBRATION_BINS, norm="l1"),
        }
        self._log(values)

    def on_train_epoch_end(self) -> None:
        """Log the metrics of all training views, each at the time of its training step."""
        logits, labels = self._gather(self._train_outputs)
        bce = weighted_bce(logits, labels, self.class_weights)
        penalty = torch.stack(self._penalties).sum() / len(labels)
        self._penalties.clear()
        precision = binary_average_precision(logits.sigmoid(), labels.long(), validate_args=False)
        self._log({"train_loss": bce + penalty, "train_bce": bce, "train_average_precision": precision})

    def configure_optimizers(self) -> Any:
        """Adam (paper, Sec. 4), with a constant or a cosine learning rate."""
        optimizer = torch.optim.Adam(self.parameters(), lr=self.options.learning_rate, fused=True)
        if self.options.schedule == "constant":
            return optimizer
        return [optimizer], [torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, T_max=self.options.epochs)]

    def _penalty(self) -> Tensor:
        return self.options.l2 * weight_penalty(self.network)

    def _gather(self, outputs: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Return logits and labels of an epoch, (B,) each, over all processes."""
        values = torch.cat(outputs, 1)
        outputs.clear()
        if self.trainer.world_size > 1:
            values = torch.cat(gather_all_tensors(values), 1)
        logits, labels = values
        return logits, labels

    def _log(self, values: dict[str, Tensor]) -> None:
        # all processes have gathered the same values; without sync_dist Lightning warns that they might not have
        self.log_dict(values, on_step=False, on_epoch=True, sync_dist=True)
