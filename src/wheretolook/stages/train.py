"""The train stage: from labelled viewpoints to weights, one logged run for each input variant."""

from __future__ import annotations

import json
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import pandas as pd
from lightning.pytorch import seed_everything
from lightning.pytorch.utilities.seed import isolate_rng

from wheretolook.dataset.folders import Dataset, SceneFolder
from wheretolook.inputs.bins import INPUT_VARIANTS
from wheretolook.learning.classifier import ViewpointClassifier
from wheretolook.learning.config import (
    LEARNERS,
    MATCHABILITY,
    SET,
    TrainConfig,
    inputs_of,
    needs_landmark_channels,
    weights_name,
)
from wheretolook.learning.data import ViewpointDataModule, with_also
from wheretolook.learning.fit import EpochRecord, RunLog, fit, home_device
from wheretolook.learning.learner import Learner, Task
from wheretolook.learning.provenance import TrainedModel, training_fingerprint
from wheretolook.learning.runs import HISTORY_CSV, params_of
from wheretolook.methods.mlp.network import NetworkSpec, ViewpointNetwork
from wheretolook.methods.mlp.weights import save_classifier
from wheretolook.utils.files import fingerprint as file_fingerprint
from wheretolook.utils.files import sha256, write_json
from wheretolook.utils.tracking import TrackingConfig, log, start_run
from wheretolook.utils.version import VERSION

if TYPE_CHECKING:
    from mlflow import MlflowClient
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from wheretolook.config import Experiment
from wheretolook.stages.inputs import Say, Tick, dataset_after

if TYPE_CHECKING:
    from wheretolook.learning.provenance import TrainedModel


NOT_DECIDING = ("variants", "also", "accelerator", "devices", *LEARNERS)
"""Options that do not decide what the paper's network learns: where, with which random numbers, and others' own."""

OF_ALL = ("max_error_m", "max_error_deg", "val_fraction", "seed")
"""Options that decide what any learner learns, beside its own."""


def train_variants(
    dataset: Dataset,
    config: TrainConfig = TrainConfig(),
    tracking: TrackingConfig = TrackingConfig(),
    progress: bool = True,
    force: bool = False,
) -> list[TrainedModel]:
    """Train the paper's classifier for each input variant, and what else is among the variants.

    Writes `<dataset>/weights/mlp-<variant>.safetensors`, `trees.safetensors` and so on and, beside it, a JSON
    file that tells what it was trained on. A variant already trained with the same options on the same train and val
    scenes is not trained again. With `config.keep == "best"`, the weights kept are those of the epoch with the best
    average precision on the validation views, the earliest one on ties.

    Args:
        dataset: labelled train scenes, and val scenes if it has any.
        config: options.
        tracking: where to log; one MLflow run a variant.
        progress: show progress bars.
        force: train even if there is nothing new.

    Returns:
        One model a variant, in the order of `config.variants`.

    Raises:
        TableError: no train scene, no labels, or labels of one class only; or a dataset of `config.also` is missing.
        MapError: a scene has no landmarks.
        ConfigError: there are fewer GPUs than asked for, cameras of datasets differ, or the views do not fit into
            memory shared by processes.
    """
    dataset = with_also(dataset, config.also)
    fingerprint = training_fingerprint(dataset)
    data: ViewpointDataModule | None = None
    models = []
    for variant in config.variants:
        path = dataset.root / "weights" / weights_name(variant)
        options = config.of_variant(variant)
        about = _about(dataset, options, fingerprint, variant)
        model = None if force else _trained_before(path, variant, about)
        if model is None and variant in LEARNERS:
            model = _learn(dataset, options, variant, path, about, tracking, progress)
        elif model is None:
            if data is None or data.config != options:
                networks = [one for one in config.variants if one not in LEARNERS]
                sharing = [one for one in networks if config.of_variant(one) == options]
                wide = any(map(needs_landmark_channels, sharing))
                data = ViewpointDataModule(dataset, options, home_device(options), progress, wide)
            data.setup()
            model = _train_variant(data, variant, path, about, tracking, progress)
        models.append(model)
    return models


def learner_of(variant: str) -> Learner:
    """How a variant of `LEARNERS` learns."""
    module = import_module(f"wheretolook.methods.{variant}.learn")  # some take long to load
    learner: Learner = getattr(module, f"learn_{variant}")
    return learner


