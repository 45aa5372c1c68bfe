"""The comparison of paths in one scene: plan them, label their views, localize views jointly. Each step is cached.

The views of a stop are localized jointly, and the last views of a path, linked by odometry.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation
from tqdm.auto import tqdm

from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.scene import Scene
from wheretolook.dataset.viewpoint_files import SCHEMA
from wheretolook.dataset.viewpoint_table import UNLABELLED, pose_columns, poses
from wheretolook.figures.floor_plan import save_figure
from wheretolook.geometry.poses import Float, camera_centers, invert_poses, poses_looking_along, rotation_angle_deg
from wheretolook.localization.config import LabelConfig
from wheretolook.localization.labeller import MANIFEST, LabelTask, label_scenes
from wheretolook.localization.shard import SceneJob
from wheretolook.planning.config import FORWARD
from wheretolook.planning.scene_map import planner_map, scene_scorer
from wheretolook.planning.stops import stops_along, within_pitch
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.registry import is_probability
from wheretolook.tracking import TrackingConfig, kept_if_not_logged
from wheretolook.utils.files import ArtifactCache, atomic_write, cache_key, fingerprint, read_json_object, write_text
from wheretolook_paper.evaluation.looks import label_sets
from wheretolook_paper.figures.paths import paths_figure
from wheretolook_paper.paths.config import PathsConfig
from wheretolook_paper.paths.path_comparison import ComparedPaths, draw_pairs, plan_pairs
from wheretolook_paper.paths.path_report import (
    PATHS_CSV,
    PATHS_MD,
    PATHS_PNG,
    log_paths,
    path_markdown,
    summarize_paths,
)

CACHE = "made.json"
"""Cache manifest next to a scene's paths."""

_REPORT_OPTIONS = {
    "scenes", "max_error_m", "max_error_deg", "resamples", "weights",
    "stops", "last_views", "odometry_m_per_m", "odometry_deg_per_deg",
}  # fmt: skip
"""Options that do not affect the planned paths of a scene."""


