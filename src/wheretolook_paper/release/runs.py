"""Log the contents of a release as MLflow runs, so that notebooks, figures and MLflow's UI work on a fresh clone.

A release ships tables of evaluations and studies and records of training, but no MLflow store. They are logged like the
stages log them, once: a run with the same file as an artifact is reused.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from wheretolook.dataset.config import ALL
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_table import UNLABELLED, is_good
from wheretolook.evaluation.config import SCORES_CSV
from wheretolook.evaluation.results import best_of, evaluation_params, read_scores, runs_of_rows
from wheretolook.figures.floor_plan import save_figure
from wheretolook.scorers.registry import learned
from wheretolook.tracking import (
    ALL_METHODS,
    AUC,
    BEST_TAG,
    REGRET,
    NestedRun,
    Tags,
    TrackingConfig,
    artifact,
    client as client_of,
    experiment_ids,
    finished_runs,
    joined,
    log,
    log_history,
    start_run,
)
from wheretolook.training.provenance import HISTORY_CSV, kept_metrics, params_of
from wheretolook.utils.files import copy_file, temporary_folder, write_text
from wheretolook.utils.processes import hold
from wheretolook_paper.evaluation.comparison import log_comparison
from wheretolook_paper.evaluation.extend import EXTEND_CSV, log_extend
from wheretolook_paper.evaluation.looks import LOOKS_CSV, log_looks
from wheretolook_paper.figures.runtimes import runtime_figure, scaling_figure
from wheretolook_paper.paths.path_report import PATHS_CSV, log_paths
from wheretolook_paper.release.card import GENERALIZATION_CSV
from wheretolook_paper.release.training_histories import TRAINING_CSV, read_histories, records, train_runs

RUNTIMES_CSV = "runtimes.csv"
SCALING_CSV = "scaling.csv"
"""Tables of `figures.runtimes`: times at the paper's size, and growth of time and memory."""

LEARNERS_CSV = "learners.csv"
"""In a release's `results/`: metrics of all learners by seed on validation, test and other scenes."""

_WAIT_S = 600.0  # for another process that logs a release
TAGS = {"logged_from": "release"}  # of runs logged from files

Say = Callable[[str], None]
Values = dict[str, Any]


@dataclass
class ReleaseRuns:
    """A release's runs in a store.

    `ids` are by name: the stage, for an evaluation on another dataset followed by its name, for training by the method,
    as in "evaluate", "evaluate interiors", "train set", "paths". `new` is how many were logged now.
    """

    ids: dict[str, str] = field(default_factory=dict)
    new: int = 0


def log_release(dataset: Dataset, tracking: TrackingConfig, say: Say = lambda text: None) -> ReleaseRuns:
    """Log the runs of a release that the store lacks; return all of them, existing ones included.

    The store is created if missing. Unfinished runs of a killed call are deleted first; simultaneous calls wait for
    each other.
    """
    with hold(tracking.root / ".release.lock", "log-release", wait_s=_WAIT_S):
        _delete_incomplete_runs(tracking)
        return _log_missing(dataset, tracking, say)


def _delete_incomplete_runs(tracking: TrackingConfig) -> None:
    """Delete the unfinished runs of a release and the runs nested in them."""
    mlflow = client_of(tracking)
    ids = experiment_ids(mlflow, tracking)

    def matching(condition: str) -> list[str]:
        runs = mlflow.search_runs(ids, condition, max_results=10_000) if ids else ()
        return [str(run.info.run_id) for run in runs]

    tagged = " and ".join(f"tags.{name} = '{value}'" for name, value in TAGS.items())
    for incomplete in matching(f"{tagged} and attributes.status != 'FINISHED'"):
        for run_id in (*matching(f"tags.`mlflow.parentRunId` = '{incomplete}'"), incomplete):
            mlflow.delete_run(run_id)


def _log_missing(dataset: Dataset, tracking: TrackingConfig, say: Say) -> ReleaseRuns:
    runs = ReleaseRuns()
    results = dataset.root / "results"

    def add(name: str, found: str | None, log_it: Callable[[TrackingConfig], str]) -> None:
        if found is None:
            say(f"logging {name}")
            runs.new += 1
            found = log_it(tracking)
        runs.ids[name] = found

    for stage, (file, log_file) in _LOGGED.items():
        if (results / file).is_file():
            found = _run_with_file(tracking, stage, file, (results / file).read_bytes())
            add(stage, found, partial(log_file, dataset))
    others = results / GENERALIZATION_CSV
    for name, rows in read_scores(others).groupby("dataset", sort=False) if others.is_file() else ():
        table = rows.drop(columns=["dataset", "weights_sha256"]).reset_index(drop=True)
        found = _run_with_file(tracking, "evaluate", SCORES_CSV, table.to_csv(index=False).encode())
        add(f"evaluate {name}", found, partial(_log_others, dataset, str(name), table))
    histories = dict(iter(read_histories(results / TRAINING_CSV).groupby("method")))
    for path, record in records(dataset.root / "weights").items():
        method = record["about"]["method"]
        history = histories.get(method)
        found = _train_run(tracking, path, record, history is not None)
        add(f"train {method}", found, partial(_log_training, dataset, path, record, history))
    return runs


