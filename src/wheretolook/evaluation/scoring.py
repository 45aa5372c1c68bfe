"""Score the labelled views of a split by every method and occlusion model, and compare the methods."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import NoReturn

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.dataset.layout import Dataset, SceneFolder, views_by_camera
from wheretolook.dataset.scene import Scene
from wheretolook.dataset.viewpoint_table import UNLABELLED, is_good, poses
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.ranking import candidate_masks, check_labels, numbered, views_of
from wheretolook.evaluation.results import PHOTOGRAPHS, Evaluation, ScoredSet, choose, reference_method, score_table
from wheretolook.evaluation.statistics import calibration_rows, fit_temperature
from wheretolook.geometry.poses import Float
from wheretolook.geometry.views import Views
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.registry import is_probability, learned, make_scorer, members, methods_named, scorers
from wheretolook.training.provenance import TrainedModel, was_trained_on, weights_path
from wheretolook.training.weights import method_of_weights, read_training
from wheretolook.utils.errors import TableError, WeightsError
from wheretolook.utils.files import fingerprint
from wheretolook.utils.package import WEIGHTS, shipped
from wheretolook.visibility.config import OcclusionConfig

Weights = Mapping[Path, str]  # files of weights, and the method that each serves


def compare_methods(
    dataset: Dataset,
    config: EvaluateConfig,
    models: Sequence[TrainedModel | Path] | None = None,
    progress: bool = True,
    device: str = "cpu",
    occlusion: OcclusionConfig = OcclusionConfig(),
    photographs: Sequence[HeldOutPhotographs] = (),
) -> Evaluation:
    """Score and compare all methods on the scenes of one split; see the evaluate command."""
    scenes = dataset.split(config.split)
    if not scenes:
        fix = "Make one, or choose another split."
        raise TableError(f"the dataset has no {config.split} scene", path=dataset.root, fix=fix)
    weights = choose_weights(dataset, config, models)
    if config.split == "test":
        check_unseen(scenes, weights)
    occlusions = [None if name is None else replace(occlusion, model=name) for name in config.occlusions or (None,)]
    temperatures, n_val = _fit_temperatures(dataset, config, weights, device, progress, occlusions[0])
    photographed = {one.scene.name for one in photographs}
    rendered = [scene for scene in scenes if scene.name not in photographed or has_labels(scene)]
    parts: list[ScoredSet] = []
    scored: list[tuple[Views, Mapping[str, Float]]] = []  # of each occlusion model
    if rendered:
        tables = [scene.read_table() for scene in rendered]
        views = views_of(rendered, tables, config)
        masks = candidate_masks(views, rendered, tables, config)
        for model in occlusions:
            scores, used = score_scenes(rendered, tables, config, weights, device, progress, model)
            scored.append((views, scores))
            for name, mask in masks.items():
                of_set = {method: values[mask] for method, values in scores.items()}
                parts.append(_compare(name, numbered(views[mask]), of_set, rendered, used, config, temperatures))
    if photographs:
        views = photographs_views(photographs, config)
        scores = score_photographs(photographs, config, weights, progress)
        scored.append((views, scores))
        used = " ".join(sorted({one.occlusion for one in photographs}))
        of_views = [one.scene for one in photographs]
        parts.append(_compare(PHOTOGRAPHS, views, scores, of_views, used, config, temperatures))
    first_views, first_scores = scored[0]
    table = pd.concat([part.table for part in parts], ignore_index=True)
    calibration = _calibration(first_scores, first_views.good[:, 0], temperatures, n_val)
    return Evaluation(scenes, weights, first_views, parts, table, calibration)


def _compare(
    name: str,
    views: Views,
    scores: Mapping[str, Float],
    scenes: Sequence[SceneFolder],
    occlusion: str,
    config: EvaluateConfig,
    temperatures: Mapping[str, float],
) -> ScoredSet:
    """Choose among the views of a candidate set by each method's scores (V,), and tabulate the results."""
    choices = choose(views, scores, config.top_n)
    table = score_table(views, scores, [scene.name for scene in scenes], config, temperatures, choices)
    table.insert(1, "occlusion", occlusion)
    table.insert(2, "candidates", name)
    return ScoredSet(views, scores, choices, table, scenes)


