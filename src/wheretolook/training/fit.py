"""Fit a network with Lightning, on one device or several; keep the best weights and log every epoch."""

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
from typing import Any

import torch
from lightning.pytorch import Callback, LightningDataModule, LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint, EarlyStopping
from lightning.pytorch.strategies import DDPStrategy
from torch.multiprocessing.spawn import ProcessException
from tqdm.auto import tqdm

from wheretolook.tracking.config import TrackingConfig
from wheretolook.tracking.runs import log_metrics
from wheretolook.tracking.store import client
from wheretolook.training.classifier import ViewpointClassifier
from wheretolook.training.config import FittingConfig, SharedConfig
from wheretolook.utils.errors import ConfigError, TrackingError, WorkerError
from wheretolook.utils.files import temporary_folder

MONITORED = "val_average_precision"  # the metric that decides which epoch was best
LOG_EVERY_S = 2.0  # epochs are logged together after so many seconds: a transaction takes longer than a short epoch


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
        if time.monotonic() - self._flushed > LOG_EVERY_S:
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