def _run_with_file(tracking: TrackingConfig, stage: str, name: str, content: bytes) -> str | None:
    """Return the id of the newest run of a stage that has this file as an artifact."""
    for run in finished_runs(tracking, stage, file=name):
        if artifact(tracking, run.info.run_id, name).read_bytes() == content:
            return str(run.info.run_id)
    return None


def _train_run(tracking: TrackingConfig, path: Path, record: Values, with_history: bool) -> str | None:
    """Return the id of the run that trained these weights, or that was logged from their record."""
    for _, run in train_runs(tracking, method=record["about"]["method"], file=HISTORY_CSV if with_history else ""):
        logged = artifact(tracking, run.info.run_id, path.name)
        if run.info.run_id == record["run_id"] or (logged.is_file() and logged.read_bytes() == path.read_bytes()):
            return str(run.info.run_id)
    return None


def _log_scores(dataset: Dataset, tracking: TrackingConfig) -> str:
    """Log the evaluation on the release's test scenes like the evaluate stage, without tables of locations."""
    results = dataset.root / "results"
    scenes = dataset.split("test")
    named = (dataset.root / "weights" / f"{name}.safetensors" for name in learned())
    params = evaluation_params(dataset, scenes, [path for path in named if path.is_file()])
    views = pd.concat([scene.read_table() for scene in scenes])
    views = views[views["status"] != UNLABELLED]
    metrics = {"n_views": float(len(views)), "positives": float(is_good(views).mean())}
    files = [path for path in results.iterdir() if path.is_file() and path.suffix != ".png"]
    return _log_evaluation(read_scores(results / SCORES_CSV), params, metrics, files, tracking)


def _log_others(dataset: Dataset, name: str, table: pd.DataFrame, tracking: TrackingConfig) -> str:
    """Log an evaluation on another dataset, which does not ship."""
    scenes = " ".join(scene for scene in table["scene"].unique() if scene != ALL)
    params = {"dataset": name, "scenes": scenes, "weights": f"of {dataset.name}"}
    with temporary_folder() as folder:
        path = folder / SCORES_CSV
        path.write_bytes(table.to_csv(index=False).encode())
        return _log_evaluation(table, params, {}, [path], tracking)


def _log_evaluation(
    table: pd.DataFrame, params: Values, metrics: Values, files: list[Path], tracking: TrackingConfig
) -> str:
    """Log a table of scores with the options that it shows, and a nested run for each of its methods."""
    choices = {name: tuple(table[name].unique().tolist()) for name in ("top_n", "occlusion", "candidates")}
    params = {**params, **choices, "reference": table["reference"].iloc[0]}
    best, first = best_of(table)
    metrics |= {**first, "n_locations": float(table.loc[table["scene"] == ALL, "n_locations"].iloc[0])}
    about = {"dataset": params["dataset"], **best}
    nested = runs_of_rows(table, params)
    return log_comparison(tracking, ALL_METHODS, "evaluate", params, metrics, nested, files, TAGS, about)


def _log_training(
    dataset: Dataset, path: Path, record: dict[str, Any], history: pd.DataFrame | None, tracking: TrackingConfig
) -> str:
    """Log a train run under the release's name, whatever dataset the weights were trained on."""
    about = {**record["about"], "dataset": dataset.name}
    params = params_of(about)
    if record["about"]["dataset"] != dataset.name:
        params["trained_on"] = record["about"]["dataset"]
    tags = {**TAGS, "trained_as": str(record["run_id"])}
    with start_run(tracking, about["method"], "train", params, tags=tags) as (mlflow, run):
        log(mlflow, run, metrics=kept_metrics(record["metrics"]))
        mlflow.log_artifact(run, str(path))
        if history is not None:
            history = history.drop(columns="method").dropna(axis=1, how="all")
            log_history(mlflow, run, history)
            write_text(artifact(tracking, run, HISTORY_CSV), history.to_csv(index=False))
    return run


