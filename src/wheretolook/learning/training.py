"""The train stage: from labelled viewpoints to weights, one logged run for each input variant."""

from __future__ import annotations

import hashlib
import json
import logging
import signal
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import pandas as pd
import torch
from lightning.pytorch import Callback, LightningModule, Trainer, seed_everything
from lightning.pytorch.callbacks import EarlyStopping
from lightning.pytorch.utilities.seed import isolate_rng
from tqdm.auto import tqdm

import wheretolook
from wheretolook.dataset import Dataset, write_json
from wheretolook.features import INPUT_VARIANTS
from wheretolook.learning.classifier import ViewpointClassifier
from wheretolook.learning.config import TrainConfig
from wheretolook.learning.data import ViewpointDataModule
from wheretolook.learning.network import NetworkSpec, ViewpointNetwork
from wheretolook.learning.weights import save_classifier
from wheretolook.table import fingerprint as file_fingerprint
from wheretolook.tracking import TrackingConfig, log, start_run

if TYPE_CHECKING:
    from mlflow import MlflowClient

MONITORED = "val_average_precision"
"""The metric that tells which epoch was best."""

ROOM = 2
"""The views are kept on the GPU if it has this many times the memory they need."""


@dataclass(frozen=True)
class TrainedModel:
    """What training one variant left.

    Attributes:
        variant: the input variant.
        path: its weights.
        run_id: its MLflow run, at the time of training.
        metrics: metrics of the epoch whose weights were kept, and that epoch's number (from 0) as "epoch".
        reused: whether it was trained before and only found again.
    """

    variant: str
    path: Path
    run_id: str
    metrics: dict[str, float]
    reused: bool = False


def train(
    dataset: Dataset,
    config: TrainConfig = TrainConfig(),
    tracking: TrackingConfig = TrackingConfig(),
    progress: bool = True,
    force: bool = False,
) -> list[TrainedModel]:
    """Train the paper's classifier for each input variant.

    Writes `<dataset>/weights/mlp-<variant>.safetensors` and, beside it, a JSON file that tells what it was trained on.
    A variant already trained with the same options on the same train and val scenes is not trained again. With
    `config.keep == "best"`, the weights kept are those of the epoch with the best average precision on the validation
    views, the earliest one on ties.

    Args:
        dataset: labelled train scenes, and val scenes if it has any.
        config: options.
        tracking: where to log; one MLflow run a variant.
        progress: show progress bars.
        force: train even if there is nothing new.

    Returns:
        One model a variant, in the order of `config.variants`.

    Raises:
        TableError: no train scene, no labels, or labels of one class only.
        MapError: a scene has no landmarks.
    """
    fingerprint = training_fingerprint(dataset)
    use_gpu = config.accelerator != "cpu" and torch.cuda.is_available()
    data = ViewpointDataModule(dataset, config, "cuda:0" if use_gpu else "cpu", progress)
    models = []
    for variant in config.variants:
        path = dataset.root / "weights" / f"mlp-{variant}.safetensors"
        about = _about(dataset, config, fingerprint, variant)
        model = None if force else _trained_before(path, variant, about)
        if model is None:
            data.setup()
            model = _train_variant(data, variant, path, about, tracking, progress)
        models.append(model)
    return models


def training_fingerprint(dataset: Dataset) -> str:
    """16 hexadecimal digits that change with anything a network learns from: the train and val scenes."""
    return Dataset(dataset.root, dataset.camera, (*dataset.split("train"), *dataset.split("val"))).fingerprint()


def _about(dataset: Dataset, config: TrainConfig, fingerprint: str, variant: str) -> dict[str, Any]:
    """What decides which weights come out, as JSON values."""
    options = {name: value for name, value in asdict(config).items() if name not in ("variants", "accelerator")}
    about = {
        "dataset": dataset.name,
        "dataset_fingerprint": fingerprint,
        "landmarks": {
            scene.name: file_fingerprint(scene.landmarks) for scene in dataset.scenes if scene.split != "test"
        },
        "code_version": wheretolook.__version__,
        "variant": variant,
        "camera": asdict(dataset.camera),
        "config": options,
    }
    return dict(json.loads(json.dumps(about)))


def _trained_before(path: Path, variant: str, about: dict[str, Any]) -> TrainedModel | None:
    """The model at `path` if it was trained as `about` says and has not been changed since."""
    try:
        record = json.loads(path.with_suffix(".json").read_text())
        if record["about"] == about and record["weights_sha256"] == _sha256(path):
            return TrainedModel(variant, path, record["run_id"], record["metrics"], reused=True)
    except (OSError, ValueError, KeyError, TypeError):
        pass  # no record, or a damaged one: train
    return None


