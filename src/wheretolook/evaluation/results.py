"""What an evaluation leaves: files in the dataset's folder, and runs in the tracking store."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd

from wheretolook.dataset.folders import Dataset, SceneFolder
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.ranking import TestViews
from wheretolook.evaluation.scores import Choices, by_chance, read_scores
from wheretolook.evaluation.views import CandidateSet
from wheretolook.geometry.poses import Float
from wheretolook.methods.registry import methods_named, scorers
from wheretolook.utils.files import fingerprint
from wheretolook.utils.tracking import NestedRun, TrackingConfig, artifact, log, newest_run, start_run
from wheretolook.viewpoints.thresholds import ALL, threshold_key
from wheretolook.visibility.config import OcclusionConfig

SCORES_CSV, SCORES_MD, SCORES_PNG, OCCLUSION_PNG = "scores.csv", "scores.md", "scores.png", "occlusion.png"
CALIBRATION_CSV, CALIBRATION_PNG, REGRET_PNG = "calibration.csv", "calibration.png", "regret.png"
"""Files of an evaluation, in `<dataset>/results/` and as artifacts of its run."""

VARIANTS_CSV = "variants.csv"
"""In a release's `results/`: scores of the networks for all inputs, as `scores.csv`, before one was chosen to ship."""

LOCATIONS_PARQUET = "locations.parquet"
"""Artifact of each nested run: what was chosen at each location."""


@dataclass(frozen=True, eq=False)
class ScoredSet:
    """One candidate set with the scores by one occlusion model.

    Attributes:
        occlusion: name of the occlusion model.
        candidates: the views.
        scores: (B,) scores of these views, by method.
        choices: what each method chooses.
        table: the score table, with columns `occlusion` and `candidates`.
    """

    occlusion: str
    candidates: CandidateSet
    scores: Mapping[str, Float]
    choices: Choices
    table: pd.DataFrame


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What an evaluation found.

    Attributes:
        scenes: of the split.
        weights: files of methods that have learnt, and the name of the method that each serves.
        views: all labelled views.
        scored: of each occlusion model and candidate set.
        table: their score tables, one below the other, with columns `occlusion` and `candidates`.
        calibration: reliability curves of learned methods, see `calibration_rows`; empty without any.
    """

    scenes: Sequence[SceneFolder]
    weights: Mapping[Path, str]
    views: TestViews
    scored: Sequence[ScoredSet]
    table: pd.DataFrame
    calibration: pd.DataFrame


def results_folder(dataset: Dataset, config: EvaluateConfig) -> Path:
    """Where an evaluation's files go: `<dataset>/results/`, or for scenes of another split than test a folder there."""
    folder = dataset.root / "results"
    return folder if config.split == "test" else folder / config.split


def evaluation_params(dataset: Dataset, scenes: Sequence[SceneFolder], weights: Iterable[Path]) -> dict[str, Any]:
    """Parameters of an evaluation's run that tell what was evaluated.

    Args:
        dataset: evaluated.
        scenes: those of the split.
        weights: files of methods that have learnt.
    """
    return {
        "dataset": dataset.name,
        "dataset_fingerprint": Dataset(dataset.root, dataset.camera, tuple(scenes)).fingerprint(),
        "scenes": " ".join(scene.name for scene in scenes),
        "weights": " ".join(f"{path.stem}:{fingerprint(path)}" for path in weights),
    }


_NAMED = ("method", "occlusion", "candidates", "top_n")
"""What names a row of a score table, beside the scene."""

_BY_SCENE = ("good_", "n_views", "normalized_", "regret_")
"""Beginnings of the columns whose values in each scene are logged as well."""


def runs_of_rows(table: pd.DataFrame, params: Mapping[str, Any]) -> Iterator[tuple[dict[str, Any], NestedRun]]:
    """Each row over all scenes of score tables, with the run nested in the evaluation's that it is logged as.

    Args:
        table: score tables, one below the other, with columns `occlusion` and `candidates`.
        params: of the evaluation; the row's own are added.
    """
    by_row: dict[tuple[Any, ...], list[dict[Any, Any]]] = {}
    for record in table[table["scene"] != ALL].to_dict("records"):
        by_row.setdefault(tuple(record[name] for name in _NAMED), []).append(record)
    for record in table[table["scene"] == ALL].to_dict("records"):
        row = {str(key): value for key, value in record.items()}
        seen = (row["occlusion"], *([row["candidates"]] if row["candidates"] != ALL else []))
        shown = (row["method"], f"best {row['top_n']}", f"({', '.join(seen)})")
        texts = (*_NAMED, "scene", "reference")
        numbers = {key: float(value) for key, value in row.items() if key not in texts}
        for scene in by_row.get(tuple(row[name] for name in _NAMED), []):
            for key, value in scene.items():
                if str(key).startswith(_BY_SCENE):
                    numbers[f"{key}/{scene['scene']}"] = float(value)
        yield row, NestedRun(" ".join(shown), {**params, **{key: row[key] for key in _NAMED}}, numbers)


def location_table(
    scored: ScoredSet, method: str, n: int, scenes: Sequence[SceneFolder], config: EvaluateConfig
) -> pd.DataFrame:
    """What a method chooses at each location, one row each.

    Columns: scene, location_id, chosen (views), for each threshold good_* (how many of them are good) and any_*
    (whether one is; for random choice both are expectations), and best_score, that of the view chosen first; NaN for
    random choice and the oracle, which choose by no score.
    """
    views, top = scored.candidates.views, scored.choices[method, n]
    columns: dict[str, Any] = {
        "scene": [scenes[number].name for number in views.location_scene],
        "location_id": scored.candidates.location_id,
        "chosen": top.chosen.astype(np.int64),
    }
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
    """Log an evaluation: a run with the files of `results`, and in it one for each row over all scenes.

    Args:
        dataset: evaluated.
        evaluation: what it found.
        config: of the evaluation.
        tracking: where to log.
        occlusion: settings of occlusion models, logged if the configuration names any.
        results: folder of the files.
    """
    views, scenes = evaluation.views, evaluation.scenes
    params = {
        **evaluation_params(dataset, scenes, evaluation.weights),
        **{name: value for name, value in asdict(config).items() if name not in ("weights", "methods")},
        **(
            {f"occlusion_{name}": value for name, value in asdict(occlusion).items() if name != "model"}
            if config.occlusions
            else {}
        ),
    }
    for method in methods_named(config.methods, scorers()):
        params |= method.params(dataset.camera)
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
        for one in evaluation.scored:
            for row, nested in runs_of_rows(one.table, params):
                chosen = location_table(one, row["method"], row["top_n"], scenes, config)
                chosen.to_parquet(Path(folder) / LOCATIONS_PARQUET, index=False)
                with start_run(tracking, nested.name, "evaluate", nested.params, parent=run) as (_, child):
                    log(client, child, metrics=nested.metrics)
                    client.log_artifact(child, str(Path(folder) / LOCATIONS_PARQUET))


def latest_scores(tracking: TrackingConfig, dataset: str | None = None) -> pd.DataFrame | None:
    """The score table of the newest evaluation in a store, or None if there is none.

    Args:
        tracking: the store.
        dataset: name of the dataset evaluated; None for any.
    """
    run = newest_run(tracking, "evaluate", {"dataset": dataset} if dataset else None)
    if run is None:
        return None
    return read_scores(artifact(tracking, run.info.run_id, SCORES_CSV))
