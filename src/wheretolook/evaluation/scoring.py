"""The scores of all methods for the views of an evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from tqdm.auto import tqdm

from wheretolook.dataset.environment import EnvironmentConfig, SceneEnvironment
from wheretolook.dataset.layout import Dataset, SceneFolder, views_by_camera
from wheretolook.dataset.viewpoint_table import poses
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.scores import reference_method
from wheretolook.geometry.poses import Float
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.registry import learned, make_scorer, members, methods_named, scorers
from wheretolook.training.provenance import TrainedModel, was_trained_on, weights_path
from wheretolook.training.weights import method_of_weights, read_training
from wheretolook.utils.errors import TableError, WeightsError
from wheretolook.utils.files import fingerprint
from wheretolook.utils.shipped import WEIGHTS, shipped
from wheretolook.visibility.config import OcclusionConfig

BLOCK = 4096  # views binned and scored at a time
SHIPPED = "that ships"  # stands after the method's name where the weights that ship are compared beside others
Weights = Mapping[Path, str]  # files of weights, and the name of the method that each serves


def choose_weights(dataset: Dataset, config: EvaluateConfig, models: Sequence[TrainedModel | Path] | None) -> Weights:
    """The weights to evaluate: those given, or those that the configuration names, or the dataset's own.

    Raises a WeightsError if there are none for a method that needs them, or the dataset's were trained on other data.
    """
    asked = {name: {method.weights for method in members(name, scorers())} for name in config.methods}
    wanted = set().union(*asked.values()) - {""}
    if not wanted:
        return {}
    if models is not None:
        paths = [model if isinstance(model, Path) else model.path for model in models]
    else:
        paths = list(config.weights) or own_weights(dataset)
    served = {path: method_of_weights(path) for path in paths}
    folder = dataset.root / "weights"
    if not served:
        need = ", ".join(name for name, kinds in asked.items() if "" not in kinds)
        fix = f"Run the train stage first, name weights, or leave {need} out of the methods."
        raise WeightsError("there are no weights to evaluate", path=folder, fix=fix)
    for name, kinds in asked.items():
        # who asks for all methods gets those that have been trained
        if "" not in kinds and not kinds & {*served.values()} and config.methods != EvaluateConfig().methods:
            fix = f"Run the train stage first, name weights, or leave {name} out of the methods."
            problem = f"there are no weights of {' or '.join(sorted(kinds))} to evaluate"
            raise WeightsError(problem, path=folder, fix=fix)
    return {path: kind for path, kind in served.items() if kind in wanted}


def own_weights(dataset: Dataset) -> list[Path]:
    """The weights in the dataset's folder, which must be trained on what the dataset now holds."""
    paths = {name: weights_path(dataset, name) for name in learned()}
    found = {name: path for name, path in paths.items() if path.is_file()}
    for name, path in found.items():
        # compact tables hold no matches: what has learnt from these has learnt from the dataset they were copied from
        if name in scorers() and not was_trained_on(dataset, read_training(path)):
            fix = "Run the train stage again, remove the file, or name weights in evaluate.weights."
            raise WeightsError(
                "these weights were trained on other data than the dataset now holds", path=path, fix=fix
            )
    return list(found.values())


def check_unseen(scenes: Sequence[SceneFolder], weights: Weights) -> None:
    """Raise a WeightsError if weights would be tested on a scene they have learnt from."""
    landmarks = {fingerprint(scene.landmarks): scene.name for scene in scenes if scene.landmarks.is_file()}
    for path in weights:
        for seen in read_training(path).get("landmarks", {}).values():
            if seen in landmarks:
                problem = "these weights have learnt from a scene of the test split"
                fix = "Train again without that scene, or evaluate on others."
                raise WeightsError(problem, path=path, value=landmarks[seen], fix=fix)


def score_scenes(
    dataset: Dataset,
    scenes: Sequence[SceneFolder],
    tables: Sequence[pd.DataFrame],
    config: EvaluateConfig,
    weights: Weights,
    device: str,
    progress: bool,
    occlusion: OcclusionConfig | None,
) -> tuple[dict[str, Float], str]:
    """Scores (B,) by method of the views in scenes' tables, which are binned once, and the occlusion model's name.

    The occlusion model is that to see the landmarks by; None for the one that is stored with the sampled locations.

    Raises a TableError if a method gives scores that are not finite; a WeightsError if weights were trained for another
    field of view; a MapError or SceneError if a scene has no landmarks, or no mesh where one is needed; a ConfigError
    if the reference is none of the methods.
    """
    scores: dict[str, list[Float]] = {}
    used: set[str] = set()
    text = f"score {scenes[0].split} views" + ("" if occlusion is None else f", {occlusion.model}")
    with tqdm(total=sum(map(len, tables)), desc=text, unit="view", disable=not progress) as bar:
        for scene, table in zip(scenes, tables, strict=True):
            localization_map = scene.localization_map(device=device)
            # a release has no mesh, but what each location sees by it
            if occlusion is not None and (scene.mesh.is_file() or occlusion.model != localization_map.occlusion.name):
                opened = SceneEnvironment(scene, config=EnvironmentConfig(occlusion), device=device, progress=progress)
                localization_map = replace(localization_map, occlusion=opened.occlusion)
            used.add(localization_map.occlusion.name)
            cam_from_world = poses(table)
            looking = None
            of_scene: dict[str, Float] = {}
            for camera, rows in views_by_camera(scene, table, BLOCK):
                if camera != looking:
                    looking = camera
                    looked_at = localization_map.of_camera(camera)
                    scorers = scorers_of(looked_at, config, weights)
                    reference_method(scorers, config.reference)  # an unknown one is told before the work
                block = cam_from_world[rows]
                binned = looked_at.bin_views(block)
                for method, scorer in scorers.items():
                    values = scorer.score_binned(block, binned)
                    if not np.isfinite(values).all():
                        problem = "a method gives scores that are not finite"
                        fix = "Check the scene's landmarks and poses, and the weights; or leave the method out."
                        raise TableError(problem, path=scene.folder, value=method, fix=fix)
                    of_scene.setdefault(method, np.empty(len(table)))[rows] = values
                bar.update(len(block))
            for method, values in of_scene.items():
                scores.setdefault(method, []).append(values)
    return {method: np.concatenate(parts) for method, parts in scores.items()}, " ".join(sorted(used))


def scorers_of(
    localization_map: LocalizationMap, config: EvaluateConfig, weights: Weights, anywhere: bool = False
) -> dict[str, Scorer]:
    """The scorers to compare, by the names of their rows; `anywhere` as of `make_scorer`, or as the options say."""
    found: dict[str, Scorer] = {}
    insists = anywhere or config.anywhere
    for method in methods_named(config.methods, scorers()):
        paths = [path for path, kind in weights.items() if kind == method.weights]
        for path in paths if method.weights else [None]:
            scorer = make_scorer(method.name, localization_map, config.seed, path, config.heading, insists)
            # two files of one method are told apart by their names
            which = SHIPPED if path is not None and path.parent == shipped(WEIGHTS) else path
            found[f"{method.name} {which}" if method.name in found else method.name] = scorer
    return found
