"""Training of a viewpoint network: loss, regularization, optimizer and validation metrics."""

from __future__ import annotations

import logging
import multiprocessing
import signal
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from lightning.pytorch import Callback, LightningDataModule, LightningModule, Trainer, seed_everything
from lightning.pytorch.callbacks import Checkpoint, EarlyStopping
from lightning.pytorch.strategies import DDPStrategy
from lightning.pytorch.utilities.seed import isolate_rng
from torch import Tensor, nn
from torch.multiprocessing.spawn import ProcessException
from torch.nn.functional import binary_cross_entropy_with_logits
from torchmetrics.functional.classification import binary_auroc, binary_average_precision, binary_calibration_error
from torchmetrics.utilities.distributed import gather_all_tensors
from tqdm.auto import tqdm

from wheretolook.tracking import TrackingConfig, client, log_metrics
from wheretolook.training.config import FittingConfig, SharedConfig
from wheretolook.training.data import Batch
from wheretolook.utils.errors import ConfigError, TrackingError, WorkerError
from wheretolook.utils.files import temporary_folder


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
        # equal-width bins of the expected calibration error (Guo et al., ICML 2017)
        values = {
            "val_loss": bce + penalty,
            "val_bce": bce,
            "l2": penalty,
            "val_average_precision": binary_average_precision(**views),
            "val_roc_auc": binary_auroc(**views),
            "val_calibration_error": binary_calibration_error(**views, n_bins=15, norm="l1"),
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


MONITORED = "val_average_precision"  # the metric that decides which epoch was best


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed all generators of random numbers, whose states are restored at the end of the block."""
    with isolate_rng():
        seed_everything(seed, verbose=False)
        yield


def home_device(config: SharedConfig) -> str:
    """Return the Torch device of the calling process, "cuda:0" or "cpu"; a ConfigError if there are too few GPUs."""
    gpus = torch.cuda.device_count() if config.accelerator != "cpu" else 0
    wanted = config.devices if gpus or config.accelerator == "gpu" else 0
    if wanted > max(gpus, torch.backends.mps.is_available()):
        fix = "Request fewer, or set train.accelerator to cpu to train in processes on the CPU."
        raise ConfigError(f"train.devices exceeds the number of GPUs, {gpus}", value=config.devices, fix=fix)
    return "cuda:0" if gpus else "cpu"


def fit(classifier: ViewpointClassifier, data: LightningDataModule, record: EpochRecord, config: SharedConfig) -> None:
    """Train a classifier; afterwards `record` has the history and the best weights.

    With `config.devices > 1`, every device has its own spawned process: a script that calls this needs the usual
    `if __name__ == "__main__":`, and an interactive session cannot call it.
    """
    options = classifier.options
    callbacks: list[Callback] = [record]
    if options.patience is not None:
        callbacks.append(EarlyStopping(MONITORED, mode="max", patience=options.patience))
    with _quiet(), temporary_folder() as folder:
        where: dict[str, Any] = {"accelerator": config.accelerator, "devices": config.devices}
        if config.devices > 1:
            record.file = folder / "record.pt"
            where["strategy"] = _SpawnedStrategy(start_method="spawn")
            if home_device(config) == "cpu":
                where["accelerator"] = "cpu"
        try:
            Trainer(
                **where,
                max_epochs=options.epochs,
                callbacks=callbacks,
                num_sanity_val_steps=0,
                logger=False,
                enable_progress_bar=False,
                enable_model_summary=False,
                default_root_dir=folder,
            ).fit(classifier, datamodule=data)
        except ProcessException as error:
            problem = f"a training process ended before its work was done: {error}"
            fix = "There may be too little memory: lower train.devices."
            raise WorkerError(problem, value=f"train.devices {config.devices}", fix=fix) from error
        if record.file is not None:
            record.load(record.file)
    data.trainer = None  # later batches are whole, not one process's share


class RunLog:
    """Logs the metrics of epochs to an open MLflow run, several epochs at a time.

    A store that fails does not end the training: nothing more is logged, and `failed` is the error.
    """

    def __init__(self, tracking: TrackingConfig, run_id: str) -> None:
        self.tracking = tracking
        self.run_id = run_id
        self.failed: TrackingError | None = None
        self._pending: list[tuple[int, dict[str, float]]] = []
        self._flushed = time.monotonic()

    def add(self, epoch: int, metrics: dict[str, float]) -> None:
        """Log the finite metrics of an epoch, now or soon."""
        self._pending.append((epoch, metrics))
        # epochs are logged together: a transaction takes longer than a short epoch
        if time.monotonic() - self._flushed > 2.0:
            self.flush()

    def flush(self) -> None:
        """Log the pending epochs."""
        if self._pending and self.failed is None:
            try:
                log_metrics(client(self.tracking), self.run_id, self._pending)
            except TrackingError as error:
                self.failed = error
        self._pending = []
        self._flushed = time.monotonic()


class EpochRecord(Checkpoint):
    """Records, shows and logs the metrics of each epoch, and keeps the weights of the best epoch, or of the last.

    A spawned process leaves its record in `file`; None where training runs in the calling process.
    """

    def __init__(self, title: str, options: FittingConfig, progress: bool, run_log: RunLog | None = None) -> None:
        self.title = title
        self.epochs = options.epochs
        self.progress = progress
        self.run_log = run_log
        self.keep_best = options.keep == "best"
        self.rows: list[dict[str, float]] = []  # metrics of each epoch
        self.kept = -1
        self.file: Path | None = None
        self._weights: dict[str, torch.Tensor] = {}
        self._bar: Any = None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Show the progress bar."""
        hidden = not (self.progress and trainer.is_global_zero)
        self._bar = tqdm(total=self.epochs, desc=self.title, unit="epoch", disable=hidden)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Record the epoch's metrics, and its weights if they are to be kept."""
        metrics = {name: float(value) for name, value in trainer.callback_metrics.items()}
        best = max((row[MONITORED] for row in self.rows), default=float("-inf"))
        self.rows.append({"epoch": float(trainer.current_epoch), **metrics})
        if not self.keep_best or metrics[MONITORED] > best:
            self.kept = len(self.rows) - 1
            self._weights = {name: tensor.detach().clone() for name, tensor in pl_module.state_dict().items()}
        if self.run_log is not None and trainer.is_global_zero:
            self.run_log.add(trainer.current_epoch, metrics)
        now = metrics[MONITORED]
        self._bar.set_postfix_str(f"AP {now:.3f}, best {max(best, now):.3f}", refresh=False)
        self._bar.update()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save the record for the process that spawned this one."""
        if self.file is not None and trainer.is_global_zero:
            torch.save((self.rows, self.kept, self._weights), self.file)

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Close the progress bar and log the pending epochs."""
        if self._bar is not None:
            self._bar.close()
        if self.run_log is not None and trainer.is_global_zero:
            self.run_log.flush()

    def load(self, file: Path) -> None:
        """Load the record of a spawned process."""
        self.rows, self.kept, self._weights = torch.load(file, map_location="cpu", weights_only=True)

    def restore(self, classifier: ViewpointClassifier) -> dict[str, float]:
        """Load the kept weights into the classifier and return the metrics of their epoch."""
        classifier.load_state_dict(self._weights)
        return dict(self.rows[self.kept])


class _SpawnedStrategy(DDPStrategy):
    """Lightning's DDP in spawned processes that are as quiet as the calling one."""

    def setup_environment(self) -> None:
        """Silence this process and join the others."""
        _silence()
        super().setup_environment()


def _silence() -> None:
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)`")  # between Lightning and PyTorch


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence Lightning's notes on hardware, and turn its exit on Ctrl-C back into a KeyboardInterrupt."""
    in_main = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGINT)
    try:
        with warnings.catch_warnings():
            _silence()
            yield
    except SystemExit as stop:
        if isinstance(stop.__context__, KeyboardInterrupt):
            for process in multiprocessing.active_children():  # SIGTERM does not reach them, and Python waits for them
                process.kill()
            raise KeyboardInterrupt from stop
        raise
    finally:
        if in_main:
            signal.signal(signal.SIGINT, handler)
