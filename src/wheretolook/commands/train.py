"""`wheretolook train`: from labelled viewpoints to weights, one logged run for each method."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from wheretolook.commands.options import DatasetOptions, Log, Progress, ignore_progress, load_dataset
from wheretolook.dataset.dataset_lock import reading, reads_dataset
from wheretolook.dataset.layout import Dataset
from wheretolook.scorers.registry import Method
from wheretolook.scorers.train_config import TrainConfig
from wheretolook.tracking import (
    TrackingConfig,
    check_store,
    kept_if_not_logged,
    log as log_to_run,
    log_history,
    start_run,
    warn_not_logged,
)
from wheretolook.training.provenance import (
    HISTORY_CSV,
    NOT_LOGGED,
    TrainedModel,
    about_training,
    history_not_logged,
    kept_metrics,
    params_of,
    trained_before,
    weights_path,
    with_also,
)
from wheretolook.training.weights import read_record
from wheretolook.utils.errors import TrackingError
from wheretolook.utils.files import safe_child, sha256, temporary_folder, write_json, write_text

if TYPE_CHECKING:
    import pandas as pd
    from mlflow import MlflowClient

    from wheretolook.training.provenance import TrainedModel

Values = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Train(DatasetOptions):
    """Train methods on the labels, one weights file for each method.

    Examples:
      wheretolook train --config configs/demo.yaml --train.methods '[mlp-2d+z, set]'

    Args:
        train: what is trained, and how.
        tracking: where MLflow keeps its runs.
    """

    train: TrainConfig = field(default_factory=TrainConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)

    @reads_dataset("train")
    def run(self, log: Log = print, progress: Progress = ignore_progress) -> Sequence[TrainedModel]:
        """Write the weights of each method, `<dataset>/weights/`, with an MLflow run for each; see `train_methods`."""
        config = self.train
        if self.warp_device == "cpu":
            config = replace(config, accelerator="cpu")
        models = train_methods(load_dataset(self, "label"), config, self.tracking)
        for model in models:
            log(f"{model.method}: reusing {model.path}" if model.reused else f"{model.method}: -> {model.path}")
        progress(1)
        return models


def train_methods(
    dataset: Dataset,
    config: TrainConfig = TrainConfig(),
    tracking: TrackingConfig = TrackingConfig(),
    progress: bool = True,
    force: bool = False,
) -> list[TrainedModel]:
    """Train methods on labelled train scenes, and val scenes if there are any: one MLflow run and model for each.

    Writes `<dataset>/weights/<method>.safetensors` and a JSON record of what it was trained on. A
    method already trained with the same options on the same train and val scenes is not trained again, unless forced.

    Raises:
        TableError: no train scene, no labels, or labels of one class only; or a dataset of `config.also` is missing.
        MapError: a scene has no landmarks.
        ConfigError: there are fewer GPUs than asked for, cameras of datasets differ, or the views do not fit into
            memory shared by processes. InUseError: a dataset is being changed, or the same is being trained.
        TrackingError: the tracking store cannot be used. If it fails later, weights and records are kept, a
            TrackingWarning says that the training is not logged, and the next call logs it.
    """
    shared: Values = {"progress": progress, "kept": {}}
    models = []
    with ExitStack() as stack:
        also = [safe_child(dataset.root.parent, name, "a dataset's name") for name in config.also]
        for root in (dataset.root, *also):
            stack.enter_context(reading(root, "train"))
        dataset = with_also(dataset, config.also)
        for method in config.chosen():
            with reading(dataset.root, "train", f"{method.name}-weights"):
                about = about_training(dataset, method.name, config, config.options_of(method))
                known = None if force else trained_before(weights_path(dataset, method.name), about)
                if known is None or not known.run_id:
                    check_store(tracking)
                if known is None:
                    known = _train(method, dataset, config, about, tracking, shared)
                elif not known.run_id:
                    known = _log_later(known, tracking)
                models.append(known)
    return models


def _train(
    method: Method, dataset: Dataset, config: TrainConfig, about: Values, tracking: TrackingConfig, shared: Values
) -> TrainedModel:
    """Train a method, write its weights and record, and log it; `shared` are further fields of its task."""
    from wheretolook.training.fit import RunLog, seeded
    from wheretolook.training.learner import TrainingJob

    assert method.learner is not None
    path = weights_path(dataset, method.name)  # the title is that of its progress bar
    title = f"train {method.name}"
    devices = {"devices": config.devices}
    record: Values = {}
    try:
        params = params_of(about) | devices
        with start_run(tracking, method.name, "train", params) as (client, run_id), seeded(config.seed):
            options = config.options_of(method)
            run_log = RunLog(tracking, run_id)
            result = method.learner.learn(
                TrainingJob(dataset, method.name, config, options, title, run_log=run_log, **shared)
            )
            result.model.save(path, about)
            history = "" if result.history is None else result.history.to_csv(index=False)
            unlogged = {NOT_LOGGED: {"params": devices | result.counts, "history": history}}
            record = {"about": about, "weights_sha256": sha256(path), "run_id": "", "metrics": result.metrics}
            write_json(path.with_suffix(".json"), record | unlogged)
            log_to_run(client, run_id, result.counts, kept_metrics(result.metrics), [path])
            _log_history_file(client, run_id, result.history)
            if run_log.failed is not None:
                raise run_log.failed
        write_json(path.with_suffix(".json"), record | {"run_id": run_id})
    except TrackingError as error:
        if not record:  # nothing is lost yet but the time
            raise
        warn_not_logged(f"the training of {method.name}, {path}", error)
        run_id = ""
    return TrainedModel(method.name, path, run_id, record["metrics"])


def _log_later(model: TrainedModel, tracking: TrackingConfig) -> TrainedModel:
    """Log a training from the record of its weights, as training itself does."""
    record = read_record(model.path)
    history = history_not_logged(record)
    params = params_of(record["about"]) | record.pop(NOT_LOGGED, {}).get("params", {})
    with kept_if_not_logged(f"the training of {model.method}, {model.path}"):
        with start_run(tracking, model.method, "train", params) as (client, run_id):
            log_to_run(client, run_id, metrics=kept_metrics(model.metrics), files=[model.path])
            if history is not None:
                log_history(client, run_id, history)
            _log_history_file(client, run_id, history)
        write_json(model.path.with_suffix(".json"), record | {"run_id": run_id})
        return replace(model, run_id=run_id)
    return model


def _log_history_file(client: MlflowClient, run_id: str, history: pd.DataFrame | None) -> None:
    if history is None:
        return
    with temporary_folder() as folder:
        write_text(folder / HISTORY_CSV, history.to_csv(index=False))
        client.log_artifact(run_id, str(folder / HISTORY_CSV))
