"""Results of an evaluation: files in the dataset's folder, and runs in the tracking store."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.thresholds import ALL, threshold_key
from wheretolook.dataset.viewpoint_table import FIRST
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.ranking import CandidateViews
from wheretolook.evaluation.scores import Choices, is_random, main_rows, methods_of, read_scores, threshold_keys
from wheretolook.evaluation.views import CandidateSet
from wheretolook.geometry.poses import Float
from wheretolook.scorers.registry import methods_named, scorers
from wheretolook.scorers.styles import ORACLE
from wheretolook.tracking.config import TrackingConfig
from wheretolook.tracking.runs import (
    ALL_METHODS,
    AUC,
    BEST_TAG,
    FINGERPRINT_TAG,
    REGRET,
    SHARE,
    NestedRun,
    artifact,
    fingerprint_of,
    joined,
    log,
    log_nested,
    logged_last,
    newest_run,
    start_run,
)
from wheretolook.utils.files import fingerprint, temporary_folder
from wheretolook.visibility.config import OcclusionConfig

SCORES_CSV = "scores.csv"
SCORES_MD = "scores.md"
SCORES_PNG = "scores.png"
OCCLUSION_PNG = "occlusion.png"
CALIBRATION_CSV = "calibration.csv"
CALIBRATION_PNG = "calibration.png"
REGRET_PNG = "regret.png"
"""Files of an evaluation, in `<dataset>/results/` and as artifacts of its run."""

VARIANTS_CSV = "variants.csv"
"""In a release's `results/`: scores of the networks for all inputs, as `scores.csv`, before one was chosen to ship."""

LOCATIONS_PARQUET = "locations.parquet"  # artifact of each nested run, see `location_table`

_RUN_KEY = ("method", "occlusion", "candidates")  # one nested run for each combination
_OF_ALL_VIEWS = ("n_locations", "average_precision", "roc_auc", "ece", "ece_scaled", "temperature")
"""Columns of a score table that do not depend on N, logged once."""
_OF_EACH_THRESHOLD = ("raw", "any", "normalized", "regret")
_OF_FIRST_THRESHOLD = ("regret_low", "regret_high", "difference", "difference_low", "difference_high", "p")
"""Columns that are logged for each N; `scores.csv`, an artifact, has all. Each metric costs MLflow 0.3 ms."""


@dataclass(frozen=True, eq=False)
class ScoredSet:
    """Scores, choices and score table of one candidate set by one occlusion model."""

    candidates: CandidateSet
    scores: Mapping[str, Float]  # (B,) by method
    choices: Choices
    table: pd.DataFrame  # with columns `occlusion` and `candidates`
    scenes: Sequence[SceneFolder]  # by their numbers in the views


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Result of comparing methods on the scenes of a split."""

    scenes: Sequence[SceneFolder]
    weights: Mapping[Path, str]  # files of weights, and the method that each serves
    views: CandidateViews  # all labelled views
    scored: Sequence[ScoredSet]  # for each occlusion model and candidate set
    table: pd.DataFrame  # their score tables, one below the other
    calibration: pd.DataFrame  # reliability curves of learned methods, see `calibration_rows`; empty without any


def results_folder(dataset: Dataset, config: EvaluateConfig) -> Path:
    """Return the folder of an evaluation's files: `<dataset>/results/`, and a folder in it for other splits than test."""
    folder = dataset.root / "results"
    return folder if config.split == "test" else folder / config.split


def evaluation_params(dataset: Dataset, scenes: Sequence[SceneFolder], weights: Iterable[Path]) -> dict[str, Any]:
    """Return the parameters of an evaluation's run that identify its scenes and weights."""
    return {
        "dataset": dataset.name,
        "dataset_fingerprint": Dataset(dataset.root, tuple(scenes)).fingerprint(),
        "scenes": " ".join(scene.name for scene in scenes),
        "weights": " ".join(f"{path.stem}:{fingerprint(path)}" for path in weights),
    }


def runs_of_rows(table: pd.DataFrame, params: Mapping[str, Any]) -> Iterator[NestedRun]:
    """Yield a nested run for each method, occlusion model and candidate set of joined score tables.

    Metrics are those of `first_metrics`, those of all views by their columns, and the others by N, the scene unless it
    is all of them, and the column, such as `top-5/any_5m_10deg`, `top-1/first_raw_0.05m_0.4deg` (by the first RANSAC
    result) and `top-1/apartment-210/regret_0.05m_0.4deg`.
    """
    keys = threshold_keys(table)
    of_pooled = [f"{name}_{key}" for key in keys for name in _OF_EACH_THRESHOLD]
    of_pooled += [f"{name}_{keys[0]}" for name in _OF_FIRST_THRESHOLD]
    of_pooled += [FIRST + name for name in of_pooled if FIRST + name in table]
    for key, rows in table.groupby(list(_RUN_KEY), sort=False):
        own = dict(zip(_RUN_KEY, map(str, key), strict=True))
        pooled = rows[rows["scene"] == ALL]
        metrics = first_metrics(pooled)
        metrics |= {name: float(pooled[name].iloc[0]) for name in _OF_ALL_VIEWS}
        metrics |= _metrics_by_n(pooled, of_pooled) | _metrics_by_n(rows[rows["scene"] != ALL], [f"regret_{keys[0]}"])
        candidates = own["candidates"] if own["candidates"] != ALL else ""
        yield NestedRun(joined(own["method"], own["occlusion"], candidates), {**params, **own}, metrics)


