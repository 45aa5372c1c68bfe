"""One evaluation: the views of a split scored by every method, seen by every occlusion model, and compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.viewpoint_table import UNLABELLED, is_good
from wheretolook.evaluation.calibration import calibration_rows, fit_temperature
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.photographs import LeftOutPhotographs, photographs_set, score_photographs
from wheretolook.evaluation.ranking import TestViews
from wheretolook.evaluation.results import Evaluation, ScoredSet
from wheretolook.evaluation.scores import choose, is_probability, score_table
from wheretolook.evaluation.scoring import Weights, check_unseen, choose_weights, score_scenes
from wheretolook.evaluation.views import CandidateSet, candidate_sets, views_of
from wheretolook.geometry.poses import Float
from wheretolook.scorers.registry import methods_named, scorers
from wheretolook.training.provenance import TrainedModel
from wheretolook.utils.errors import TableError
from wheretolook.visibility.config import OcclusionConfig

Scores = Mapping[str, Float]  # by method


def compare_methods(
    dataset: Dataset,
    config: EvaluateConfig,
    models: Sequence[TrainedModel | Path] | None = None,
    progress: bool = True,
    device: str = "cpu",
    occlusion: OcclusionConfig = OcclusionConfig(),
    photographs: Sequence[LeftOutPhotographs] = (),
) -> Evaluation:
    """Score and compare all methods on the scenes of one split; see `wheretolook.stages.evaluate.evaluate_methods`."""
    scenes = dataset.split(config.split)
    if not scenes:
        fix = "Make one, or choose another split."
        raise TableError(f"the dataset has no {config.split} scene", path=dataset.root, fix=fix)
    weights = choose_weights(dataset, config, models)
    if config.split == "test":
        check_unseen(scenes, weights)
    occlusions = [None if name is None else replace(occlusion, model=name) for name in config.occlusions or (None,)]
    temperatures, n_val = _fit_temperatures(dataset, config, weights, device, progress, occlusions[0])

    def tabulated(among: Sequence[SceneFolder], candidates: CandidateSet, values: Scores, used: str) -> ScoredSet:
        choices = choose(candidates.views, values, config.top_n)
        part = score_table(candidates.views, values, [one.name for one in among], config, temperatures, choices)
        part.insert(1, "occlusion", used)
        part.insert(2, "candidates", candidates.name)
        return ScoredSet(used, candidates, values, choices, part, among)

    scored: list[ScoredSet] = []
    all_views: list[TestViews] = []
    calibration = pd.DataFrame()
    photographed = {one.scene.name for one in photographs}
    rendered = [scene for scene in scenes if scene.name not in photographed or has_labels(scene)]
    if rendered:
        tables = [scene.read_table() for scene in rendered]
        views, location_id = views_of(rendered, tables, config)
        all_views.append(views)
        sets = candidate_sets(views, location_id, rendered, tables, config)
        for model in occlusions:
            scores, used = score_scenes(dataset, rendered, tables, config, weights, device, progress, model)
            if not scored:
                calibration = _calibration(scores, views.good[:, 0], temperatures, n_val)
            for candidates in sets:
                subset = {method: values[candidates.mask] for method, values in scores.items()}
                scored.append(tabulated(rendered, candidates, subset, used))
    if photographs:
        candidates = photographs_set(photographs, config)
        all_views.append(candidates.views)
        scores = score_photographs(photographs, config, weights, progress)
        if not rendered:
            calibration = _calibration(scores, candidates.views.good[:, 0], temperatures, n_val)
        used = " ".join(sorted({one.occlusion for one in photographs}))
        scored.append(tabulated([one.scene for one in photographs], candidates, scores, used))
    table = pd.concat([one.table for one in scored], ignore_index=True)
    return Evaluation(scenes, weights, all_views[0], scored, table, calibration)


def has_labels(scene: SceneFolder) -> bool:
    """Whether views of a scene have been labelled."""
    return scene.table.is_file() and bool((scene.read_table()["status"] != UNLABELLED).any())


def _fit_temperatures(
    dataset: Dataset,
    config: EvaluateConfig,
    weights: Weights,
    device: str,
    progress: bool,
    occlusion: OcclusionConfig | None,
) -> tuple[dict[str, float], int]:
    """Temperature of each learned method, and the number of labelled views of the val scenes it was fitted on."""
    labelled: list[tuple[SceneFolder, pd.DataFrame]] = []
    if weights and config.split != "val":  # fitted on what it is judged by, it would flatter
        for scene in dataset.split("val"):
            table = scene.read_table() if scene.table.is_file() else None
            if table is not None and (table["status"] != UNLABELLED).any():
                labelled.append((scene, table[table["status"] != UNLABELLED]))
    if not labelled:
        return {}, 0
    scenes, tables = zip(*labelled, strict=True)
    chosen = methods_named(config.methods, scorers())
    config = replace(config, methods=tuple(method.name for method in chosen if method.probability), reference="")
    scores, _ = score_scenes(dataset, scenes, tables, config, weights, device, progress, occlusion)
    good = np.concatenate([is_good(table, *config.thresholds[0]) for table in tables])
    return {method: fit_temperature(values, good) for method, values in scores.items()}, len(good)


def _calibration(
    scores: Mapping[str, Float], good: NDArray[np.bool_], temperatures: Mapping[str, float], n_val: int
) -> pd.DataFrame:
    """Reliability curves of the learned methods over all labelled views, one below the other; empty without any.

    Columns: method, temperature, n_val (views that it was fitted on), then those of `calibration_rows`.
    """
    parts = []
    for name, values in scores.items():
        if is_probability(name):
            temperature = temperatures.get(name, float("nan"))
            about = {"method": name, "temperature": temperature, "n_val": n_val}
            curves = calibration_rows(values, good, temperature)
            parts.append(pd.DataFrame({**about, **{str(column): curves[column] for column in curves}}))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()