def _train_variant(
    data: ViewpointDataModule, variant: str, path: Path, about: dict[str, Any], tracking: TrackingConfig, progress: bool
) -> TrainedModel:
    config = data.config
    labels = {side: data.views.labels[rows] for side, rows in (("train", data.train_rows), ("val", data.val_rows))}
    params = {
        **{name: about[name] for name in ("variant", "dataset", "dataset_fingerprint")},
        **about["config"],
        **{f"n_{side}": len(values) for side, values in labels.items()},
        **{f"positives_{side}": round(float(values.mean()), 4) for side, values in labels.items()},
    }
    with start_run(tracking, f"train mlp {variant}", "train", params) as (client, run_id), isolate_rng():
        seed_everything(config.seed, verbose=False)
        channels = INPUT_VARIANTS[variant]
        spec = NetworkSpec(
            variant, data.dataset.camera, data.statistics.select(channels), config.bins, config.layout, config.hidden,
            config.dropout, config.input_dropout,
        )  # fmt: skip
        classifier = ViewpointClassifier(ViewpointNetwork(spec), config, data.class_weights)
        record = EpochRecord(f"train {variant}", config, progress)
        _fit(classifier, data, record, tracking, run_id)
        metrics = record.restore(classifier)
        save_classifier(classifier.network, path, about)
        log(client, run_id, metrics={f"kept_{name}": value for name, value in metrics.items()})
        _log_artifacts(client, run_id, path, record.history, variant)
        content = {"about": about, "weights_sha256": _sha256(path), "run_id": run_id, "metrics": metrics}
        write_json(path.with_suffix(".json"), content)
    return TrainedModel(variant, path, run_id, metrics)


def _fit(
    classifier: ViewpointClassifier,
    data: ViewpointDataModule,
    record: EpochRecord,
    tracking: TrackingConfig,
    run_id: str,
) -> None:
    from lightning.pytorch.loggers import MLFlowLogger

    config = data.config
    callbacks: list[Callback] = [record]
    if config.patience is not None:
        callbacks.append(EarlyStopping(MONITORED, mode="max", patience=config.patience))
    with _quiet():
        trainer = Trainer(
            accelerator=config.accelerator,
            devices=1,
            max_epochs=config.epochs,
            logger=MLFlowLogger(tracking.experiment, tracking_uri=tracking.uri, run_id=run_id, log_model=False),
            callbacks=callbacks,
            default_root_dir=tracking.root,
            num_sanity_val_steps=0,
            log_every_n_steps=2**31,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
        )
        device = trainer.strategy.root_device
        if device.type == "cuda" and torch.cuda.mem_get_info(device)[0] > ROOM * data.views.n_bytes:
            data.move_to(device)
        trainer.fit(classifier, datamodule=data)


class EpochRecord(Callback):
    """Keeps each epoch's metrics and the best weights, and shows the progress.

    Args:
        title: title of the progress bar.
        config: tells which weights to keep.
        progress: show a bar.
    """

    def __init__(self, title: str, config: TrainConfig, progress: bool) -> None:
        self.keep_best = config.keep == "best"
        self.rows: list[dict[str, float]] = []
        self.kept = -1
        self._weights: dict[str, torch.Tensor] = {}
        self._bar = tqdm(total=config.epochs, desc=title, unit="epoch", disable=not progress)

    @property
    def history(self) -> pd.DataFrame:
        """Metrics of each epoch, one row an epoch."""
        return pd.DataFrame(self.rows)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Note the epoch's metrics; keep its weights if it is the best so far."""
        metrics = {name: float(value) for name, value in trainer.callback_metrics.items() if name != "step"}
        best = max((row[MONITORED] for row in self.rows), default=float("-inf"))
        self.rows.append({"epoch": float(trainer.current_epoch), **metrics})
        if not self.keep_best or metrics[MONITORED] > best:
            self.kept = len(self.rows) - 1
            self._weights = {name: tensor.detach().clone() for name, tensor in pl_module.state_dict().items()}
        now = metrics[MONITORED]
        self._bar.set_postfix_str(f"AP {now:.3f}, best {max(best, now):.3f}", refresh=False)
        self._bar.update()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Close the bar."""
        self._bar.close()

    def restore(self, classifier: ViewpointClassifier) -> dict[str, float]:
        """Put the kept weights into the classifier and return the metrics of their epoch."""
        classifier.load_state_dict(self._weights)
        return dict(self.rows[self.kept])


def _log_artifacts(client: MlflowClient, run_id: str, weights: Path, history: pd.DataFrame, variant: str) -> None:
    from wheretolook.figures.style import save_figure
    from wheretolook.figures.training import training_figure

    client.log_artifact(run_id, str(weights))
    with TemporaryDirectory() as folder:
        history.to_csv(Path(folder) / "history.csv", index=False)
        save_figure(training_figure({variant: history}), Path(folder) / "curves.png")
        client.log_artifacts(run_id, folder)


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence Lightning's notes on hardware, and turn its exit on Ctrl-C back into a KeyboardInterrupt."""
    loggers = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric")]
    levels = [logger.level for logger in loggers]
    in_main = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGINT) if in_main else None
    for logger in loggers:
        logger.setLevel(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "The number of training batches")  # metrics are logged by epoch
            yield
    except SystemExit as stop:
        if isinstance(stop.__context__, KeyboardInterrupt):
            raise KeyboardInterrupt from stop
        raise
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
        if in_main:
            signal.signal(signal.SIGINT, handler)
