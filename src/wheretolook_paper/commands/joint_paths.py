"""Compared paths localized by several views at once: by the looks of a stop, and by the last views along the way."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.dataset.environment import Scene
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_table import pose_columns, poses
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float, camera_centers, poses_looking_along
from wheretolook.localization.config import LocalizerConfig
from wheretolook.planning.config import PathsConfig
from wheretolook.utils.artifact_cache import cache_key
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import atomic_write, write_json
from wheretolook.utils.parquet_files import read_parquet
from wheretolook.utils.reading import read_json

if TYPE_CHECKING:
    from wheretolook_paper.paths.path_comparison import ComparedPaths

KEY = ["pair", "task", "method"]
"""Columns that say of which path a view is."""

OUTCOME = ["status", "error_m", "error_deg", "n_inliers"]
"""Columns with what came of localizing a view, or several together."""

WITH_STOPS = "with stops"
LAST = "last {} together"
"""What is added to a method's name where the looks of a stop, or the last views, are localized together."""


def is_joint(config: PathsConfig) -> bool:
    """Whether views are to be localized together, for which it must be known where in each a landmark was matched."""
    return config.stops.looks > 1 or config.last_views > 1


def check_joint(config: PathsConfig) -> None:
    """Raise a ConfigError if stops are asked for, and no method can have them."""
    from wheretolook.planning.stops import can_stop

    if config.stops.looks > 1 and not any(map(can_stop, config.methods)):
        fix = "Compare one that is, such as set, or leave paths.stops out."
        raise ConfigError("stops need a method whose scores are probabilities", value=config.methods, fix=fix)


def choose_further(
    scene: Scene,
    dataset: Dataset,
    planned: ComparedPaths,
    planned_key: str,
    weights: Mapping[str, Path | None],
    config: PathsConfig,
    folder: Path,
) -> pd.DataFrame:
    """The further looks at the stops of a scene's paths, by methods that can stop: a row each, by path and place.

    Columns: `KEY`, `waypoint`, `look` (from 2 on), `score`, `together` (of all looks of the stop), `turn_deg` (of the
    stop), and the pose. Those kept in the folder, `stops.parquet`, if they were chosen for the same paths and settings.
    """
    from wheretolook.planning.scene_map import planner_scorer
    from wheretolook.planning.stops import can_stop, stops_along, within_pitch

    names = [*KEY, "waypoint", "look", "score", "together", "turn_deg"]
    if config.stops.looks < 2:
        return pd.DataFrame(columns=names)
    key = cache_key("stops 1", [planned_key, asdict(config.stops)])
    if (kept := _kept(folder / "stops.parquet", key)) is not None:
        return kept
    directions = within_pitch(config.axes(), config.planner)
    rows = []
    looks = []
    scorers = {name: planner_scorer(scene, dataset, name, weights[name]) for name in config.methods if can_stop(name)}
    along = list(planned.views[planned.views["method"].isin(list(scorers))].groupby(KEY, sort=False))
    for (pair, task, method), path in tqdm(along, desc=f"stops {scene.name}", unit="path"):
        looking = poses(path)
        at = camera_centers(looking)
        axes = looking[:, 2, :3]
        for stop in stops_along(scorers[method], at, axes, directions, config.stops, config.planner):
            for look, (score, axis) in enumerate(zip(stop.scores, stop.axes, strict=True), 2):
                values = (pair, task, method, stop.place, look, float(score), stop.together, stop.turn_deg)
                rows.append(dict(zip(names, values, strict=True)))
                looks.append(poses_looking_along(at[stop.place], axis))
    found = pd.DataFrame(rows, columns=names)
    if rows:
        found = found.assign(**pose_columns(np.stack(looks)))
    _keep(found, folder / "stops.parquet", key)
    return found


def localize_together(
    single: ComparedPaths,
    further: pd.DataFrame,
    labels: pd.DataFrame,
    further_labels: pd.DataFrame,
    scene: Scene,
    config: PathsConfig,
    localizer: LocalizerConfig,
    folder: Path,
    made_from: list[Any],
) -> ComparedPaths:
    """Further rows of a scene's paths and views, for methods with stops and for the last views together.

    `single` has what came of localizing each view alone. `labels` and `further_labels` are its views and those of
    `further` once more, in their order, with what each matched. Returned are a row a place, as single views have, with
    what came of localizing it, and paths that also have `n_looks`. What came out is kept in the folder,
    `*-together.parquet`, by what it was `made_from`.
    """
    from wheretolook_paper.paths.path_comparison import ComparedPaths

    points = scene.landmarks.points
    camera = scene.camera
    paths = []
    views = []

    def add(name: str, settings: list[Any], looks: pd.DataFrame, localize: Callable[[str], pd.DataFrame]) -> None:
        file = folder / f"{name}-together.parquet"
        key = cache_key(f"{name} together 1", [made_from, settings])
        table = _kept(file, key)
        if table is None:
            table = localize(f"{name} {scene.name}")
            _keep(table, file, key)
        views.append(table)
        paths.append(_paths_of(single.paths, table, looks))

    if config.stops.looks > 1:
        both = pd.concat([labels, further_labels], ignore_index=True)
        seen = (single.views, further, both, points, camera, localizer)
        add("stops", [asdict(config.stops)], further, lambda text: _with_stops(*seen, text))
    if config.last_views > 1:
        odometry = [config.last_views, config.odometry_m_per_m, config.odometry_deg_per_deg, config.seed]
        along = (single.views, labels, points, camera, config, localizer)
        add("last", odometry, further.iloc[:0], lambda text: _last(*along, text))
    return ComparedPaths(pd.concat(paths, ignore_index=True), pd.concat(views, ignore_index=True))


