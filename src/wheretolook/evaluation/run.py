"""The evaluate stage: score the viewpoints of the test scenes with every method, tabulate, draw and log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.dataset import Dataset, SceneFolder, write_text
from wheretolook.errors import TableError, WeightsError
from wheretolook.evaluation.calibration import calibration_rows, fit_temperature
from wheretolook.evaluation.config import EvaluateConfig, candidates_label, threshold_key
from wheretolook.evaluation.paper_tables import write_paper_tables
from wheretolook.evaluation.ranking import TestViews
from wheretolook.evaluation.report import main_rows, score_markdown
from wheretolook.evaluation.scores import (
    ALL,
    WITH_WEIGHTS,
    Choices,
    Method,
    choose,
    read_scores,
    reference_method,
    score_table,
)
from wheretolook.fisher.soft_visibility import GaussianProcessVisibility, cone_half_angle
from wheretolook.geometry import Float, camera_centers
from wheretolook.learning.config import VARIANTS, weights_name
from wheretolook.learning.weights import weights_kind
from wheretolook.localization_map import LocalizationMap
from wheretolook.scene_occlusion import scene_occlusion
from wheretolook.scoring import Scorer, make_scorer
from wheretolook.table import UNLABELLED, fingerprint, is_good, poses
from wheretolook.tracking import TrackingConfig, log, start_run
from wheretolook.visibility.config import OcclusionConfig

if TYPE_CHECKING:
    from wheretolook.learning.training import TrainedModel

BLOCK = 4096
"""Views binned and scored at a time."""

SCORES_CSV, SCORES_MD, SCORES_PNG, OCCLUSION_PNG = "scores.csv", "scores.md", "scores.png", "occlusion.png"
CALIBRATION_CSV, CALIBRATION_PNG, REGRET_PNG = "calibration.csv", "calibration.png", "regret.png"
"""Files of an evaluation, in `<dataset>/results/` and as artifacts of its run."""

VARIANTS_CSV = "variants.csv"
"""In a release's `results/`: scores of the networks for all inputs, as `scores.csv`, before one was chosen to ship."""

LOCATIONS_PARQUET = "locations.parquet"
"""Artifact of each nested run: what was chosen at each location."""


@dataclass(frozen=True, eq=False)
class CandidateSet:
    """Views to choose from.

    Attributes:
        name: as in the column `candidates`: "all", or such as "best 100".
        mask: (B,) which of all labelled views they are.
        views: the views.
        location_id: (L,) of their locations, unique within a scene.
    """

    name: str
    mask: NDArray[np.bool_]
    views: TestViews
    location_id: NDArray[np.int64]


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
    scores: Mapping[Method, Float]
    choices: Choices
    table: pd.DataFrame


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
    weights = _weights(dataset, config, models)
    if config.split == "test":
        _check_unseen(scenes, weights)
    tables = [scene.read_table() for scene in scenes]
    views, location_id = _test_views(scenes, tables, config)
    candidate_sets = _candidate_sets(views, location_id, scenes, tables, config)
    occlusions = [None if name is None else replace(occlusion, model=name) for name in config.occlusions or (None,)]
    temperatures, n_val = _fit_temperatures(dataset, config, weights, device, progress, occlusions[0])
    scored: list[ScoredSet] = []
    calibration = pd.DataFrame()
    for model in occlusions:
        scores, used = _score_scenes(dataset, scenes, tables, config, weights, device, progress, model)
        if not scored:
            calibration = _calibration(scores, views.good[:, 0], temperatures, n_val)
        for candidates in candidate_sets:
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
    _write_results(folder, table, calibration, title)
    _log(dataset, scenes, config, tracking, weights, views, scored, occlusion, folder)
    if progress:
        print(score_markdown(table, title))
    return table


def results_folder(dataset: Dataset, config: EvaluateConfig) -> Path:
    """Where an evaluation's files go: `<dataset>/results/`, or for scenes of another split than test a folder there."""
    folder = dataset.root / "results"
    return folder if config.split == "test" else folder / config.split


