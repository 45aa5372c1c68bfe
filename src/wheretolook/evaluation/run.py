"""Score the labelled views of a split by every method and occlusion model, and compare the methods."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.viewpoint_table import UNLABELLED, is_good
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.ranking import CandidateSet, RankedViews, candidate_sets, views_of
from wheretolook.evaluation.results import Evaluation, ScoredSet, choose, score_table
from wheretolook.evaluation.scoring import (
    HeldOutPhotographs,
    Weights,
    check_unseen,
    choose_weights,
    photographs_set,
    score_photographs,
    score_scenes,
)
from wheretolook.evaluation.statistics import calibration_rows, fit_temperature
from wheretolook.geometry.poses import Float
from wheretolook.scorers.registry import is_probability, methods_named, scorers
from wheretolook.training.provenance import TrainedModel
from wheretolook.utils.errors import TableError
from wheretolook.visibility.config import OcclusionConfig


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
    scored: list[tuple[RankedViews, Mapping[str, Float]]] = []  # of each occlusion model
    if rendered:
        tables = [scene.read_table() for scene in rendered]
        views, location_id = views_of(rendered, tables, config)
        sets = candidate_sets(views, location_id, rendered, tables, config)
        for model in occlusions:
            scores, used = score_scenes(rendered, tables, config, weights, device, progress, model)
            scored.append((views, scores))
            parts += [_compare(candidates, scores, rendered, used, config, temperatures) for candidates in sets]
    if photographs:
        held_out = photographs_set(photographs, config)
        scores = score_photographs(photographs, config, weights, progress)
        scored.append((held_out.views, scores))
        used = " ".join(sorted({one.occlusion for one in photographs}))
        parts.append(_compare(held_out, scores, [one.scene for one in photographs], used, config, temperatures))
    first_views, first_scores = scored[0]
    table = pd.concat([part.table for part in parts], ignore_index=True)
    calibration = _calibration(first_scores, first_views.good[:, 0], temperatures, n_val)
    return Evaluation(scenes, weights, first_views, parts, table, calibration)


def _compare(
    candidates: CandidateSet,
    scores: Mapping[str, Float],
    scenes: Sequence[SceneFolder],
    occlusion: str,
    config: EvaluateConfig,
    temperatures: Mapping[str, float],
) -> ScoredSet:
    """Choose among one set of candidates by each method, and tabulate the results."""
    scores = {method: values[candidates.mask] for method, values in scores.items()}
    choices = choose(candidates.views, scores, config.top_n)
    table = score_table(candidates.views, scores, [scene.name for scene in scenes], config, temperatures, choices)
    table.insert(1, "occlusion", occlusion)
    table.insert(2, "candidates", candidates.name)
    return ScoredSet(candidates, scores, choices, table, scenes)


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
    tables = [table[table["status"] != UNLABELLED] for table in (scene.read_table() for scene in scenes)]
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