@dataclass(frozen=True, eq=False)
class SceneComparison:
    """Paths of several methods in one scene, and how their views localize.

    Attributes:
        folder: where paths, views and shards of labels are cached.
        config: what is compared.
        weights: file of each method; None for methods without weights.
        job: what labelling workers need; whether pixels are stored is decided here.
        log: prints a line of progress.
    """

    scene: Scene
    folder: Path
    config: PathsConfig
    weights: Mapping[str, Path | None]
    job: SceneJob
    log: Callable[[str], None]

    @cached_property
    def planned(self) -> ComparedPaths:
        """The paths and views of all methods, without labels."""
        cache = self._cache("paths", self._paths_key)
        tables = cache.load("paths.parquet", "views.parquet")
        if tables is not None:
            self.log(f"{self.scene.name}: reusing {self.folder}")
            return ComparedPaths(tables["paths.parquet"], tables["views.parquet"])
        scorers = self._scorers(lambda method: method != FORWARD)
        maps = {name: planner_map(self.scene, self.config, scorer) for name, scorer in scorers.items()}
        pairs = draw_pairs(self.scene.space, self.config)
        planned = plan_pairs(pairs, self.scene.space, maps, self.config, f"plan {self.scene.name}")
        cache.store({"paths.parquet": planned.paths, "views.parquet": planned.views})
        n_planned = int(planned.paths["planned"].sum())
        counts = f"{n_planned} of {len(planned.paths)} paths planned, {len(planned.views):,} views"
        self.log(f"{self.scene.name}: {counts} -> {self.folder}")
        return planned

    @cached_property
    def stop_views(self) -> pd.DataFrame:
        """The further views at stops, see `choose_stop_views`; empty without stops."""
        if self.config.stops.looks < 2:
            return pd.DataFrame(columns=STOP_COLUMNS)
        views = self.planned.views
        cache = self._cache("stops", cache_key("stops 1", [self._paths_key, asdict(self.config.stops)]))
        cached = cache.load("stops.parquet")
        if cached is not None:
            return cached["stops.parquet"]
        chosen = choose_stop_views(views, self._scorers(is_probability), self.config, f"stops {self.scene.name}")
        return cache.store({"stops.parquet": chosen})["stops.parquet"]

    def tasks(self) -> list[LabelTask]:
        """Return the labelling tasks of the scene: the views of paths, and the further views at stops."""
        manifest = self._manifest("shards")
        job = replace(self.job, store_pixels=self.config.is_joint or bool(manifest.get("store_pixels")))
        tables = {"shards": self.planned.views, "stop-shards": self.stop_views}
        return [
            LabelTask(self.scene.name, job, _as_viewpoints(table), self.folder / name)
            for name, table in tables.items()
            if len(table)
        ]

    def results(self, labels: Mapping[Path, pd.DataFrame]) -> ComparedPaths:
        """Return all paths and views with their labels, given the label tables of `tasks` by their folder of shards."""
        used = {name: self._remove_old_shards(name) for name in ("shards", "stop-shards")}
        of_views = labels[self.folder / "shards"]
        views = pd.concat([self.planned.views, of_views[OUTCOME]], axis=1)
        paths = self.planned.paths
        config = self.config
        if not config.is_joint:
            return ComparedPaths(paths, views)
        all_paths = [paths.assign(n_looks=paths["n_views"])]
        all_views = [views]
        if config.stops.looks > 1:
            of_stops = labels.get(self.folder / "stop-shards", pd.DataFrame())
            both = pd.concat([of_views, of_stops], ignore_index=True)
            key: list[Any] = [used, asdict(config.stops)]
            all_views.append(self._joint("stops", key, lambda fit: localize_stops(views, self.stop_views, both, fit)))
            all_paths.append(joint_paths(paths, all_views[-1], self.stop_views))
        if config.last_views > 1:
            key = [used, [config.last_views, config.odometry_m_per_m, config.odometry_deg_per_deg, config.seed]]
            all_views.append(self._joint("last", key, lambda fit: localize_last_views(views, of_views, config, fit)))
            all_paths.append(joint_paths(paths, all_views[-1], self.stop_views.iloc[:0]))
        return ComparedPaths(pd.concat(all_paths, ignore_index=True), pd.concat(all_views, ignore_index=True))

    @cached_property
    def _paths_key(self) -> str:
        files = self.scene.folder
        settings = {name: value for name, value in asdict(self.config).items() if name not in _REPORT_OPTIONS}
        scene = self.scene
        environment = [asdict(scene.free_space), asdict(scene.given_occlusion), scene.camera.record()]
        inputs = (files.mesh, files.landmarks, files.mapping_cameras, *self.weights.values())
        fingerprints = [fingerprint(path) if path and path.is_file() else None for path in inputs]
        return cache_key("paths 3", [settings, *environment, *fingerprints])

    def _cache(self, step: str, key: str) -> ArtifactCache:
        return ArtifactCache(self.folder, key, step, CACHE)

    def _scorers(self, chosen: Callable[[str], bool]) -> dict[str, Any]:
        names = filter(chosen, self.config.methods)
        return {name: scene_scorer(self.scene, name, self.weights[name]) for name in names}

    def _joint(self, name: str, key: list[Any], localize_views: Callable[[LocalizeSets], pd.DataFrame]) -> pd.DataFrame:
        cache = self._cache(f"{name}-together", cache_key(f"{name} together 1", key))
        file = f"{name}-together.parquet"
        if (known := cache.load(file)) is not None:
            return known[file]
        points = self.scene.landmarks.points
        given: dict[str, Any] = {"points": points, "cameras": self.scene.camera, "config": self.job.localizer}
        localize = partial(label_sets, **given, progress=f"{name} {self.scene.name}")
        return cache.store({file: localize_views(localize)})[file]

    def _manifest(self, shards: str) -> dict[str, Any]:
        try:
            return read_json_object(self.folder / shards / MANIFEST)
        except (OSError, ValueError):
            return {}

    def _remove_old_shards(self, shards: str) -> list[str]:
        """Delete the labels of views that are no longer planned; return the names of the current ones."""
        current = sorted(self._manifest(shards).get("shards", {}))
        for path in (self.folder / shards).glob("*.parquet"):
            if path.name not in current:
                path.unlink()
        return current


def _as_viewpoints(views: pd.DataFrame) -> pd.DataFrame:
    """Return views as unlabelled rows of a table of viewpoints."""
    values: dict[str, Any] = dict.fromkeys(("viewpoint_id", "location_id"), np.arange(len(views)))
    values |= {"status": UNLABELLED, "error_m": np.nan, "error_deg": np.nan}
    types = {field.name: field.type.to_pandas_dtype() for field in SCHEMA if field.name != "status"}
    columns = {name: values.get(name, views.get(name, 0)) for name in SCHEMA.names}
    return pd.DataFrame(columns, index=range(len(views))).astype(types)


KEY = ["pair", "task", "method"]
"""Columns that identify the path of a view."""

OUTCOME = ["status", "error_m", "error_deg", "n_inliers"]
"""Columns with the result of localizing one view, or several jointly."""

STOP_COLUMNS = [*KEY, "waypoint", "look", "score", "together", "turn_deg"]