def has_labels(scene: SceneFolder) -> bool:
    """Whether a scene has labelled views."""
    return scene.table.is_file() and bool((scene.read_table()["status"] != UNLABELLED).any())


def _fit_temperatures(
    dataset: Dataset,
    config: EvaluateConfig,
    weights: Weights,
    device: str,
    progress: bool,
    occlusion: OcclusionConfig | None,
) -> tuple[dict[str, float], int]:
    """Fit each learned method's temperature on the labelled views of the val scenes; also returns their number."""
    if not weights or config.split == "val":  # fitted on the views it is judged by, it would be optimistic
        return {}, 0
    scenes = [scene for scene in dataset.split("val") if has_labels(scene)]
    if not scenes:
        return {}, 0
    tables = []
    for scene in scenes:
        table = scene.read_table()
        tables.append(table[table["status"] != UNLABELLED])
    chosen = methods_named(config.methods, scorers())
    config = replace(config, methods=tuple(method.name for method in chosen if method.probability), reference="")
    scores, _ = score_scenes(scenes, tables, config, weights, device, progress, occlusion)
    good = np.concatenate([is_good(table, *config.thresholds[0]) for table in tables])
    return {method: fit_temperature(values, good) for method, values in scores.items()}, len(good)


def _calibration(
    scores: Mapping[str, Float], good: NDArray[np.bool_], temperatures: Mapping[str, float], n_val: int
) -> pd.DataFrame:
    """Return the reliability curves of all learned methods over all labelled views; empty without any.

    Columns: method, temperature, n_val (views that it was fitted on), then those of `calibration_rows`.
    """
    parts = []
    for name, values in scores.items():
        if is_probability(name):
            temperature = temperatures.get(name, np.nan)
            curves = calibration_rows(values, good, temperature)
            curves.insert(0, "method", name)
            curves.insert(1, "temperature", temperature)
            curves.insert(2, "n_val", n_val)
            parts.append(curves)
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()


def choose_weights(dataset: Dataset, config: EvaluateConfig, models: Sequence[TrainedModel | Path] | None) -> Weights:
    """Return the weights to evaluate: the given models, or those in the configuration, or the dataset's own.

    Raises a WeightsError if there are none for a method that needs them, or the dataset's were trained on other data.
    """
    kinds = {name: {method.weights for method in members(name, scorers())} for name in config.methods}
    wanted = set().union(*kinds.values()) - {""}
    if not wanted:
        return {}
    if models is not None:
        paths = [model if isinstance(model, Path) else model.path for model in models]
    else:
        paths = list(config.weights) or own_weights(dataset)
    weights = {path: method_of_weights(path) for path in paths}
    available = {"", *weights.values()}
    missing = [name for name, of_name in kinds.items() if not of_name & available]
    # the default asks for all methods, and takes those that have been trained
    if missing and (not weights or config.methods != EvaluateConfig().methods):
        fix = f"Run the train stage first, name weights, or leave {', '.join(missing)} out of the methods."
        raise WeightsError("there are no weights to evaluate", path=dataset.root / "weights", value=missing, fix=fix)
    return {path: kind for path, kind in weights.items() if kind in wanted}


def own_weights(dataset: Dataset) -> list[Path]:
    """Return the weights in a dataset's folder; a WeightsError is raised if the dataset's data has changed since."""
    paths = [path for name in learned() if (path := weights_path(dataset, name)).is_file()]
    for path in paths:
        # methods that learn from matches cannot be compared where compact tables hold none
        if path.stem in scorers() and not was_trained_on(dataset, read_training(path)):
            fix = "Run the train stage again, remove the file, or name weights in evaluate.weights."
            raise WeightsError("the dataset has changed since these weights were trained", path=path, fix=fix)
    return paths


