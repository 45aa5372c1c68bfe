"""The train stage: from labelled viewpoints to weights, one logged run for each method."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from wheretolook.config import Experiment
from wheretolook.dataset.folders import Dataset
from wheretolook.methods.method import Method
from wheretolook.methods.train_config import TrainConfig
from wheretolook.stages.inputs import Say, Tick, dataset_after
from wheretolook.stages.one_at_a_time import reading, reads_dataset
from wheretolook.utils.confine import entry_of
from wheretolook.utils.files import sha256, write_json
from wheretolook.utils.tracking import log, start_run
from wheretolook.utils.tracking_config import TrackingConfig

if TYPE_CHECKING:
    import pandas as pd
    from mlflow import MlflowClient

    from wheretolook.learning.provenance import TrainedModel

Values = dict[str, Any]


@reads_dataset("train")
def train(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> Sequence[TrainedModel]:
    """Stage 5: the weights of each method that is to learn, `<dataset>/weights/`, and an MLflow run for each."""
    config = experiment.train
    if experiment.warp_device == "cpu":
        config = replace(config, accelerator="cpu")
    models = train_methods(dataset_after(experiment, "label"), config, experiment.tracking)
    for model in models:
        say(f"{model.method}: reusing {model.path}" if model.reused else f"{model.method}: -> {model.path}")
    tick(1)
    return models


def train_methods(
    dataset: Dataset,
    config: TrainConfig = TrainConfig(),
    tracking: TrackingConfig = TrackingConfig(),
    progress: bool = True,
    force: bool = False,
) -> list[TrainedModel]:
    """Train methods on labelled train scenes, and val scenes if there are any: one MLflow run and model for each.

    Writes `<dataset>/weights/<method>.safetensors` and, beside it, a JSON file that tells what it was trained on. A
    method already trained with the same options on the same train and val scenes is not trained again, unless forced.

    Raises:
        TableError: no train scene, no labels, or labels of one class only; or a dataset of `config.also` is missing.
        MapError: a scene has no landmarks.
        ConfigError: there are fewer GPUs than asked for, cameras of datasets differ, or the views do not fit into
            memory shared by processes. InUseError: a dataset is being changed, or the same is being trained.
    """
    from wheretolook.learning.provenance import about_training, trained_before, weights_path
    from wheretolook.learning.scenes import with_also

    shared: dict[str, Any] = {"progress": progress, "kept": {}}
    models = []
    with ExitStack() as stack:
        for root in (dataset.root, *(entry_of(dataset.root.parent, name, "a dataset's name") for name in config.also)):
            stack.enter_context(reading(root, "train"))
        dataset = with_also(dataset, config.also)
        for method in config.chosen():
            with reading(dataset.root, "train", f"{method.name}-weights"):
                about = about_training(dataset, method.name, config, config.options_of(method))
                known = None if force else trained_before(weights_path(dataset, method.name), about)
                models.append(known or _train(method, dataset, config, about, tracking, shared))
    return models


def _train(
    method: Method, dataset: Dataset, config: TrainConfig, about: Values, tracking: TrackingConfig, shared: Values
) -> TrainedModel:
    """Train a method, log it, and write its weights; `shared` are further fields of its `Task`."""
    from lightning.pytorch import seed_everything
    from lightning.pytorch.utilities.seed import isolate_rng

    from wheretolook.learning.fit import RunLog
    from wheretolook.learning.learner import Task
    from wheretolook.learning.provenance import TrainedModel, weights_path
    from wheretolook.learning.runs import kept_metrics, params_of

    assert method.learn is not None
    path, title = weights_path(dataset, method.name), f"train {method.name}"  # the title is that of its progress bar
    params = {**params_of(about), "devices": config.devices}
    with start_run(tracking, method.name, "train", params) as (client, run_id), isolate_rng():
        seed_everything(config.seed, verbose=False)
        options, run_log = config.options_of(method), RunLog(tracking, run_id)
        learnt = method.learn(Task(dataset, method.name, config, options, title, run_log=run_log, **shared))
        learnt.model.save(path, about)
        log(client, run_id, params=learnt.counts, metrics=kept_metrics(learnt.metrics))
        _log_artifacts(client, run_id, path, learnt.history, method.name)
        content = {"about": about, "weights_sha256": sha256(path), "run_id": run_id, "metrics": learnt.metrics}
        write_json(path.with_suffix(".json"), content)
    return TrainedModel(method.name, path, run_id, learnt.metrics)


def _log_artifacts(client: MlflowClient, run_id: str, weights: Path, history: pd.DataFrame | None, method: str) -> None:
    from wheretolook.figures.style import save_figure
    from wheretolook.figures.training import training_figure
    from wheretolook.learning.runs import HISTORY_CSV

    client.log_artifact(run_id, str(weights))
    if history is None:
        return
    with TemporaryDirectory() as folder:
        history.to_csv(Path(folder) / HISTORY_CSV, index=False)
        save_figure(training_figure({method: history}), Path(folder) / "curves.png")
        client.log_artifacts(run_id, folder)
