"""What an evaluation leaves: files in the dataset's folder, and runs in the tracking store."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.thresholds import ALL, threshold_key
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.ranking import TestViews
from wheretolook.evaluation.score_table import main_rows, methods_of, threshold_keys
from wheretolook.evaluation.scores import Choices, by_chance, read_scores
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
from wheretolook.utils.files import atomic_write, fingerprint, temporary_folder
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

LOCATIONS_PARQUET = "locations.parquet"  # artifact of each nested run: what was chosen at each location, for each N


@dataclass(frozen=True, eq=False)
class ScoredSet:
    """One candidate set with the scores by one occlusion model."""

    occlusion: str  # name of the occlusion model
    candidates: CandidateSet  # the views
    scores: Mapping[str, Float]  # (B,) scores of these views, by method
    choices: Choices  # what each method chooses
    table: pd.DataFrame  # the score table, with columns `occlusion` and `candidates`
    scenes: Sequence[SceneFolder]  # by their numbers in the views


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What an evaluation found."""

    scenes: Sequence[SceneFolder]  # of the split
    weights: Mapping[Path, str]  # files of methods that have learnt, and the name of the method that each serves
    views: TestViews  # all labelled views
    scored: Sequence[ScoredSet]  # of each occlusion model and candidate set
    table: pd.DataFrame  # their score tables, one below the other, with columns `occlusion` and `candidates`
    calibration: pd.DataFrame  # reliability curves of learned methods, see `calibration_rows`; empty without any


def results_folder(dataset: Dataset, config: EvaluateConfig) -> Path:
    """Where an evaluation's files go: `<dataset>/results/`, or for scenes of another split than test a folder there."""
    folder = dataset.root / "results"
    return folder if config.split == "test" else folder / config.split


def evaluation_params(dataset: Dataset, scenes: Sequence[SceneFolder], weights: Iterable[Path]) -> dict[str, Any]:
    """Parameters of an evaluation's run that tell what was evaluated: a dataset's scenes, and files of weights."""
    return {
        "dataset": dataset.name,
        "dataset_fingerprint": Dataset(dataset.root, tuple(scenes)).fingerprint(),
        "scenes": " ".join(scene.name for scene in scenes),
        "weights": " ".join(f"{path.stem}:{fingerprint(path)}" for path in weights),
    }


_NAMED = ("method", "occlusion", "candidates")  # what names a nested run

_OF_ALL_VIEWS = ("n_locations", "average_precision", "roc_auc", "ece", "ece_scaled", "temperature")
"""Columns of a score table that do not depend on N."""

_OF_CHOSEN = re.compile("(raw|any|normalized|regret)_(?!low_|high_)")
"""Beginning of the columns that are logged for each N and threshold. `scores.csv`, an artifact, has all others; each
metric costs MLflow 0.3 ms and is another column to look past."""

_AT_FIRST = ("regret_low", "regret_high", "difference", "difference_low", "difference_high", "p")
"""Columns that are logged for each N at the first threshold alone, the strictest."""


def runs_of_rows(table: pd.DataFrame, params: Mapping[str, Any]) -> Iterator[NestedRun]:
    """The runs that log joined score tables: one for each method, occlusion model and candidate set.

    Their parameters are those given and the row's own. Metrics are those of `first_metrics`, and others named by N, the
    scene unless it is all of them, and the column, such as `top-5/any_5m_10deg` and
    `top-1/apartment-210/regret_0.05m_0.4deg`, or by the column if N does not matter.
    """
    strictest = threshold_keys(table)[0]
    at_first = {f"{name}_{strictest}" for name in _AT_FIRST}
    of_pooled = [name for name in map(str, table.columns) if _OF_CHOSEN.match(name) or name in at_first]
    of_all_views = [name for name in _OF_ALL_VIEWS if name in table]
    of_scene = [f"regret_{strictest}"] if f"regret_{strictest}" in table else []
    for key, rows in table.groupby(list(_NAMED), sort=False):
        own = dict(zip(_NAMED, map(str, key), strict=True))
        pooled = rows[rows["scene"] == ALL]
        numbers = first_metrics(pooled) | {name: float(pooled[name].iloc[0]) for name in of_all_views}
        for part, columns in ((pooled, of_pooled), (rows[rows["scene"] != ALL], of_scene)):
            values = part[columns].to_numpy(np.float64)
            for n, scene, row in zip(part["top_n"], part["scene"], values, strict=True):
                place = f"top-{n}" if scene == ALL else f"top-{n}/{scene}"
                numbers |= {f"{place}/{name}": float(x) for name, x in zip(columns, row, strict=True)}
        candidates = own["candidates"] if own["candidates"] != ALL else ""
        yield NestedRun(joined(own["method"], own["occlusion"], candidates), {**params, **own}, numbers)


def first_metrics(rows: pd.DataFrame) -> dict[str, float]:
    """Metrics to sort runs by, of one method's rows: the first view chosen over all scenes, at the first threshold."""
    strictest = threshold_keys(rows)[0]
    columns = {REGRET: f"regret_{strictest}", SHARE: f"raw_{strictest}", AUC: "roc_auc"}
    first = rows[(rows["scene"] == ALL) & (rows["top_n"] == rows["top_n"].min())]
    return {name: float(first[column].iloc[0]) for name, column in columns.items() if column in first}


