"""The evaluate stage: score the viewpoints of the test scenes with every method, tabulate, draw and log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wheretolook.dataset import Dataset, SceneFolder
from wheretolook.errors import TableError
from wheretolook.evaluation.calibration import calibration_rows, fit_temperature
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.report import score_markdown
from wheretolook.evaluation.results import ScoredSet, log_evaluation, results_folder, write_results
from wheretolook.evaluation.scores import PROBABILITIES, Method, choose, score_table
from wheretolook.evaluation.scoring import Weights, check_unseen, choose_weights, score_scenes
from wheretolook.evaluation.views import candidate_sets, views_of
from wheretolook.geometry import Float
from wheretolook.table import UNLABELLED, is_good
from wheretolook.tracking import TrackingConfig
from wheretolook.visibility.config import OcclusionConfig

if TYPE_CHECKING:
    from wheretolook.learning.training import TrainedModel


def evaluate(
    dataset: Dataset,
    config: EvaluateConfig = EvaluateConfig(),
    tracking: TrackingConfig = TrackingConfig(),
    models: Sequence[TrainedModel | Path] | None = None,
    progress: bool = True,
    device: str = "cpu",
    occlusion: OcclusionConfig = OcclusionConfig(),
) -> pd.DataFrame:
    """Compare all methods on the scenes of one split.

    Writes the table as `<dataset>/results/scores.csv` and `scores.md`, a figure `scores.png`, the reliability curves of
    learned methods as `calibration.csv`, and an MLflow run with one nested run for each method, inputs, N, occlusion
    model and candidate set, each with a table of what was chosen at each location, `locations.parquet`. With several
    occlusion models `occlusion.png` compares them.

    The temperatures of learned methods are fitted on the labelled views of the val scenes, seen by the first occlusion
    model, and hold for all rows; without val scenes, or when these are evaluated, they are not known.

    Args:
        dataset: labelled scenes; they need not be of the dataset the models were trained on.
        config: methods, values of N, thresholds.
        tracking: where to log.
        models: models or weights files to compare, instead of those that `config.weights` tells.
        progress: show a progress bar, and print the table at the end.
        device: where kernels and networks run, "cpu" or a CUDA device.
        occlusion: settings of the models that `config.occlusions` names.

    Returns:
        The tables of `wheretolook.evaluation.scores.score_table`, one below the other, with columns `occlusion` and
        `candidates`.

    Raises:
        TableError: there is no scene of the split, a viewpoint has no label, or all labels of a candidate set are of
            one class.
        WeightsError: weights are missing, or were trained for another field of view.
        MapError: a scene has no landmarks.
        ConfigError: the reference is none of the methods.
    """
    scenes = dataset.split(config.split)
    if not scenes:
        fix = "Make one, or choose another split."
        raise TableError(f"the dataset has no {config.split} scene", path=dataset.root, fix=fix)
    weights = choose_weights(dataset, config, models)
    if config.split == "test":
        check_unseen(scenes, weights)
    tables = [scene.read_table() for scene in scenes]
    views, location_id = views_of(scenes, tables, config)
    sets = candidate_sets(views, location_id, scenes, tables, config)
    occlusions = [None if name is None else replace(occlusion, model=name) for name in config.occlusions or (None,)]
    temperatures, n_val = _fit_temperatures(dataset, config, weights, device, progress, occlusions[0])
    scored: list[ScoredSet] = []
    calibration = pd.DataFrame()
    for model in occlusions:
        scores, used = score_scenes(dataset, scenes, tables, config, weights, device, progress, model)
        if not scored:
            calibration = _calibration(scores, views.good[:, 0], temperatures, n_val)
        for candidates in sets:
            subset = {method: values[candidates.mask] for method, values in scores.items()}
            choices = choose(candidates.views, subset, config.top_n)
            names = [scene.name for scene in scenes]
            part = score_table(candidates.views, subset, names, config, temperatures, choices)
            part.insert(2, "occlusion", used)
            part.insert(3, "candidates", candidates.name)
            scored.append(ScoredSet(used, candidates, subset, choices, part))
    table = pd.concat([one.table for one in scored], ignore_index=True)
    title = f"Localization score on {dataset.name}" + (f", {config.split} scenes" if config.split != "test" else "")
    folder = results_folder(dataset, config)
    write_results(folder, table, calibration, title)
    log_evaluation(dataset, scenes, config, tracking, weights, views, scored, occlusion, folder)
    if progress:
        print(score_markdown(table, title))
    return table


def _fit_temperatures(
    dataset: Dataset,
    config: EvaluateConfig,
    weights: Weights,
    device: str,
    progress: bool,
    occlusion: OcclusionConfig | None,
) -> tuple[dict[Method, float], int]:
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
    learned = replace(config, methods=tuple(name for name in config.methods if name in PROBABILITIES), reference="")
    scores, _ = score_scenes(dataset, scenes, tables, learned, weights, device, progress, occlusion)
    good = np.concatenate([is_good(table, *config.thresholds[0]) for table in tables])
    return {method: fit_temperature(values, good) for method, values in scores.items()}, len(good)


def _calibration(
    scores: Mapping[Method, Float], good: NDArray[np.bool_], temperatures: Mapping[Method, float], n_val: int
) -> pd.DataFrame:
    """Reliability curves of the learned methods over all labelled views, one below the other; empty without any.

    Columns: method, inputs, temperature, n_val (views that it was fitted on), then those of `calibration_rows`.
    """
    parts = []
    for (name, inputs), values in scores.items():
        if name in PROBABILITIES:
            temperature = temperatures.get((name, inputs), float("nan"))
            about = {"method": name, "inputs": inputs, "temperature": temperature, "n_val": n_val}
            curves = calibration_rows(values, good, temperature)
            parts.append(pd.DataFrame({**about, **{str(column): curves[column] for column in curves}}))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()