def _about(dataset: Dataset, config: TrainConfig, fingerprint: str, variant: str) -> dict[str, Any]:
    """What decides which weights come out, as JSON values."""
    of_network = [name for name in asdict(config) if name not in NOT_DECIDING]
    deciding = (*OF_ALL, variant) if variant in LEARNERS else of_network
    options = {name: value for name, value in asdict(config).items() if name in deciding}
    about: dict[str, Any] = {
        "dataset": dataset.name,
        "dataset_fingerprint": fingerprint,
        "landmarks": {
            _name(scene, dataset): file_fingerprint(scene.landmarks)
            for scene in dataset.scenes
            if scene.split != "test"
        },
        "code_version": VERSION,
        "variant": variant,
        "camera": asdict(dataset.camera),
        "config": options,
    }
    if config.also:
        about["also"] = list(config.also)
        own = tuple(scene for scene in dataset.scenes if scene.folder.parent == dataset.root)
        about["own_fingerprint"] = training_fingerprint(Dataset(dataset.root, dataset.camera, own))
    if variant == SET and config.set.from_matchability:
        start = dataset.root / "weights" / weights_name(MATCHABILITY)
        about["matchability_sha256"] = sha256(start) if start.is_file() else None
    return dict(json.loads(json.dumps(about)))


def _name(scene: SceneFolder, dataset: Dataset) -> str:
    """Name of a scene, with that of its dataset if it is of another one."""
    folder = scene.folder.parent
    return scene.name if folder == dataset.root else f"{folder.name}/{scene.name}"


def _trained_before(path: Path, variant: str, about: dict[str, Any]) -> TrainedModel | None:
    """The model at `path` if it was trained as `about` says and has not been changed since."""
    try:
        record = json.loads(path.with_suffix(".json").read_text())
        if record["about"] == about and record["weights_sha256"] == sha256(path):
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
        **params_of(about),
        "devices": config.devices,
        **{f"n_{side}": len(values) for side, values in labels.items()},
        **{f"positives_{side}": round(float(values.mean()), 4) for side, values in labels.items()},
    }
    with start_run(tracking, f"train mlp {variant}", "train", params) as (client, run_id), isolate_rng():
        seed_everything(config.seed, verbose=False)
        channels = INPUT_VARIANTS[inputs_of(variant)]
        spec = NetworkSpec(
            inputs_of(variant), data.dataset.camera, data.statistics.select(channels), config.bins, config.layout,
            config.hidden, config.dropout, config.input_dropout,
        )  # fmt: skip
        network = ViewpointNetwork(spec)
        classifier = ViewpointClassifier(network, config, data.class_weights)
        record = EpochRecord(f"train {variant}", config, progress, RunLog(tracking, run_id))
        data.channels = channels
        fit(classifier, data, record)
        metrics = record.restore(classifier)
        save_classifier(network, path, about)
        log(client, run_id, metrics={f"kept_{name}": value for name, value in metrics.items()})
        _log_artifacts(client, run_id, path, record.history, variant)
        content = {"about": about, "weights_sha256": sha256(path), "run_id": run_id, "metrics": metrics}
        write_json(path.with_suffix(".json"), content)
    return TrainedModel(variant, path, run_id, metrics)


def _learn(
    dataset: Dataset, config: TrainConfig, variant: str, path: Path, about: dict[str, Any], tracking: TrackingConfig,
    progress: bool,
) -> TrainedModel:  # fmt: skip
    with start_run(tracking, f"train {variant}", "train", params_of(about)) as (client, run_id), isolate_rng():
        seed_everything(config.seed, verbose=False)
        task = Task(dataset, config, f"train {variant}", progress, RunLog(tracking, run_id))
        learnt = learner_of(variant)(task)
        learnt.model.save(path, about)
        kept = {f"kept_{name}": value for name, value in learnt.metrics.items()}
        log(client, run_id, params=learnt.counts, metrics=kept)
        _log_artifacts(client, run_id, path, learnt.history, variant)
        content = {"about": about, "weights_sha256": sha256(path), "run_id": run_id, "metrics": learnt.metrics}
        write_json(path.with_suffix(".json"), content)
    return TrainedModel(variant, path, run_id, learnt.metrics)


def _log_artifacts(
    client: MlflowClient, run_id: str, weights: Path, history: pd.DataFrame | None, variant: str
) -> None:
    from wheretolook.figures.style import save_figure
    from wheretolook.figures.training import training_figure

    client.log_artifact(run_id, str(weights))
    if history is None:
        return
    with TemporaryDirectory() as folder:
        history.to_csv(Path(folder) / HISTORY_CSV, index=False)
        save_figure(training_figure({variant: history}), Path(folder) / "curves.png")
        client.log_artifacts(run_id, folder)


def train(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> Sequence[TrainedModel]:
    """Stage 5: one network for each input variant, `<dataset>/weights/`, and an MLflow run for each."""

    config = experiment.train
    if experiment.warp_device == "cpu":
        config = replace(config, accelerator="cpu")
    models = train_variants(dataset_after(experiment, "label"), config, experiment.tracking)
    for model in models:
        say(f"{model.variant}: reusing {model.path}" if model.reused else f"{model.variant}: -> {model.path}")
    tick(1)
    return models
