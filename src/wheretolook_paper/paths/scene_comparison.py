"""The comparison of paths in one scene: plan them, label their views, localize views jointly. Each step is cached."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.scene import Scene
from wheretolook.dataset.viewpoint_files import SCHEMA
from wheretolook.dataset.viewpoint_table import UNLABELLED
from wheretolook.localization.labeller import MANIFEST, LabelTask
from wheretolook.localization.shard import SceneJob
from wheretolook.planning.config import FORWARD
from wheretolook.planning.scene_map import planner_map, scene_scorer
from wheretolook.scorers.registry import is_probability
from wheretolook.utils.files import ArtifactCache, cache_key, fingerprint, read_json_object
from wheretolook_paper.evaluation.joint_labels import label_sets
from wheretolook_paper.paths.config import PathsConfig
from wheretolook_paper.paths.joint_localization import (
    OUTCOME,
    STOP_COLUMNS,
    LocalizeSets,
    choose_stop_views,
    joint_paths,
    localize_last_views,
    localize_stops,
)
from wheretolook_paper.paths.path_comparison import ComparedPaths, draw_pairs, plan_pairs

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
    dataset: Dataset
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
        scene = self.scene.config
        environment = [asdict(scene.free_space), asdict(scene.occlusion), self.scene.camera.record()]
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
