"""The release stage: a compact copy of a labelled dataset, and its card."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from typing import Any

from wheretolook.config import Experiment
from wheretolook.dataset.dataset_lock import changing, reading, reads_dataset
from wheretolook.dataset.layout import Dataset
from wheretolook.stages.evaluate import evaluate
from wheretolook.stages.preconditions import Say, Tick, dataset_after
from wheretolook.tracking.store import check_store
from wheretolook.utils.files import copy_file


@reads_dataset("release")
def release(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> Dataset:
    """Publish a labelled dataset: a compact copy of it, `<data>/<release_name>/`, and in the end its card.

    For any dataset but a release this makes the copy. For the copy itself, once networks are trained on it, it chooses
    the weights that ship, evaluates them and writes the card. Either can be done again.

    Raises:
        WeightsError: there are no weights, or they do not fit the release.
        StorageError: it is not smaller than 16 MB.
        ConfigError: another dataset lies where the copy belongs, or it is the dataset itself.
        InUseError: another stage changes the dataset, or is at work on the copy.
    """
    from wheretolook_paper.release import copy as releases
    from wheretolook_paper.release import naming

    dataset = dataset_after(experiment, "label")
    if not releases.is_release(dataset):
        root = experiment.data / experiment.release_name
        naming.check(experiment)
        with changing(root, "release"):
            copy = releases.copy_dataset(dataset, root, release_settings(experiment))
            for scene, source in zip(copy.scenes, dataset.scenes, strict=True):
                stamp = source.stage_cache("label").stored_key
                assert stamp is not None  # `dataset_after` has checked it
                scene.stage_cache("label", stamp).store()
        say(f"{len(copy.scenes)} scenes -> {copy.root}: {releases.size_text(releases.sizes(copy.root, weights=False))}")
        say("next: train on it, then `wheretolook release` with its own configuration")
        return copy
    with reading(dataset.root, "release", "card"):
        return _finish(experiment, dataset, say, tick)


def _finish(experiment: Experiment, dataset: Dataset, say: Say, tick: Tick) -> Dataset:
    """Choose the weights that ship with a release, evaluate them, and write its card."""
    from wheretolook.evaluation.results import SCORES_CSV, VARIANTS_CSV
    from wheretolook_paper.release import copy as releases
    from wheretolook_paper.release.card import write_card
    from wheretolook_paper.release.training_histories import keep_histories

    check_store(experiment.tracking)
    # on the CPU, so that machines without a GPU get the same scores
    on_cpu = replace(experiment, device="cpu", evaluate=replace(experiment.evaluate, weights=()))
    results = dataset.root / "results"
    if releases.choose_weights_to_ship(dataset).shelved:  # all that were trained, before only the best are left
        methods = tuple(method.name for method in releases.trained_weights(dataset).values())
        evaluate(replace(on_cpu, evaluate=replace(on_cpu.evaluate, methods=methods, reference="")), say)
        copy_file(results / SCORES_CSV, results / VARIANTS_CSV)
    choice = releases.ship_weights(dataset)
    compared = ", ".join(f"{name} {value:.4f}" for name, value in choice.precision.items())
    say(f"validation average precision: {compared}")
    say(f"the paper's network that ships, in half precision: {choice.network}; the best of all: {choice.best}")
    keep_histories(dataset, experiment.tracking)
    releases.sizes(dataset.root)  # too large? then before the evaluation
    evaluate(on_cpu, say, tick)
    say(f"the card -> {write_card(dataset, release_settings(Experiment()))}")
    say(releases.size_text(releases.sizes(dataset.root)))
    return dataset


def release_settings(experiment: Experiment) -> dict[str, Any]:
    """Settings that decide what a dataset holds, as JSON values. Meshes go by name: paths mean nothing elsewhere."""
    meshes = [{"name": mesh.scene_name, "split": mesh.split, "up": mesh.up} for mesh in experiment.scenes.meshes]
    settings = {name: _record(getattr(experiment, name)) for name in ("scenes", "map", "occlusion", "sample")}
    settings = {"camera": experiment.camera.camera.record(), **settings}
    settings["scenes"]["meshes"] = meshes
    settings["label"] = {"localizer": experiment.label.localizer.record()}
    return dict(json.loads(json.dumps(settings, default=str)))


def _record(config: Any) -> dict[str, Any]:
    """Return a group of options with the constants that it records."""
    return dict(config.record() if hasattr(config, "record") else asdict(config))