def _weights(dataset: Dataset, config: EvaluateConfig, models: Sequence[TrainedModel | Path] | None) -> list[Path]:
    if not {*WITH_WEIGHTS} & {*config.methods}:
        return []
    if models is not None:
        weights = [model if isinstance(model, Path) else model.path for model in models]
    else:
        weights = list(config.weights) or _own_weights(dataset)
    if not weights:
        raise WeightsError(
            "there are no weights to evaluate", path=dataset.root / "weights",
            fix="Run the train stage first, name weights, or leave mlp out of the methods.",
        )  # fmt: skip
    kinds = {path: weights_kind(path) for path in weights}
    for kind in WITH_WEIGHTS:
        # who asks for all methods gets those that have been trained
        if kind in config.methods and kind not in kinds.values() and config.methods != EvaluateConfig().methods:
            raise WeightsError(
                f"there are no weights of {kind} to evaluate", path=dataset.root / "weights",
                fix=f"Run the train stage first, name weights, or leave {kind} out of the methods.",
            )  # fmt: skip
    return [path for path in weights if kinds[path] in config.methods]


def _own_weights(dataset: Dataset) -> list[Path]:
    """The weights in the dataset's folder, which must be trained on what the dataset now holds."""
    from wheretolook.learning.training import training_fingerprint
    from wheretolook.learning.weights import read_training

    named = (dataset.root / "weights" / weights_name(variant) for variant in VARIANTS)
    weights = [path for path in named if path.is_file()]
    now = training_fingerprint(dataset)
    for path in weights:
        if read_training(path).get("dataset_fingerprint") != now:
            raise WeightsError(
                "these weights were trained on other data than the dataset now holds", path=path,
                fix="Run the train stage again, remove the file, or name weights in evaluate.weights.",
            )  # fmt: skip
    return weights


def _check_unseen(scenes: Sequence[SceneFolder], weights: Sequence[Path]) -> None:
    """Weights must not be tested on a scene they have learnt from."""
    from wheretolook.learning.weights import read_training

    landmarks = {fingerprint(scene.landmarks): scene.name for scene in scenes if scene.landmarks.is_file()}
    for path in weights:
        for seen in read_training(path).get("landmarks", {}).values():
            if seen in landmarks:
                raise WeightsError(
                    "these weights have learnt from a scene of the test split", path=path, value=landmarks[seen],
                    fix="Train again without that scene, or evaluate on others.",
                )  # fmt: skip


def _test_views(
    scenes: Sequence[SceneFolder], tables: Sequence[pd.DataFrame], config: EvaluateConfig
) -> tuple[TestViews, NDArray[np.int64]]:
    """All labelled views, in the order of the tables, and the location_id (L,) of each of their locations."""
    location: list[NDArray[np.int64]] = []
    location_scene: list[NDArray[np.int64]] = []
    location_id: list[NDArray[np.int64]] = []
    location_block: list[NDArray[np.int64]] = []
    good: list[NDArray[np.bool_]] = []
    for number, (scene, table) in enumerate(zip(scenes, tables, strict=True)):
        if table.empty:
            raise TableError("the table has no viewpoints", path=scene.table, fix="Run the sample stage again.")
        try:
            good.append(np.stack([is_good(table, *limits) for limits in config.thresholds], axis=-1))
        except TableError as error:
            raise TableError(error.problem, path=scene.table, value=error.value, fix=error.fix) from None
        ids, first, rows = np.unique(table["location_id"].to_numpy(np.int64), return_index=True, return_inverse=True)
        if config.block_m:
            floor = camera_centers(poses(table)[first])[:, :2]
            squares = np.floor((floor - floor.min(0)) / config.block_m)
            location_block.append(np.unique(squares, axis=0, return_inverse=True)[1].reshape(-1))
        else:
            location_block.append(np.arange(len(ids)))
        location.append(rows + sum(map(len, location_id)))
        location_id.append(ids)
        location_scene.append(np.full(len(ids), number))
    viewpoint_id = np.concatenate([table["viewpoint_id"].to_numpy(np.int64) for table in tables])
    views = TestViews(
        np.concatenate(location), viewpoint_id, np.concatenate(good), np.concatenate(location_scene),
        np.concatenate(location_block),
    )  # fmt: skip
    return views, np.concatenate(location_id)