WITH_STOPS = "with stops"
LAST_VIEWS = "last {} together"
"""Suffixes of a method's name for rows whose views of a stop, or whose last views, are localized jointly."""


LocalizeSets = Callable[..., pd.DataFrame]
"""Localizes sets of a table's rows jointly: `label_sets` with the map and the camera of a scene bound."""


def choose_stop_views(
    views: pd.DataFrame, scorers: Mapping[str, Scorer], config: PathsConfig, progress: str
) -> pd.DataFrame:
    """Choose further views at the stops of paths, given the paths' views and a scorer for each method that can stop.

    Returns a row per further view with `STOP_COLUMNS` and its pose. `look` starts at 2; `together` is the joint score
    of all views of the stop, `turn_deg` the rotation that the stop takes.
    """
    directions = within_pitch(config.axes(), config.planner)
    rows = []
    cam_from_world = []
    paths = list(views[views["method"].isin(list(scorers))].groupby(KEY, sort=False))
    for key, path in tqdm(paths, desc=progress, unit="path"):
        along = poses(path)
        centers = camera_centers(along)
        for stop in stops_along(scorers[key[-1]], centers, along[:, 2, :3], directions, config.stops, config.planner):
            for look, (score, axis) in enumerate(zip(stop.scores, stop.axes, strict=True), 2):
                rows.append((*key, stop.place, look, float(score), stop.together, stop.turn_deg))
                cam_from_world.append(poses_looking_along(centers[stop.place], axis))
    chosen = pd.DataFrame(rows, columns=STOP_COLUMNS)
    return chosen.assign(**pose_columns(np.stack(cam_from_world))) if rows else chosen


def localize_stops(
    views: pd.DataFrame, stop_views: pd.DataFrame, labels: pd.DataFrame, localize: LocalizeSets
) -> pd.DataFrame:
    """Return the views of the methods that can stop, each stop with the result of localizing all its views jointly.

    `labels` are those of the views, followed by those of the further views at stops, with their matches.
    """
    result = _without_other_rules(views)
    result = result[result["method"].map(is_probability)].copy()
    names = [*KEY, "waypoint"]
    places = pd.MultiIndex.from_frame(result[names])
    further = stop_views.groupby(names, sort=False)
    groups: dict[Any, Any] = further.indices
    rows = result.index[places.get_indexer(pd.MultiIndex.from_tuples(list(groups), names=names))].tolist()
    sets = [[row, *(len(views) + more)] for row, more in zip(rows, groups.values(), strict=True)]
    _replace_outcome(result, rows, localize(labels, sets))
    result.loc[rows, "score"] = further["together"].first().to_numpy()
    return result.assign(method=result["method"] + f" {WITH_STOPS}")


def localize_last_views(
    views: pd.DataFrame, labels: pd.DataFrame, config: PathsConfig, localize: LocalizeSets
) -> pd.DataFrame:
    """Return the views of all methods, each localized jointly with the views before it, linked by noisy odometry."""
    result = _without_other_rules(views)
    rng = np.random.default_rng(config.seed)
    sets = []
    rigs = []
    for _, path in result.groupby(KEY, sort=False):
        rows = path.sort_values("waypoint", kind="stable").index.to_numpy()
        steps = noisy_steps(poses(path.loc[rows]), config.odometry_m_per_m, config.odometry_deg_per_deg, rng)
        for view in range(1, len(rows)):  # there is none before the first
            rigs.append(rig_of_last(steps, view, config.last_views))
            sets.append(rows[max(0, view - config.last_views + 1) : view + 1][::-1])
    _replace_outcome(result, [rows[0] for rows in sets], localize(labels, sets, rigs=rigs))
    return result.assign(method=result["method"] + f" {LAST_VIEWS.format(config.last_views)}")