def _log_learners(dataset: Dataset, tracking: TrackingConfig) -> str:
    """Log the comparison of learners with a nested run for each learner, training data and seed.

    The run itself has the mean metrics over seeds of the learner with the smallest regret.
    """
    path = dataset.root / "results" / LEARNERS_CSV
    table = pd.read_csv(path, dtype=str, keep_default_na=False)
    measures = ["average_precision", "roc_auc", "ece", "regret"]
    table[measures] = table[measures].apply(pd.to_numeric)
    nested = []
    of_learner: dict[str, list[tuple[float, float]]] = {}
    for key, rows in table.groupby(["learner", "trained_on", "seed"], sort=False):
        learner, source, seed = map(str, key)
        numbers: dict[str, float] = {}
        for split, means in rows.groupby("split")[measures].mean().iterrows():
            numbers |= {f"{measure}_{split}": mean for measure, mean in means.items()}
        for measure in ("average_precision", "regret"):
            numbers |= {f"{measure}/{scene}": x for scene, x in zip(rows["scene"], rows[measure], strict=True)}
        if "regret_test" in numbers:
            numbers |= {REGRET: numbers["regret_test"], AUC: numbers["roc_auc_test"]}
            of_learner.setdefault(joined(learner, source), []).append((numbers[REGRET], numbers[AUC]))
        params = {"dataset": dataset.name, "learner": learner, "trained_on": source, "seed": seed}
        nested.append(NestedRun(joined(learner, source, f"seed {seed}" if seed else ""), params, numbers))
    best = {}
    metrics = {}
    if of_learner:
        means_of = {name: np.mean(numbers, axis=0) for name, numbers in of_learner.items()}
        best[BEST_TAG] = min(means_of, key=lambda name: means_of[name][0])
        metrics = dict(zip((REGRET, AUC), map(float, means_of[best[BEST_TAG]]), strict=True))
    params = {"dataset": dataset.name}
    return log_comparison(tracking, "all learners", "learners", params, metrics, nested, [path], TAGS, best)


def _log_paths(dataset: Dataset, tracking: TrackingConfig) -> str:
    results = dataset.root / "results"
    return log_paths({"dataset": dataset.name}, pd.read_csv(results / PATHS_CSV), results, tracking, TAGS)


def _log_looks(dataset: Dataset, tracking: TrackingConfig) -> str:
    """Log the comparison of view sets on the test scenes."""
    file = dataset.root / "results" / LOOKS_CSV
    table = pd.read_csv(file)
    params = {"dataset": dataset.name, "split": "test"}
    return log_looks(tracking, table[table["split"] == "test"], params, [file], TAGS)


def _log_extend(dataset: Dataset, tracking: TrackingConfig) -> str:
    return log_extend(tracking, dataset.name, dataset.root / "results", TAGS)


def _log_benchmark(dataset: Dataset, tracking: TrackingConfig) -> str:
    return log_runtimes(tracking, dataset.root / "results", TAGS)


_LOGGED: dict[str, tuple[str, Callable[..., str]]] = {
    "evaluate": (SCORES_CSV, _log_scores),
    "learners": (LEARNERS_CSV, _log_learners),
    "paths": (PATHS_CSV, _log_paths),
    "looks": (LOOKS_CSV, _log_looks),
    "extend": (EXTEND_CSV, _log_extend),
    "benchmark": (RUNTIMES_CSV, _log_benchmark),
}
"""File in `results/` of each stage, and the function that logs it."""


def log_runtimes(tracking: TrackingConfig, results: Path, tags: Tags = None) -> str:
    """Log the measured times in a folder as a run of the stage "benchmark" with their figures; return its id.

    `RUNTIMES_CSV` is the table of `runtime_figure`, `SCALING_CSV`, which may be missing, that of `scaling_figure`.
    """
    sizes = pd.read_csv(results / RUNTIMES_CSV)
    scaling = results / SCALING_CSV
    metrics = {}
    for row in sizes.dropna(subset="median_s").to_dict("records"):
        name = f"{row['what']} {row['device'].split(':')[0]} {row['threads']} threads s"
        metrics["".join(letter for letter in name if letter.isalnum() or letter == " ")] = float(row["median_s"])
    machines = " + ".join(dict.fromkeys(map(str, sizes["name"])))
    with (
        temporary_folder() as folder,
        start_run(tracking, "visibility check", "benchmark", {"machines": machines}, tags=tags) as (client, run),
    ):
        log(client, run, metrics=metrics)
        copy_file(results / RUNTIMES_CSV, folder / RUNTIMES_CSV)
        save_figure(runtime_figure(sizes), folder / "runtimes.png")
        if scaling.is_file():
            copy_file(scaling, folder / SCALING_CSV)
            save_figure(scaling_figure(pd.read_csv(scaling)), folder / "visibility-scaling.png")
        client.log_artifacts(run, str(folder))
    return run