def _with_stops(
    views: pd.DataFrame,
    further: pd.DataFrame,
    labels: pd.DataFrame,
    points: Float,
    camera: Camera,
    localizer: LocalizerConfig,
    text: str,
) -> pd.DataFrame:
    """The views of the paths that stops were sought for, at a stop as its looks localize together.

    Labels are those of the views, then of the further looks.
    """
    from wheretolook.localization.joint_labels import label_sets
    from wheretolook.planning.stops import can_stop

    found = _by_no_rule(views)
    found = found[found["method"].map(can_stop)].copy()
    places = found[[*KEY, "waypoint"]].itertuples(index=False, name=None)
    row_of: dict[Any, int] = dict(zip(places, found.index, strict=True))
    looks: dict[Any, NDArray[np.int64]] = further.groupby([*KEY, "waypoint"], sort=False).indices  # type: ignore[assignment]
    own = [row_of[place] for place in looks]
    sets = [[row, *(len(views) + rows)] for row, rows in zip(own, looks.values(), strict=True)]
    outcome = label_sets(labels, sets, points, camera, localizer, progress=text)
    _replace_outcome(found, own, outcome)
    found.loc[own, "score"] = [further["together"].iloc[rows[0]] for rows in looks.values()]
    return found.assign(method=found["method"] + f" {WITH_STOPS}")


def _last(
    views: pd.DataFrame,
    labels: pd.DataFrame,
    points: Float,
    camera: Camera,
    config: PathsConfig,
    localizer: LocalizerConfig,
    text: str,
) -> pd.DataFrame:
    """The views of all paths but those by another rule, each localized with those before it as odometry tells them."""
    from wheretolook.localization.joint_labels import label_sets
    from wheretolook_paper.paths.odometry import rig_of_last, told_steps

    found = _by_no_rule(views)
    rng = np.random.default_rng(config.seed)
    sets = []
    rigs = []
    for _, path in found.groupby(KEY, sort=False):
        rows = path.sort_values("waypoint", kind="stable").index.to_numpy()
        steps = told_steps(poses(path.loc[rows]), config.odometry_m_per_m, config.odometry_deg_per_deg, rng)
        for view in range(1, len(rows)):  # the first has none before it
            rigs.append(rig_of_last(steps, view, config.last_views))
            sets.append(rows[max(0, view - config.last_views + 1) : view + 1][::-1])
    outcome = label_sets(labels, sets, points, camera, localizer, progress=text, rigs=rigs)
    now = [s[0] for s in sets]
    _replace_outcome(found, now, outcome)
    return found.assign(method=found["method"] + f" {LAST.format(config.last_views)}")


def _by_no_rule(views: pd.DataFrame) -> pd.DataFrame:
    """Without those along a given path that were chosen by another rule, whose name follows the method's."""
    return views[~views["method"].str.contains(" ")].copy()


def _replace_outcome(views: pd.DataFrame, rows: list[int], outcome: pd.DataFrame) -> None:
    """Set what came of localizing the views of some rows."""
    for name in OUTCOME:
        views.loc[rows, name] = outcome[name].astype(views[name].dtype).to_numpy()


def _paths_of(paths: pd.DataFrame, views: pd.DataFrame, further: pd.DataFrame) -> pd.DataFrame:
    """Rows of `paths` for the paths of some views under another name, with the further looks at their stops."""
    plain = views["method"].str.partition(" ")[0]
    named = dict(zip(plain, views["method"], strict=True))
    found = paths[paths["method"].isin(list(named))].set_index(KEY)
    found["promised"] = views.assign(method=plain).groupby(KEY)["score"].mean()
    found["n_looks"] = found["n_views"]
    turns = further.drop_duplicates([*KEY, "waypoint"]).groupby(KEY)["turn_deg"].sum().to_dict()
    counts = further.groupby(KEY).size().to_dict()
    found["turn_deg"] += [turns.get(key, 0.0) for key in found.index]
    found["n_looks"] += [counts.get(key, 0) for key in found.index]
    found = found.reset_index()
    return found.assign(method=found["method"].map(named))[[*paths.columns, "n_looks"]]


def _kept(path: Path, key: str) -> pd.DataFrame | None:
    """A table that was kept, if it is of this key."""
    try:
        if read_json(path.with_suffix(".json")) == key:
            return read_parquet(path)
    except (OSError, ValueError):
        pass
    return None


def _keep(table: pd.DataFrame, path: Path, key: str) -> None:
    path.with_suffix(".json").unlink(missing_ok=True)
    with atomic_write(path) as partial:
        table.to_parquet(partial, index=False, write_page_checksum=True)
    write_json(path.with_suffix(".json"), key)