def joint_paths(paths: pd.DataFrame, views: pd.DataFrame, stop_views: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of `paths` for jointly localized views, renamed, with `n_looks` and the rotation at stops."""
    plain = views["method"].str.partition(" ")[0]
    renamed = dict(zip(plain, views["method"], strict=True))
    result = paths[paths["method"].isin(list(renamed))].set_index(KEY)
    result["promised"] = views.assign(method=plain).groupby(KEY)["score"].mean()
    turns = stop_views.drop_duplicates([*KEY, "waypoint"]).groupby(KEY)["turn_deg"].sum().to_dict()
    counts = stop_views.groupby(KEY).size().to_dict()
    result["turn_deg"] += [turns.get(key, 0.0) for key in result.index]
    result["n_looks"] = result["n_views"] + [counts.get(key, 0) for key in result.index]
    result = result.reset_index()
    return result.assign(method=result["method"].map(renamed))[[*paths.columns, "n_looks"]]


def noisy_steps(cam_from_world: Float, m_per_m: float, deg_per_deg: float, rng: np.random.Generator) -> Float:
    """Return steps (W - 1, 3, 4) between views (W, 3, 4) along a path: each camera from the next, with noise.

    The standard deviation of the translation is `m_per_m` metres along each axis per metre of the step, that of the
    rotation `deg_per_deg` degrees about each axis per degree.
    """
    steps = chained(cam_from_world[:-1], invert_poses(cam_from_world[1:]))
    metres = np.linalg.norm(steps[:, :, 3], axis=1, keepdims=True)
    radians = np.radians(rotation_angle_deg(steps[:, :, :3], np.eye(3)))[:, None]
    shift = m_per_m * metres * rng.normal(size=(len(steps), 3))
    rotation = Rotation.from_rotvec(deg_per_deg * radians * rng.normal(size=(len(steps), 3))).as_matrix()
    return np.concatenate([rotation @ steps[:, :, :3], (steps[:, :, 3] + shift)[..., None]], axis=2)


def rig_of_last(steps: Float, view: int, n: int) -> Float:
    """Return cam_from_rig (N, 3, 4) of a view and up to n - 1 views before it, newest first, given `noisy_steps`.

    The rig's frame is the camera of the view.
    """
    cam_from_rig: list[Float] = [np.eye(3, 4)]
    for step in steps[max(0, view - n + 1) : view][::-1]:
        cam_from_rig.append(chained(step, cam_from_rig[-1]))
    return np.stack(cam_from_rig)


def chained(a: Float, b: Float) -> Float:
    """Compose rigid transforms (..., 3, 4): first b, then a."""
    rotation = a[..., :3] @ b[..., :3]
    return np.concatenate([rotation, a[..., :3] @ b[..., 3:] + a[..., 3:]], axis=-1)


def _without_other_rules(views: pd.DataFrame) -> pd.DataFrame:
    """Return the views without those chosen by another rule, whose name follows the method's."""
    return views[~views["method"].str.contains(" ")].copy()


def _replace_outcome(views: pd.DataFrame, rows: list[int], outcome: pd.DataFrame) -> None:
    for name in OUTCOME:
        views.loc[rows, name] = outcome[name].astype(views[name].dtype).to_numpy()


def compare_scenes(scenes: Sequence[SceneComparison], label: LabelConfig) -> ComparedPaths:
    """Plan, label and localize in all scenes; return their paths and views, with the column `scene`."""
    tasks = [task for scene in scenes for task in scene.tasks()]
    with closing(label_scenes(tasks, label, description="localize")) as labelled:
        labels = {result.task.shards: result.table.reset_index(drop=True) for result in labelled}
    results = {one.scene.name: one.results(labels) for one in scenes}
    paths = pd.concat([found.paths.assign(scene=name) for name, found in results.items()], ignore_index=True)
    views = pd.concat([found.views.assign(scene=name) for name, found in results.items()], ignore_index=True)
    return ComparedPaths(paths, views)


def report_paths(
    compared: ComparedPaths, dataset: Dataset, config: PathsConfig, tracking: TrackingConfig, log: Callable[[str], None]
) -> pd.DataFrame:
    """Write and log `<dataset>/results/paths.*` of paths with localized views. Returns the table of `summarize_paths`."""
    summary = summarize_paths(compared.paths, compared.views, config)
    folder = dataset.root / "results"
    markdown = path_markdown(summary, config)
    write_text(folder / PATHS_CSV, summary.to_csv(index=False, float_format="%.6g", lineterminator="\n"))
    write_text(folder / PATHS_MD, markdown)
    with atomic_write(folder / "paths" / "views.parquet") as partial:
        compared.views.to_parquet(partial, index=False)
    save_figure(paths_figure(summary), folder / PATHS_PNG)
    params = {"dataset": dataset.name, "pairs": config.pairs, "seed": config.seed, "time_s": config.planner.time_s}
    params |= {"score_weight": config.planner.score_weight, "max_turn_deg": config.max_turn_deg}
    if config.stops.looks > 1:
        params |= {f"stops.{name}": value for name, value in asdict(config.stops).items()}
    if config.last_views > 1:
        params |= {"last_views": config.last_views}
        params |= {f"odometry_{unit}": getattr(config, f"odometry_{unit}") for unit in ("m_per_m", "deg_per_deg")}
    with kept_if_not_logged(f"the comparison in {folder}"):
        log_paths(params, summary, folder, tracking)
    log(markdown)
    log(f"-> {folder / PATHS_CSV}, {PATHS_MD}, {PATHS_PNG}; every view in {folder / 'paths'}")
    return summary