def _candidate_sets(
    views: TestViews,
    location_id: NDArray[np.int64],
    scenes: Sequence[SceneFolder],
    tables: Sequence[pd.DataFrame],
    config: EvaluateConfig,
) -> list[CandidateSet]:
    rank = np.concatenate([table["visibility_rank"].to_numpy(np.int64) for table in tables])
    found = []
    for best in config.candidates:
        mask = rank < best if best else np.ones(len(rank), dtype=bool)
        labels = views.good[mask, 0]
        if len(np.unique(labels)) < 2:
            metres, degrees = config.thresholds[0]
            which = f" among the {candidates_label(best)} candidates of each location" if best else ""
            raise TableError(
                f"labels of one class only{which}: of {len(labels)} viewpoints all or none are within {metres:g} m and "
                f"{degrees:g} degrees", path=scenes[0].table, value=bool(labels.any()),
                fix="Label more viewpoints, or give other evaluate.thresholds or evaluate.candidates.",
            )  # fmt: skip
        kept = np.unique(views.location[mask])
        found.append(CandidateSet(candidates_label(best), mask, views.only(mask), location_id[kept]))
    return found


def _fit_temperatures(
    dataset: Dataset,
    config: EvaluateConfig,
    weights: Sequence[Path],
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
    kinds = tuple(dict.fromkeys(map(weights_kind, weights)))
    learned = replace(config, methods=kinds, reference="")
    scores, _ = _score_scenes(dataset, scenes, tables, learned, weights, device, progress, occlusion)
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
        if name in WITH_WEIGHTS:
            temperature = temperatures.get((name, inputs), float("nan"))
            about = {"method": name, "inputs": inputs, "temperature": temperature, "n_val": n_val}
            curves = calibration_rows(values, good, temperature)
            parts.append(pd.DataFrame({**about, **{str(column): curves[column] for column in curves}}))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()


def _score_scenes(
    dataset: Dataset,
    scenes: Sequence[SceneFolder],
    tables: Sequence[pd.DataFrame],
    config: EvaluateConfig,
    weights: Sequence[Path],
    device: str,
    progress: bool,
    occlusion: OcclusionConfig | None,
) -> tuple[dict[Method, Float], str]:
    """Scores (B,) of every method over all scenes, and the occlusion model's name. Views are binned once for all.

    Without an occlusion model the one that is stored with the sampled locations serves.
    """
    scores: dict[Method, list[Float]] = {}
    used: set[str] = set()
    text = f"score {scenes[0].split} views" + ("" if occlusion is None else f", {occlusion.model}")
    with tqdm(total=sum(map(len, tables)), desc=text, unit="view", disable=not progress) as bar:
        for scene, table in zip(scenes, tables, strict=True):
            localization_map = scene.localization_map(dataset.camera, device)
            # a release has no mesh, but what each location sees by it
            if occlusion is not None and (scene.mesh.is_file() or occlusion.model != localization_map.occlusion.name):
                model = scene_occlusion(scene, dataset.camera, occlusion, device, progress=progress)
                localization_map = replace(localization_map, occlusion=model)
            used.add(localization_map.occlusion.name)
            scorers = _scorers(localization_map, config, weights)
            reference_method(scorers, config.reference)  # an unknown one is told before the work
            cam_from_world = poses(table)
            for begin in range(0, len(table), BLOCK):
                block = cam_from_world[begin : begin + BLOCK]
                binned = localization_map.bin_views(block)
                for method, scorer in scorers.items():
                    values = scorer.score_binned(block, binned)
                    if not np.isfinite(values).all():
                        raise TableError(
                            "a method gives scores that are not finite", path=scene.folder, value=" ".join(method),
                            fix="Check the scene's landmarks and poses, and the weights; or leave the method out.",
                        )  # fmt: skip
                    scores.setdefault(method, []).append(values)
                bar.update(len(block))
    return {method: np.concatenate(parts) for method, parts in scores.items()}, " ".join(sorted(used))


def _scorers(
    localization_map: LocalizationMap, config: EvaluateConfig, weights: Sequence[Path]
) -> dict[Method, Scorer]:
    scorers: dict[Method, Scorer] = {}
    for name in config.methods:
        of_kind = [path for path in weights if weights_kind(path) == name]
        for path in of_kind if name in WITH_WEIGHTS else [None]:
            scorer = make_scorer(name, localization_map, config.seed, path, config.heading)
            key = (scorer.name, scorer.inputs)
            if key in scorers:  # two files of one variant: told apart by their names
                key = (scorer.name, f"{scorer.inputs} {path}")
            scorers[key] = scorer
    return scorers


def _write_results(folder: Path, table: pd.DataFrame, calibration: pd.DataFrame, title: str) -> None:
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


def _log(
    dataset: Dataset,
    scenes: Sequence[SceneFolder],
    config: EvaluateConfig,
    tracking: TrackingConfig,
    weights: Sequence[Path],
    views: TestViews,
    scored: Sequence[ScoredSet],
    occlusion: OcclusionConfig,
    results: Path,
) -> None:
    params: dict[str, Any] = {
        "dataset": dataset.name,
        "dataset_fingerprint": Dataset(dataset.root, dataset.camera, tuple(scenes)).fingerprint(),
        "scenes": " ".join(scene.name for scene in scenes),
        **{name: value for name, value in asdict(config).items() if name not in ("weights", "methods")},
        **(
            {f"occlusion_{name}": value for name, value in asdict(occlusion).items() if name != "model"}
            if config.occlusions
            else {}
        ),
        "weights": " ".join(f"{path.stem}:{fingerprint(path)}" for path in weights),
    }
    if any(name.startswith("fisher") and "gp" in name for name in config.methods):
        process = GaussianProcessVisibility.fitted(cone_half_angle(dataset.camera))
        params |= {"gp_factors": process.n_factors, "gp_length": round(process.length, 4)}
        params["gp_held_out_rmse"] = round(process.held_out_error(), 4)
    positives = float(views.good[:, 0].mean())
    metrics = {"n_locations": views.n_locations, "n_views": len(views.good), "positives": positives}
    tags = {"dataset": dataset.name}
    with (
        TemporaryDirectory() as folder,
        start_run(tracking, f"evaluate {dataset.name}", "evaluate", params, tags=tags) as (client, run),
    ):
        log(client, run, metrics=metrics)
        for file in results.iterdir():
            if file.is_file():
                client.log_artifact(run, str(file))
        for one in scored:
            by_scene = one.table[one.table["scene"] != ALL]
            for row in one.table[one.table["scene"] == ALL].to_dict("records"):
                named = ("method", "inputs", "occlusion", "candidates", "top_n")
                seen = (row["occlusion"], *([row["candidates"]] if row["candidates"] != ALL else []))
                shown = (row["method"], row["inputs"], f"best {row['top_n']}", f"({', '.join(seen)})")
                name = " ".join(part for part in shown if part)
                child_params = {**params, **{key: row[key] for key in named}}
                texts = (*named, "scene", "reference")
                numbers = {str(key): float(value) for key, value in row.items() if key not in texts}
                same = by_scene[["method", "inputs", "top_n"]] == [row[key] for key in ("method", "inputs", "top_n")]
                for scene in by_scene[same.all(axis=1)].to_dict("records"):
                    for key, value in scene.items():
                        if str(key).startswith(("good_", "n_views", "normalized_", "regret_")):
                            numbers[f"{key}/{scene['scene']}"] = float(value)
                chosen = _location_table(one, (row["method"], row["inputs"]), row["top_n"], scenes, config)
                chosen.to_parquet(Path(folder) / LOCATIONS_PARQUET, index=False)
                with start_run(tracking, name, "evaluate", child_params, parent=run) as (_, child):
                    log(client, child, metrics=numbers)
                    client.log_artifact(child, str(Path(folder) / LOCATIONS_PARQUET))


def _location_table(
    scored: ScoredSet, method: Method, n: int, scenes: Sequence[SceneFolder], config: EvaluateConfig
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
    if method in scored.scores and method[0] != "random":
        np.fmax.at(best, views.location, scored.scores[method])
    return pd.DataFrame({**columns, "best_score": best})


def latest_scores(tracking: TrackingConfig, dataset: str | None = None) -> pd.DataFrame | None:
    """The score table of the newest evaluation in a store, or None if there is none.

    Args:
        tracking: the store.
        dataset: name of the dataset evaluated; None for any.
    """
    from wheretolook.tracking import artifact, newest_run

    run = newest_run(tracking, "evaluate", {"dataset": dataset} if dataset else None)
    if run is None:
        return None
    return read_scores(artifact(tracking, run.info.run_id, SCORES_CSV))
