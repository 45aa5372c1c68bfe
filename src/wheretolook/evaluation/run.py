"""The evaluate stage: score the viewpoints of the test scenes with every method, tabulate, draw and log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.dataset import Dataset, SceneFolder, write_text
from wheretolook.errors import TableError, WeightsError
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.ranking import TestViews
from wheretolook.evaluation.report import score_markdown
from wheretolook.evaluation.scores import ALL, Method, score_table
from wheretolook.features import INPUT_VARIANTS
from wheretolook.geometry import Float
from wheretolook.localization_map import LocalizationMap
from wheretolook.scene_occlusion import scene_occlusion
from wheretolook.scoring import Scorer, make_scorer
from wheretolook.table import fingerprint, is_good, poses
from wheretolook.tracking import TrackingConfig, log, start_run
from wheretolook.visibility.config import OcclusionConfig

if TYPE_CHECKING:
    from wheretolook.learning.training import TrainedModel

BLOCK = 4096
"""Views binned and scored at a time."""

SCORES_CSV, SCORES_MD, SCORES_PNG, OCCLUSION_PNG = "scores.csv", "scores.md", "scores.png", "occlusion.png"
"""Files of an evaluation, in `<dataset>/results/` and as artifacts of its run."""


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

    Writes the table as `<dataset>/results/scores.csv` and `scores.md`, a figure `scores.png`, and an MLflow run with
    one nested run for each method, inputs, N and occlusion model. With several occlusion models `scores.md` and
    `scores.png` show the first, and `occlusion.png` compares them.

    Args:
        dataset: labelled scenes; they need not be of the dataset the models were trained on.
        config: methods, values of N, thresholds.
        tracking: where to log.
        models: models or weights files to compare, instead of those that `config.weights` tells.
        progress: show a progress bar, and print the table at the end.
        device: where kernels and networks run, "cpu" or a CUDA device.
        occlusion: settings of the models that `config.occlusions` names.

    Returns:
        The tables of `wheretolook.evaluation.scores.score_table`, one below the other, with a column `occlusion`.

    Raises:
        TableError: there is no scene of the split, or a viewpoint has no label.
        WeightsError: weights are missing, or were trained for another field of view.
        MapError: a scene has no landmarks.
    """
    scenes = dataset.split(config.split)
    if not scenes:
        fix = "Make one, or choose another split."
        raise TableError(f"the dataset has no {config.split} scene", path=dataset.root, fix=fix)
    weights = _weights(dataset, config, models)
    if config.split == "test":
        _check_unseen(scenes, weights)
    tables = [scene.read_table() for scene in scenes]
    views = _test_views(scenes, tables, config)
    parts = []
    for name in config.occlusions or (None,):
        model = None if name is None else replace(occlusion, model=name)
        scores, used = _score_scenes(dataset, scenes, tables, config, weights, device, progress, model)
        part = score_table(views, scores, [scene.name for scene in scenes], config)
        part.insert(2, "occlusion", used)
        parts.append(part)
    table = pd.concat(parts, ignore_index=True)
    _write_results(dataset.root / "results", table, f"Localization score on {dataset.name}")
    _log(dataset, scenes, config, tracking, weights, views, table, occlusion)
    if progress:
        print(score_markdown(table, f"Localization score on {dataset.name}"))
    return table


def _weights(dataset: Dataset, config: EvaluateConfig, models: Sequence[TrainedModel | Path] | None) -> list[Path]:
    if "mlp" not in config.methods:
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
    return weights


def _own_weights(dataset: Dataset) -> list[Path]:
    """The weights in the dataset's folder, which must be trained on what the dataset now holds."""
    from wheretolook.learning.training import training_fingerprint
    from wheretolook.learning.weights import read_training

    named = (dataset.root / "weights" / f"mlp-{variant}.safetensors" for variant in INPUT_VARIANTS)
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