def check_unseen(scenes: Sequence[SceneFolder], weights: Weights) -> None:
    """Raise a WeightsError if weights would be tested on a scene that they were trained on."""
    tested = {fingerprint(scene.landmarks): scene.name for scene in scenes if scene.landmarks.is_file()}
    for path in weights:
        for trained in read_training(path).get("landmarks", {}).values():
            if trained in tested:
                fix = "Train again without that scene, or evaluate on others."
                problem = "these weights were trained on a scene of the test split"
                raise WeightsError(problem, path=path, value=tested[trained], fix=fix)


def score_scenes(
    scenes: Sequence[SceneFolder],
    tables: Sequence[pd.DataFrame],
    config: EvaluateConfig,
    weights: Weights,
    device: str,
    progress: bool,
    occlusion: OcclusionConfig | None,
) -> tuple[dict[str, Float], str]:
    """Score (B,) the views in scenes' tables by each method; also returns the occlusion model's name.

    The occlusion model None is the one that is stored with the sampled locations.

    Raises:
        TableError: a method gives scores that are not finite.
        WeightsError: weights were trained for another field of view.
        MapError, SceneError: a scene has no landmarks, or no mesh where one is needed.
        ConfigError: the reference is none of the methods.
    """
    parts: list[dict[str, Float]] = []
    used: set[str] = set()
    text = f"score {scenes[0].split} views" + ("" if occlusion is None else f", {occlusion.model}")
    with tqdm(total=sum(map(len, tables)), desc=text, unit="view", disable=not progress) as bar:
        for scene, table in zip(scenes, tables, strict=True):
            localization_map = _open_map(scene, occlusion, device, progress)
            used.add(localization_map.occlusion.name)
            of_camera = cache(localization_map.of_camera)
            batches = ((rows, of_camera(camera)) for camera, rows in views_by_camera(scene, table, at_most=4096))
            parts.append(score_batches(scene, poses(table), batches, config, weights, bar))
    return join_scores(parts), " ".join(sorted(used))


def _open_map(scene: SceneFolder, occlusion: OcclusionConfig | None, device: str, progress: bool) -> LocalizationMap:
    localization_map = scene.localization_map(device=device)
    # a release has no mesh, but stores visibility by it for each location
    if occlusion is None or not (scene.mesh.is_file() or occlusion.model != localization_map.occlusion.name):
        return localization_map
    opened = Scene(scene, occlusion_config=occlusion, device=device, progress=progress)
    return replace(localization_map, occlusion=opened.occlusion)


def score_batches(
    scene: SceneFolder,
    cam_from_world: Float,
    batches: Iterable[tuple[NDArray[np.int64], LocalizationMap]],
    config: EvaluateConfig,
    weights: Weights,
    bar: tqdm[NoReturn],
    held_out: bool = False,
) -> dict[str, Float]:
    """Score (B,) poses (B, 3, 4) by each method, from batches of their rows and the map that these are scored on.

    Each batch is binned once for all methods. Photographs that are `held_out` are scored on maps of different sizes
    (`score_scale`), on which weights adapted to the whole map are allowed.
    """
    scores: dict[str, Float] = {}
    current = None
    for rows, localization_map in batches:
        if localization_map is not current:
            current = localization_map
            scorers_by_row = scorers_of(localization_map, config, weights, anywhere=held_out)
            reference_method(scorers_by_row, config.reference)  # fails before the work
        batch = cam_from_world[rows]
        binned = localization_map.bin_views(batch)
        for method, scorer in scorers_by_row.items():
            values = scorer.score_binned(batch, binned)
            if not np.isfinite(values).all():
                fix = "Check the scene's landmarks and poses, and the weights; or leave the method out."
                raise TableError("scores of a method are not finite", path=scene.folder, value=method, fix=fix)
            scale = score_scale(scorer.name, localization_map) if held_out else 1
            scores.setdefault(method, np.empty(len(cam_from_world)))[rows] = values * scale
        bar.update(len(batch))
    return scores


