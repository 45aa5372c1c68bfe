"""The compare-paths stage: paths of several methods, rendered and localized, `<dataset>/results/paths/`; resumes."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from wheretolook.config import Experiment
from wheretolook.dataset.dataset_lock import reading
from wheretolook.dataset.environment import Scene
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.viewpoint_table import SCHEMA, UNLABELLED
from wheretolook.planning.config import FORWARD, PathsConfig
from wheretolook.stages.preconditions import Say, Tick, dataset_after, extractor_of, open_scene
from wheretolook.tracking.config import TrackingConfig
from wheretolook.tracking.store import check_store, kept_if_not_logged
from wheretolook.utils.artifact_cache import cache_key
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.utils.files import atomic_write, fingerprint, write_json, write_text
from wheretolook.utils.parquet_files import read_parquet
from wheretolook.utils.reading import read_json, read_json_object
from wheretolook_paper.commands import joint_paths

if TYPE_CHECKING:
    from wheretolook_paper.paths.path_comparison import ComparedPaths

FOLDER = "paths"
"""In `results/`: a folder for each scene with `paths.parquet` and `views.parquet`, and what was made of all of them."""


def compare_paths(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> pd.DataFrame:
    """Paths planned by several methods, rendered and localized: `<dataset>/results/paths.{csv,md,png}`, MLflow runs.

    Needs the map stage only. What was planned and localized before is used again. With `paths.stops` and
    `paths.last_views` views are also localized together (`stages/joint_paths.py`). Returns what
    `wheretolook_paper.paths.path_report.summarize_paths` makes of it.

    Raises:
        ConfigError: no such scene or method, no weights, or no method that can stop where stops are asked for.
        WeightsError: the weights cannot be used.
        SceneError: a scene has no mesh, or too little room for starts and goals.
        TrackingError: the tracking store cannot be used.
    """
    from wheretolook.planning.scene_map import check_methods
    from wheretolook.weights.resolve import resolve_weights

    with reading(experiment.root, "compare-paths", FOLDER):
        dataset = dataset_after(experiment, "map")
        config = experiment.paths
        check_methods(config.methods)
        joint_paths.check_joint(config)
        check_store(experiment.tracking)
        scenes = [open_scene(experiment, dataset, files) for files in _chosen(dataset, config)]
        weights = {
            method: resolve_weights(method, config.weights, dataset=dataset, log=say) for method in config.methods
        }
        planned = {scene.name: _plan(scene, dataset, config, weights, say) for scene in scenes}
        found = _localize(scenes, planned, dataset, weights, experiment)
        paths = pd.concat([one.paths.assign(scene=name) for name, one in found.items()], ignore_index=True)
        views = pd.concat([one.views.assign(scene=name) for name, one in found.items()], ignore_index=True)
        summary = _report(paths, views, dataset, config, experiment.tracking, say)
    tick(1)
    return summary


def _chosen(dataset: Dataset, config: PathsConfig) -> list[SceneFolder]:
    scenes = [dataset.scene(name) for name in config.scenes] or list(dataset.split("test"))
    if not scenes:
        raise ConfigError("the dataset has no test scene", path=dataset.root, fix="Name scenes in paths.scenes.")
    for files in scenes:
        if not files.mesh.is_file():
            raise SceneError("without a mesh nothing can be rendered", path=files.folder, fix="Choose other scenes.")
    return scenes


def _plan(
    scene: Scene, dataset: Dataset, config: PathsConfig, weights: Mapping[str, Path | None], say: Say
) -> ComparedPaths:
    """The paths of a scene: those that are there if they were planned with the same settings."""
    from wheretolook.planning.scene_map import planner_map, planner_scorer
    from wheretolook_paper.paths.path_comparison import ComparedPaths, draw_pairs, plan_pairs

    files = scene.files
    folder = _folder(dataset, scene)
    settings = {name: value for name, value in asdict(config).items() if name not in _OF_THE_REPORT}
    looked_at = [asdict(scene.config.free_space), asdict(scene.config.occlusion), scene.camera.record()]
    poses = files.mapping_cameras if files.mapping_cameras.is_file() else None
    made_from = [path and fingerprint(path) for path in (files.mesh, files.landmarks, poses)]
    used = [path and fingerprint(path) for path in weights.values()]
    key = cache_key("paths 2", [settings, *looked_at, *made_from, used])
    tables = {name: folder / f"{name}.parquet" for name in ("paths", "views")}
    made = folder / MADE
    if all(path.is_file() for path in tables.values()) and _holds(made, key):
        try:
            kept = ComparedPaths(**{name: read_parquet(path) for name, path in tables.items()})
            say(f"{scene.name}: reusing {folder}")
            return kept
        except ValueError as error:
            say(f"{scene.name}: its paths are damaged, and planned anew: {error}")
    mapped = [name for name in config.methods if name != FORWARD]
    maps = {name: planner_map(scene, config, planner_scorer(scene, dataset, name, weights[name])) for name in mapped}
    found = plan_pairs(draw_pairs(scene.space, config), scene.space, maps, config, f"plan {scene.name}")
    made.unlink(missing_ok=True)
    for name, path in tables.items():
        with atomic_write(path) as partial:
            getattr(found, name).to_parquet(partial, index=False, write_page_checksum=True)
    write_json(made, key)
    failed = int((~found.paths["planned"]).sum())
    total = len(found.paths)
    say(f"{scene.name}: {total - failed} of {total} paths found, {len(found.views):,} views -> {folder}")
    return found


MADE = "made.json"
"""File beside a scene's paths with the key of what they were made from."""