def _metrics_by_n(rows: pd.DataFrame, columns: Iterable[str]) -> dict[str, float]:
    metrics: dict[str, float] = {}
    for row in rows.to_dict("records"):
        prefix = f"top-{row['top_n']}" + ("" if row["scene"] == ALL else f"/{row['scene']}")
        metrics |= {f"{prefix}/{name}": float(row[name]) for name in columns}
    return metrics


def first_metrics(rows: pd.DataFrame) -> dict[str, float]:
    """Return the metrics to sort runs by: of one method's first choice over all scenes, at the first threshold."""
    strictest = threshold_keys(rows)[0]
    first = rows[(rows["scene"] == ALL) & (rows["top_n"] == rows["top_n"].min())].iloc[0]
    columns = {REGRET: f"regret_{strictest}", SHARE: f"raw_{strictest}", AUC: "roc_auc"}
    return {name: float(first[column]) for name, column in columns.items()}


def best_of(table: pd.DataFrame) -> tuple[dict[str, str], dict[str, float]]:
    """Return the method with the least regret in the main rows, as a tag, and its `first_metrics`; empty if none.

    Random choice and the oracle do not count.
    """
    main = main_rows(table)
    methods = [name for name in methods_of(main) if name != ORACLE and not is_random(name)]
    metrics = {name: first_metrics(main[main["method"] == name]) for name in methods}
    if not metrics:
        return {}, {}
    best = min(metrics, key=lambda name: metrics[name][REGRET])
    return {BEST_TAG: best}, metrics[best]


def _runs_with_locations(
    scored: Sequence[ScoredSet], params: Mapping[str, Any], config: EvaluateConfig, file: Path
) -> Iterator[NestedRun]:
    """Yield the runs of `runs_of_rows`, each with its `location_table` in the same `file`."""
    for one in scored:
        for nested in runs_of_rows(one.table, params):
            tables = [location_table(one, nested.params["method"], n, config) for n in config.top_n]
            pd.concat(tables).to_parquet(file, index=False)
            yield replace(nested, files=(file,))


def location_table(scored: ScoredSet, method: str, n: int, config: EvaluateConfig) -> pd.DataFrame:
    """Return a method's choice at each location, one row each.

    Columns: scene, location_id, top_n, chosen (views), for each threshold good_* (number of good ones) and any_*
    (whether one is; both are expectations for random choice), and best_score, the score of the first choice; NaN for
    random choice and the oracle.
    """
    views = scored.candidates.views
    top = scored.choices[method, n]
    names = [scored.scenes[number].name for number in views.location_scene]
    table = pd.DataFrame({"scene": names, "location_id": scored.candidates.location_id, "top_n": n})
    table["chosen"] = top.chosen.astype(np.int64)
    for index, key in enumerate(map(threshold_key, config.thresholds)):
        table[f"good_{key}"] = top.good[:, index]
        table[f"any_{key}"] = top.any_good[:, index]
    best = np.full(views.n_locations, np.nan)
    if method in scored.scores and not is_random(method):
        np.fmax.at(best, views.location, scored.scores[method])
    return table.assign(best_score=best)


def log_evaluation(
    dataset: Dataset,
    evaluation: Evaluation,
    config: EvaluateConfig,
    tracking: TrackingConfig,
    occlusion: OcclusionConfig,
    results: Path,
) -> None:
    """Log an evaluation as a run with the files in the folder `results`, and nested runs (`runs_of_rows`).

    Settings of occlusion models are logged if the configuration names any. Nothing is logged if the newest evaluation
    of the dataset had the same parameters and results.
    """
    views = evaluation.views
    params = evaluation_params(dataset, evaluation.scenes, evaluation.weights)
    params |= {name: value for name, value in asdict(config).items() if name not in ("weights", "methods")}
    params = {name: value for name, value in params.items() if value or name not in ("anywhere", "photographs")}
    if config.occlusions:
        params |= {f"occlusion_{name}": value for name, value in asdict(occlusion).items() if name != "model"}
    if len(dataset.cameras) == 1:
        for method in methods_named(config.methods, scorers()):
            params |= method.params(dataset.camera)
    mark = fingerprint_of(params, evaluation.table.to_csv(index=False), evaluation.calibration.to_csv(index=False))
    if logged_last(tracking, "evaluate", dataset.name, mark, SCORES_CSV) is not None:
        return
    best, metrics = best_of(evaluation.table)
    metrics |= {"n_locations": views.n_locations, "n_views": len(views.good), "positives": views.good[:, 0].mean()}
    tags = {"dataset": dataset.name, FINGERPRINT_TAG: mark, **best}
    with temporary_folder() as folder, start_run(tracking, ALL_METHODS, "evaluate", params, tags=tags) as (client, run):
        log(client, run, metrics=metrics)
        for file in results.iterdir():
            if file.is_file() and file.suffix != ".partial":  # left by a killed process
                client.log_artifact(run, str(file))
        nested = _runs_with_locations(evaluation.scored, params, config, folder / LOCATIONS_PARQUET)
        log_nested(tracking, run, "evaluate", nested)


def latest_scores(tracking: TrackingConfig, dataset: str | None = None) -> pd.DataFrame | None:
    """Return the score table of the newest evaluation in a store, of one dataset or any; None if there is none."""
    run = newest_run(tracking, "evaluate", {"dataset": dataset} if dataset else None)
    if run is None:
        return None
    return read_scores(artifact(tracking, run.info.run_id, SCORES_CSV))
