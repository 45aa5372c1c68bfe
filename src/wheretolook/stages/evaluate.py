"""The evaluate stage: score the viewpoints of the test scenes with every method, tabulate, draw and log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wheretolook.dataset.folders import Dataset, SceneFolder
from wheretolook.evaluation.calibration import calibration_rows, fit_temperature
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.report import score_markdown
from wheretolook.evaluation.results import ScoredSet, results_folder
from wheretolook.evaluation.scores import choose, score_table
from wheretolook.evaluation.scoring import Weights, check_unseen, choose_weights, score_scenes
from wheretolook.evaluation.views import candidate_sets, views_of
from wheretolook.geometry.poses import Float
from wheretolook.methods.names import PROBABILITIES, Method
from wheretolook.utils.errors import TableError
from wheretolook.utils.tracking import TrackingConfig
from wheretolook.viewpoints.table import UNLABELLED, is_good
from wheretolook.visibility.config import OcclusionConfig

if TYPE_CHECKING:
    from wheretolook.learning.provenance import TrainedModel
from typing import TYPE_CHECKING

from wheretolook.config import Experiment
from wheretolook.stages.inputs import Say, Tick, dataset_after

if TYPE_CHECKING:
    import pandas as pd
from dataclasses import asdict
from tempfile import TemporaryDirectory

import pandas as pd

from wheretolook.evaluation.paper_tables import write_paper_tables
from wheretolook.evaluation.ranking import TestViews
from wheretolook.evaluation.results import (
    CALIBRATION_CSV,
    CALIBRATION_PNG,
    LOCATIONS_PARQUET,
    OCCLUSION_PNG,
    REGRET_PNG,
    SCORES_CSV,
    SCORES_MD,
    SCORES_PNG,
    VARIANTS_CSV,
    _location_table,
    evaluation_params,
    runs_of_rows,
)
from wheretolook.evaluation.score_table import main_rows
from wheretolook.evaluation.scores import read_scores
from wheretolook.fisher.soft_visibility import GaussianProcessVisibility, cone_half_angle
from wheretolook.utils.files import write_text
from wheretolook.utils.tracking import log, start_run


def evaluate_methods(
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


def evaluate(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> pd.DataFrame:
    """Stage 6: the score table of all methods on the test scenes, `<dataset>/results/`, and nested MLflow runs."""

    dataset = dataset_after(experiment, "label")
    scores = evaluate_methods(
        dataset, experiment.evaluate, experiment.tracking, device=experiment.warp_device, occlusion=experiment.occlusion
    )
    tick(1)
    return scores


def write_results(folder: Path, table: pd.DataFrame, calibration: pd.DataFrame, title: str) -> None:
    """Write tables, report and figures; what belongs to an earlier evaluation goes.

    Args:
        folder: where; made when needed.
        table: score tables of all occlusion models and candidate sets, one below the other.
        calibration: reliability curves of learned methods, as `calibration_figure` wants them; empty without any.
        title: of the report.
    """
    from wheretolook.figures.calibration import calibration_figure
    from wheretolook.figures.occlusion import occlusion_figure
    from wheretolook.figures.scores import regret_figure, score_figure
    from wheretolook.figures.style import save_figure

    folder.mkdir(parents=True, exist_ok=True)
    for name, text in ((SCORES_CSV, table.to_csv(index=False)), (SCORES_MD, score_markdown(table, title))):
        write_text(folder / name, text)
    variants = folder / VARIANTS_CSV
    if variants.is_file():  # the paper's tables have a row for each of the network's inputs, which a release knows
        known = {*zip(table["method"], table["inputs"], strict=True)}
        others = main_rows(read_scores(variants))
        methods = zip(others["method"], others["inputs"], strict=True)
        others = others[[method not in known for method in methods]]
        write_paper_tables(pd.concat([table, others], ignore_index=True), folder)
    else:
        write_paper_tables(table, folder)
    save_figure(score_figure(table), folder / SCORES_PNG)
    save_figure(regret_figure(table), folder / REGRET_PNG)
    if table["occlusion"].nunique() > 1:
        save_figure(occlusion_figure(table), folder / OCCLUSION_PNG)
    else:
        (folder / OCCLUSION_PNG).unlink(missing_ok=True)
    if len(calibration):
        write_text(folder / CALIBRATION_CSV, calibration.to_csv(index=False))
        save_figure(calibration_figure(calibration), folder / CALIBRATION_PNG)
    else:
        for name in (CALIBRATION_CSV, CALIBRATION_PNG):
            (folder / name).unlink(missing_ok=True)


def log_evaluation(
    dataset: Dataset,
    scenes: Sequence[SceneFolder],
    config: EvaluateConfig,
    tracking: TrackingConfig,
    weights: Weights,
    views: TestViews,
    scored: Sequence[ScoredSet],
    occlusion: OcclusionConfig,
    results: Path,
) -> None:
    """Log an evaluation: a run with the files of `results`, and in it one for each row over all scenes.

    Args:
        dataset: evaluated.
        scenes: of the split.
        config: of the evaluation.
        tracking: where to log.
        weights: of methods that have learnt.
        views: all labelled views.
        scored: of each occlusion model and candidate set.
        occlusion: settings of occlusion models, logged if the configuration names any.
        results: folder of the files.
    """
    params = {
        **evaluation_params(dataset, scenes, weights),
        **{name: value for name, value in asdict(config).items() if name not in ("weights", "methods")},
        **(
            {f"occlusion_{name}": value for name, value in asdict(occlusion).items() if name != "model"}
            if config.occlusions
            else {}
        ),
    }
    if any(name.startswith("fisher") and "gp" in name for name in config.methods):
        process = GaussianProcessVisibility.fitted(cone_half_angle(dataset.camera))
        params |= {"gp_factors": process.n_factors, "gp_length": round(process.length, 4)}
        params["gp_held_out_rmse"] = round(process.held_out_error(), 4)
    positives = float(views.good[:, 0].mean())
    metrics = {"n_locations": views.n_locations, "n_views": len(views.good), "positives": positives}
    with (
        TemporaryDirectory() as folder,
        start_run(
            tracking, f"evaluate {dataset.name}", "evaluate", params, tags={"dataset": dataset.name}
        ) as (client, run),
    ):  # fmt: skip
        log(client, run, metrics=metrics)
        for file in results.iterdir():
            if file.is_file():
                client.log_artifact(run, str(file))
        for one in scored:
            for row, nested in runs_of_rows(one.table, params):
                chosen = _location_table(one, (row["method"], row["inputs"]), row["top_n"], scenes, config)
                chosen.to_parquet(Path(folder) / LOCATIONS_PARQUET, index=False)
                with start_run(tracking, nested.name, "evaluate", nested.params, parent=run) as (_, child):
                    log(client, child, metrics=nested.metrics)
                    client.log_artifact(child, str(Path(folder) / LOCATIONS_PARQUET))