def _test_views(scenes: Sequence[SceneFolder], tables: Sequence[pd.DataFrame], config: EvaluateConfig) -> TestViews:
    location: list[NDArray[np.int64]] = []
    location_scene: list[NDArray[np.int64]] = []
    good: list[NDArray[np.bool_]] = []
    for number, (scene, table) in enumerate(zip(scenes, tables, strict=True)):
        if table.empty:
            raise TableError("the table has no viewpoints", path=scene.table, fix="Run the sample stage again.")
        try:
            good.append(np.stack([is_good(table, *limits) for limits in config.thresholds], axis=-1))
        except TableError as error:
            raise TableError(error.problem, path=scene.table, value=error.value, fix=error.fix) from None
        names, rows = np.unique(table["location_id"].to_numpy(np.int64), return_inverse=True)
        location.append(rows + sum(len(part) for part in location_scene))
        location_scene.append(np.full(len(names), number))
    if len(np.unique(np.concatenate(good)[:, 0])) < 2:
        metres, degrees = config.thresholds[0]
        raise TableError(
            f"labels of one class only: of {sum(map(len, good))} viewpoints all or none are within {metres:g} m and "
            f"{degrees:g} degrees", path=scenes[0].table, value=bool(good[0][0, 0]),
            fix="Label more viewpoints, or give other evaluate.thresholds.",
        )  # fmt: skip
    ids = np.concatenate([table["viewpoint_id"].to_numpy(np.int64) for table in tables])
    return TestViews(np.concatenate(location), ids, np.concatenate(good), np.concatenate(location_scene))


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
    text = "score views" if occlusion is None else f"score views, {occlusion.model}"
    with tqdm(total=sum(map(len, tables)), desc=text, unit="view", disable=not progress) as bar:
        for scene, table in zip(scenes, tables, strict=True):
            localization_map = scene.localization_map(dataset.camera, device)
            if occlusion is not None:
                model = scene_occlusion(scene, dataset.camera, occlusion, device, progress=progress)
                localization_map = replace(localization_map, occlusion=model)
            used.add(localization_map.occlusion.name)
            scorers = _scorers(localization_map, config, weights)
            cam_from_world = poses(table)
            for begin in range(0, len(table), BLOCK):
                block = cam_from_world[begin : begin + BLOCK]
                binned = localization_map.bin_views(block)
                for method, scorer in scorers.items():
                    scores.setdefault(method, []).append(scorer.score_binned(block, binned))
                bar.update(len(block))
    return {method: np.concatenate(parts) for method, parts in scores.items()}, " ".join(sorted(used))


def _scorers(
    localization_map: LocalizationMap, config: EvaluateConfig, weights: Sequence[Path]
) -> dict[Method, Scorer]:
    scorers: dict[Method, Scorer] = {}
    for name in config.methods:
        for path in weights if name == "mlp" else [None]:
            scorer = make_scorer(name, localization_map, config.seed, path)
            key = (scorer.name, scorer.inputs)
            if key in scorers:  # two files of one variant: told apart by their names
                key = (scorer.name, f"{scorer.inputs} {path}")
            scorers[key] = scorer
    return scorers


def _write_results(folder: Path, table: pd.DataFrame, title: str) -> None:
    from wheretolook.figures.scores import score_figure
    from wheretolook.figures.style import save_figure

    folder.mkdir(parents=True, exist_ok=True)
    (folder / OCCLUSION_PNG).unlink(missing_ok=True)
    if table["occlusion"].nunique() > 1:
        from wheretolook.figures.occlusion import occlusion_figure

        save_figure(occlusion_figure(table), folder / OCCLUSION_PNG)
    for name, text in ((SCORES_CSV, table.to_csv(index=False)), (SCORES_MD, score_markdown(table, title))):
        write_text(folder / name, text)
    save_figure(score_figure(table), folder / SCORES_PNG)


def _log(
    dataset: Dataset,
    scenes: Sequence[SceneFolder],
    config: EvaluateConfig,
    tracking: TrackingConfig,
    weights: Sequence[Path],
    views: TestViews,
    table: pd.DataFrame,
    occlusion: OcclusionConfig,
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
    positives = float(views.good[:, 0].mean())
    tags = {"dataset": dataset.name}
    with start_run(tracking, f"evaluate {dataset.name}", "evaluate", params, tags=tags) as (client, run):
        metrics = {"n_locations": views.n_locations, "n_views": len(views.good), "positives": positives}
        log(client, run, metrics=metrics)
        client.log_artifacts(run, str(dataset.root / "results"))
        for row in table[table["scene"] == ALL].to_dict("records"):
            named = ("method", "inputs", "occlusion", "top_n")
            shown = (row["method"], row["inputs"], f"best {row['top_n']}", f"({row['occlusion']})")
            name = " ".join(part for part in shown if part)
            child_params = {"dataset": dataset.name, **{key: row[key] for key in named}}
            numbers = {str(key): float(value) for key, value in row.items() if key not in (*named, "scene")}
            with start_run(tracking, name, "evaluate", child_params, parent=run) as (_, child):
                log(client, child, metrics=numbers)


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
    table = pd.read_csv(artifact(tracking, run.info.run_id, SCORES_CSV), keep_default_na=False, na_values=[""])
    return table.assign(inputs=table["inputs"].fillna(""))