def score_scale(method: str, localization_map: LocalizationMap) -> int:
    """Return the factor that makes a method's scores comparable between maps of different sizes."""
    is_share_of_the_map = method in ("expected-inliers", "visible")
    return len(localization_map.landmarks) if is_share_of_the_map else 1


def join_scores(parts: Sequence[Mapping[str, Float]]) -> dict[str, Float]:
    """Concatenate the scores of scenes by method."""
    return {method: np.concatenate([part[method] for part in parts]) for method in parts[0]}


def scorers_of(
    localization_map: LocalizationMap, config: EvaluateConfig, weights: Weights, anywhere: bool = False
) -> dict[str, Scorer]:
    """Return the scorers to compare, by their names in the table.

    With `anywhere` (or the option of that name) weights adapted to another scene are allowed.
    """
    by_name: dict[str, Scorer] = {}
    for method in methods_named(config.methods, scorers()):
        paths = [path for path, kind in weights.items() if kind == method.weights]
        for path in paths if method.weights else [None]:
            # files of the same method are distinguished by their names
            which = "that ships" if path is not None and path.parent == shipped(WEIGHTS) else path
            name = f"{method.name} {which}" if method.name in by_name else method.name
            by_name[name] = make_scorer(
                method.name, localization_map, config.seed, path, config.heading, anywhere or config.anywhere
            )
    return by_name


@dataclass(frozen=True, eq=False)
class HeldOutPhotographs:
    """B photographs of a scene, block after block, and the maps without them.

    Attributes:
        scene: the scene.
        views: columns photograph (number, unique in a block), block, place (number of the location that views of a
            block share), status, error_m (scaled to metres where the map has none) and error_deg.
        poses: (B, 3, 4) cam_from_world.
        maps: rows of `views`, and the map that they are scored on.
    """

    scene: SceneFolder
    views: pd.DataFrame
    poses: Float
    maps: Sequence[tuple[NDArray[np.int64], LocalizationMap]]

    @property
    def occlusion(self) -> str:
        """Name of the occlusion model."""
        return self.maps[0][1].occlusion.name


def photographs_views(photographs: Sequence[HeldOutPhotographs], config: EvaluateConfig) -> Views:
    """Return the photographs of scenes as `numbered` views; those of a block at the same place are one location.

    Locations with a single view count, although they leave no choice. Raises a TableError if all photographs have the
    same label.
    """
    parts = []
    for number, one in enumerate(photographs):
        part = Views(
            one.poses,
            scene=np.full(len(one.views), number),
            location_id=one.views["place"].to_numpy(np.int64),
            block=one.views["block"].to_numpy(np.int64),
            viewpoint_id=one.views["photograph"].to_numpy(np.int64),
            good=np.stack([is_good(one.views, max_m, max_deg) for max_m, max_deg in config.thresholds], axis=-1),
        )
        parts.append(part)
    views = Views.concatenate(parts)
    check_labels(views.good[:, 0], PHOTOGRAPHS, photographs[0].scene.map)
    return numbered(views)


def score_photographs(
    photographs: Sequence[HeldOutPhotographs], config: EvaluateConfig, weights: Weights, progress: bool
) -> dict[str, Float]:
    """Score (B,) the photographs of scenes by each method; raises as `wheretolook.evaluation.scoring.score_scenes`."""
    parts = []
    n_views = sum(len(one.views) for one in photographs)
    with tqdm(total=n_views, desc="score photographs", unit="view", disable=not progress) as bar:
        for one in photographs:
            # the map with most landmarks decides whether weights adapted to another scene are rejected
            largest = max((remaining for _, remaining in one.maps), key=lambda remaining: len(remaining.landmarks))
            scorers_of(largest, config, weights)
            parts.append(score_batches(one.scene, one.poses, one.maps, config, weights, bar, held_out=True))
    return join_scores(parts)