_OF_THE_REPORT = (
    "scenes", "max_error_m", "max_error_deg", "resamples", "weights",
    "stops", "last_views", "odometry_m_per_m", "odometry_deg_per_deg",
)  # fmt: skip
"""Settings that decide nothing about the paths of a scene."""


def _localize(
    scenes: list[Scene],
    planned: dict[str, ComparedPaths],
    dataset: Dataset,
    weights: Mapping[str, Path | None],
    experiment: Experiment,
) -> dict[str, ComparedPaths]:
    """The paths and views of each scene, with what came of localizing the views: each alone, and together if asked."""
    from wheretolook.localization.labeller import MANIFEST, LabelTask, label_scenes
    from wheretolook.localization.shard import SceneJob
    from wheretolook_paper.paths.path_comparison import ComparedPaths

    config = experiment.label
    paths = experiment.paths
    tasks = []
    joint = joint_paths.is_joint(paths)
    further = {}
    for scene in scenes:
        name = scene.name
        files = scene.files
        folder = _folder(dataset, scene)
        extractor = extractor_of(files, experiment.map.extractor)
        shards = folder / "shards"
        job = SceneJob(files.mesh, files.landmarks, scene.camera, config.localizer, extractor, scene.device)
        job = replace(job, store_pixels=joint or _holds_pixels(shards / MANIFEST))
        tasks.append(LabelTask(name, job, _as_table(planned[name].views), shards))
        if joint:
            about = (planned[name], str(read_json(folder / MADE)), weights)
            further[name] = joint_paths.choose_further(scene, dataset, *about, paths, folder)
            if len(further[name]):
                tasks.append(LabelTask(name, job, _as_table(further[name]), folder / "stop-shards"))
    labelled: dict[Path, pd.DataFrame] = {}
    with closing(label_scenes(tasks, config, description="localize")) as results:
        for result in results:
            table = result.table.reset_index(drop=True)
            labelled[result.task.shards] = table if joint else table[joint_paths.OUTCOME]
    shards_of: dict[Path, dict[str, Any]] = {}
    for task in tasks:  # views of paths that were planned with other settings
        current = shards_of[task.shards] = read_json_object(task.shards / MANIFEST)["shards"]
        for path in task.shards.glob("*.parquet"):
            if path.name not in current:
                path.unlink()
    found = {}
    for scene in scenes:
        name = scene.name
        folder = _folder(dataset, scene)
        own = planned[scene.name]
        labels = labelled[folder / "shards"]
        looks = labelled.get(folder / "stop-shards", pd.DataFrame())
        views = pd.concat([own.views, labels[joint_paths.OUTCOME]], axis=1)
        found[name] = ComparedPaths(own.paths, views)
        if joint:
            made_from = [sorted(shards_of.get(folder / part, {})) for part in ("shards", "stop-shards")]
            more = joint_paths.localize_together(
                found[name], further[name], labels, looks, scene, paths, config.localizer, folder, made_from
            )
            single = own.paths.assign(n_looks=own.paths["n_views"])
            both = pd.concat([single, more.paths], ignore_index=True), pd.concat([views, more.views], ignore_index=True)
            found[name] = ComparedPaths(*both)
    return found