def best_of(table: pd.DataFrame) -> tuple[dict[str, str], dict[str, float]]:
    """The method with the least regret under a table's first conditions, as a tag, and its `first_metrics`.

    Random choice and the oracle do not count, since they need no scores; both are empty if there is no other.
    """
    main = main_rows(table)
    found = {name: first_metrics(main[main["method"] == name]) for name in methods_of(main)}
    found = {name: metrics for name, metrics in found.items() if name != ORACLE and not by_chance(name)}
    if not found:
        return {}, {}
    best = min(found, key=lambda name: found[name].get(REGRET, -found[name][SHARE]))
    return {BEST_TAG: best}, found[best]


def _runs_with_locations(
    scored: Sequence[ScoredSet], params: Mapping[str, Any], config: EvaluateConfig, file: Path
) -> Iterator[NestedRun]:
    """The runs of `runs_of_rows`, each with a `file` that holds what was chosen until the next is asked for."""
    for one in scored:
        for nested in runs_of_rows(one.table, params):
            chosen = [location_table(one, nested.params["method"], n, one.scenes, config) for n in config.top_n]
            with atomic_write(file) as partial:
                pd.concat(chosen).to_parquet(partial, index=False)
            yield replace(nested, files=(file,))


def location_table(
    scored: ScoredSet, method: str, n: int, scenes: Sequence[SceneFolder], config: EvaluateConfig
) -> pd.DataFrame:
    """What a method chooses at each location, one row each.

    Columns: scene, location_id, top_n, chosen (views), for each threshold good_* (how many of them are good) and any_*
    (whether one is; for random choice both are expectations), and best_score, that of the view chosen first; NaN for
    random choice and the oracle, which choose by no score.
    """
    views = scored.candidates.views
    top = scored.choices[method, n]
    names = [scenes[number].name for number in views.location_scene]
    columns: dict[str, Any] = {"scene": names, "location_id": scored.candidates.location_id, "top_n": n}
    columns |= {"chosen": top.chosen.astype(np.int64)}
    for index, key in enumerate(map(threshold_key, config.thresholds)):
        columns |= {f"good_{key}": top.good[:, index], f"any_{key}": top.any_good[:, index]}
    best = np.full(views.n_locations, np.nan)
    if method in scored.scores and not by_chance(method):
        np.fmax.at(best, views.location, scored.scores[method])
    return pd.DataFrame({**columns, "best_score": best})


def log_evaluation(
    dataset: Dataset,
    evaluation: Evaluation,
    config: EvaluateConfig,
    tracking: TrackingConfig,
    occlusion: OcclusionConfig,
    results: Path,
) -> None:
    """Log an evaluation: a run with the files in the folder `results`, and nested in it those of `runs_of_rows`.

    The settings of occlusion models are logged if the configuration names any. Nothing is logged if the newest
    evaluation of the dataset was of the same and found the same.
    """
    views = evaluation.views
    scenes = evaluation.scenes
    params = evaluation_params(dataset, scenes, evaluation.weights)
    params |= {name: value for name, value in asdict(config).items() if name not in ("weights", "methods", "anywhere")}
    params |= {"anywhere": True} if config.anywhere else {}
    if not config.photographs:
        del params["photographs"]  # as before there were any
    if config.occlusions:
        params |= {f"occlusion_{name}": value for name, value in asdict(occlusion).items() if name != "model"}
    for method in methods_named(config.methods, scorers()) if len(dataset.cameras) == 1 else []:
        params |= method.params(dataset.camera)
    positives = float(views.good[:, 0].mean())
    mark = fingerprint_of(params, evaluation.table.to_csv(index=False), evaluation.calibration.to_csv(index=False))
    if logged_last(tracking, "evaluate", dataset.name, mark, SCORES_CSV) is not None:
        return
    best, metrics = best_of(evaluation.table)
    metrics |= {"n_locations": views.n_locations, "n_views": len(views.good), "positives": positives}
    tags = {"dataset": dataset.name, FINGERPRINT_TAG: mark, **best}
    opened = start_run(tracking, ALL_METHODS, "evaluate", params, tags=tags)
    with temporary_folder() as folder, opened as (client, run):
        log(client, run, metrics=metrics)
        for file in results.iterdir():
            if file.is_file() and file.suffix != ".partial":  # a killed process may have left one
                client.log_artifact(run, str(file))
        file = folder / LOCATIONS_PARQUET
        log_nested(tracking, run, "evaluate", _runs_with_locations(evaluation.scored, params, config, file))


def latest_scores(tracking: TrackingConfig, dataset: str | None = None) -> pd.DataFrame | None:
    """The score table of the newest evaluation in a store, of one dataset or any, or None if there is none."""
    run = newest_run(tracking, "evaluate", {"dataset": dataset} if dataset else None)
    if run is None:
        return None
    return read_scores(artifact(tracking, run.info.run_id, SCORES_CSV))
