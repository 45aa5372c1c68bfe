"""Planned paths of a dataset's scenes, rendered and localized, `<dataset>/results/paths/`; resumes."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from wheretolook.config import Experiment
from wheretolook.dataset.folders import Dataset, SceneFolder
from wheretolook.dataset.scene import is_photographed, space_and_occlusion
from wheretolook.dataset.stamps import stage_key
from wheretolook.features.keypoints import ExtractorConfig
from wheretolook.figures.style import save_figure
from wheretolook.labelling.labeller import MANIFEST, LabelTask, label_scenes, storing
from wheretolook.labelling.shard import SceneJob
from wheretolook.planning.config import PathsConfig
from wheretolook.planning.path_comparison import FORWARD, ComparedPaths, draw_pairs, plan_pairs
from wheretolook.planning.path_report import PATHS_CSV, PATHS_MD, PATHS_PNG, log_paths, path_markdown, summarize_paths
from wheretolook.planning.planner_map import check_methods, planner_map
from wheretolook.planning.scene_map import weights_for
from wheretolook.stages.inputs import Say, Tick, dataset_after, extractor_of
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.utils.files import fingerprint, write_json, write_text
from wheretolook.viewpoints.table import SCHEMA, UNLABELLED

if TYPE_CHECKING:
    import pandas as pd


FOLDER = "paths"
"""In `results/`: a folder for each scene with `paths.parquet` and `views.parquet`, and what was made of all of them."""


def compare_scenes(
    dataset: Dataset, experiment: Experiment, extractor_of: Callable[[SceneFolder], ExtractorConfig], say: Say = print
) -> pd.DataFrame:
    """Plan, render, localize and count; see `wheretolook.stages.compare_paths.compare_paths`.

    Args:
        dataset: its scenes have meshes and maps.
        experiment: settings.
        extractor_of: what a scene's map was made with.
        say: told what was done.

    Returns:
        `wheretolook.planning.path_report.summarize_paths`.

    Raises:
        ConfigError: no such scene or method, or no weights. SceneError: a scene has no mesh, or too little room.
    """
    config = experiment.paths
    check_methods(config.methods)
    scenes = _chosen(dataset, config)
    planned = {scene.name: _plan(scene, dataset, experiment, say) for scene in scenes}
    labelled = _localize(scenes, planned, dataset, experiment, extractor_of)
    paths = pd.concat([one.paths.assign(scene=name) for name, one in planned.items()], ignore_index=True)
    views = pd.concat([table.assign(scene=name) for name, table in labelled.items()], ignore_index=True)
    summary = summarize_paths(paths, views, config)
    folder = dataset.root / "results"
    with storing(folder / PATHS_CSV):
        summary.to_csv(folder / PATHS_CSV, index=False, float_format="%.6g", lineterminator="\n")
        write_text(folder / PATHS_MD, path_markdown(summary, config))
        views.to_parquet(folder / FOLDER / "views.parquet", index=False)
    from wheretolook.figures.paths import paths_figure

    save_figure(paths_figure(summary), folder / PATHS_PNG)
    params = {"dataset": dataset.name, "pairs": config.pairs, "seed": config.seed, "time_s": config.planner.time_s,
              "score_weight": config.planner.score_weight, "max_turn_deg": config.max_turn_deg}  # fmt: skip
    log_paths(params, summary, folder, experiment.tracking)
    say(path_markdown(summary, config))
    say(f"-> {folder / 'paths.csv'}, paths.md, paths.png; every view in {folder / FOLDER}")
    return summary


def _chosen(dataset: Dataset, config: PathsConfig) -> list[SceneFolder]:
    scenes = [dataset.scene(name) for name in config.scenes] or list(dataset.split("test"))
    if not scenes:
        raise ConfigError("the dataset has no test scene", path=dataset.root, fix="Name scenes in paths.scenes.")
    for scene in scenes:
        if is_photographed(scene) or not scene.mesh.is_file():
            raise SceneError("without a mesh nothing can be rendered", path=scene.folder, fix="Choose other scenes.")
    return scenes


def _plan(scene: SceneFolder, dataset: Dataset, experiment: Experiment, say: Say) -> ComparedPaths:
    """The paths of a scene: those that are there if they were planned with the same settings."""
    config, folder = experiment.paths, dataset.root / "results" / FOLDER / scene.name
    weights = {method: weights_for(method, dataset, config.weights, say) for method in config.methods}
    settings = {name: value for name, value in asdict(config).items() if name not in _OF_THE_REPORT}
    key = stage_key("paths 2", [settings, asdict(experiment.scenes.free_space), asdict(experiment.occlusion),
                              asdict(dataset.camera), fingerprint(scene.mesh), fingerprint(scene.landmarks),
                              fingerprint(scene.mapping_cameras) if scene.mapping_cameras.is_file() else None,
                              [path and fingerprint(path) for path in weights.values()]])  # fmt: skip
    files = {name: folder / f"{name}.parquet" for name in ("paths", "views")}
    made = folder / "made.json"
    if made.is_file() and all(file.is_file() for file in files.values()) and json.loads(made.read_text()) == key:
        say(f"{scene.name}: reusing {folder}")
        return ComparedPaths(**{name: pd.read_parquet(file) for name, file in files.items()})
    space, occlusion = space_and_occlusion(scene, dataset.camera, experiment, experiment.occlusion)
    maps = {
        method: planner_map(method, weights[method], config.grid, config.directions, config.lattice, scene, dataset,
                            space, occlusion, experiment.warp_device)
        for method in config.methods
        if method != FORWARD
    }  # fmt: skip
    found = plan_pairs(draw_pairs(space, config), space, maps, config, f"plan {scene.name}")
    made.unlink(missing_ok=True)
    with storing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, file in files.items():
            getattr(found, name).to_parquet(file, index=False)
        write_json(made, key)
    failed, total = int((~found.paths["planned"]).sum()), len(found.paths)
    say(f"{scene.name}: {total - failed} of {total} paths found, {len(found.views):,} views -> {folder}")
    return found


_OF_THE_REPORT = ("scenes", "max_error_m", "max_error_deg", "resamples", "weights")
"""Settings that decide nothing about the paths of a scene."""


def _localize(
    scenes: list[SceneFolder], planned: dict[str, ComparedPaths], dataset: Dataset, experiment: Experiment,
    extractor_of: Callable[[SceneFolder], ExtractorConfig],
) -> dict[str, pd.DataFrame]:  # fmt: skip
    """The views of each scene with what came of localizing them."""
    config, tasks = experiment.label, []
    for scene in scenes:
        job = SceneJob(scene.mesh, scene.landmarks, dataset.camera, config.localizer, extractor_of(scene),
                       experiment.warp_device)  # fmt: skip
        shards = dataset.root / "results" / FOLDER / scene.name / "shards"
        tasks.append(LabelTask(scene.name, job, _as_table(planned[scene.name].views), shards))
    labelled: dict[str, pd.DataFrame] = {}
    with closing(label_scenes(tasks, config, description="localize")) as results:
        for one in results:
            outcome = one.table[["status", "error_m", "error_deg", "n_inliers"]].reset_index(drop=True)
            labelled[one.task.name] = pd.concat([planned[one.task.name].views, outcome], axis=1)
    for task in tasks:  # views of paths that were planned with other settings
        current = json.loads((task.shards / MANIFEST).read_text())["shards"]
        for path in task.shards.glob("*.parquet"):
            if path.name not in current:
                path.unlink()
    return labelled


def _as_table(views: pd.DataFrame) -> pd.DataFrame:
    """Views as rows of a table of viewpoints, to be labelled."""
    n = len(views)
    values: dict[str, Any] = {
        "viewpoint_id": np.arange(n), "location_id": np.arange(n), "direction_id": np.zeros(n),
        "n_visible": np.zeros(n), "visibility_rank": np.zeros(n), "status": np.full(n, UNLABELLED),
        "error_m": np.full(n, np.nan), "error_deg": np.full(n, np.nan), "n_inliers": np.zeros(n),
    }  # fmt: skip
    types = {field.name: field.type.to_pandas_dtype() for field in SCHEMA if field.name != "status"}
    columns = {name: values.get(name, views.get(name)) for name in SCHEMA.names}
    return pd.DataFrame(columns).astype(types)


def compare_paths(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> pd.DataFrame:
    """Paths planned by several methods, rendered and localized: `<dataset>/results/paths.{csv,md,png}`, MLflow runs.

    Needs the map stage only. What was planned and localized before is used again.

    Returns:
        `wheretolook.planning.path_report.summarize_paths`.

    Raises:
        ConfigError: no such scene or method, or no weights. WeightsError: the weights cannot be used.
        SceneError: a scene has no mesh, or too little room for starts and goals.
    """

    summary = compare_scenes(dataset_after(experiment, "map"), experiment, extractor_of, say)
    tick(1)
    return summary