def _holds_pixels(manifest: Path) -> bool:
    """Whether views were localized before with what a joint pose needs: then they are used again, which it includes."""
    try:
        return bool(read_json_object(manifest).get("store_pixels"))
    except (OSError, ValueError):
        return False


def _holds(path: Path, key: str) -> bool:
    try:
        return bool(read_json(path) == key)
    except (OSError, ValueError):
        return False


def _report(
    paths: pd.DataFrame, views: pd.DataFrame, dataset: Dataset, config: PathsConfig, tracking: TrackingConfig, say: Say
) -> pd.DataFrame:
    """Count what localizes, write and log it."""
    from wheretolook.figures.style import save_figure
    from wheretolook_paper.figures.paths import paths_figure
    from wheretolook_paper.paths import path_report as report

    summary = report.summarize_paths(paths, views, config)
    folder = dataset.root / "results"
    markdown = report.path_markdown(summary, config)
    write_text(folder / report.PATHS_CSV, summary.to_csv(index=False, float_format="%.6g", lineterminator="\n"))
    write_text(folder / report.PATHS_MD, markdown)
    with atomic_write(folder / FOLDER / "views.parquet") as partial:
        views.to_parquet(partial, index=False)
    save_figure(paths_figure(summary), folder / report.PATHS_PNG)
    params = {"dataset": dataset.name, "pairs": config.pairs, "seed": config.seed, "time_s": config.planner.time_s}
    params |= {"score_weight": config.planner.score_weight, "max_turn_deg": config.max_turn_deg}
    if config.stops.looks > 1:
        params |= {f"stops.{name}": value for name, value in asdict(config.stops).items()}
    if config.last_views > 1:
        params |= {"last_views": config.last_views}
        params |= {f"odometry_{unit}": getattr(config, f"odometry_{unit}") for unit in ("m_per_m", "deg_per_deg")}
    with kept_if_not_logged(f"the comparison in {folder}"):
        report.log_paths(params, summary, folder, tracking)
    say(markdown)
    say(f"-> {folder / report.PATHS_CSV}, {report.PATHS_MD}, {report.PATHS_PNG}; every view in {folder / FOLDER}")
    return summary


def _folder(dataset: Dataset, scene: Scene) -> Path:
    return dataset.root / "results" / FOLDER / scene.name


def _as_table(views: pd.DataFrame) -> pd.DataFrame:
    """Views as rows of a table of viewpoints, to be labelled."""
    values: dict[str, Any] = dict.fromkeys(("viewpoint_id", "location_id"), np.arange(len(views)))
    values |= {"status": UNLABELLED, "error_m": np.nan, "error_deg": np.nan}
    types = {field.name: field.type.to_pandas_dtype() for field in SCHEMA if field.name != "status"}
    columns = {name: values.get(name, views.get(name, 0)) for name in SCHEMA.names}
    return pd.DataFrame(columns, index=range(len(views))).astype(types)
