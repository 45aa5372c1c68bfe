"""Joint localization along compared paths: the views of a stop, and the last views of a path linked by odometry."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.dataset.viewpoint_table import pose_columns, poses
from wheretolook.geometry.poses import Float, camera_centers, poses_looking_along
from wheretolook.scorers.base import Scorer
from wheretolook.utils.errors import ConfigError
from wheretolook_paper.paths.config import PathsConfig
from wheretolook_paper.paths.odometry import noisy_steps, rig_of_last

KEY = ["pair", "task", "method"]
"""Columns that identify the path of a view."""

OUTCOME = ["status", "error_m", "error_deg", "n_inliers"]
"""Columns with the result of localizing one view, or several jointly."""

STOP_COLUMNS = [*KEY, "waypoint", "look", "score", "together", "turn_deg"]

WITH_STOPS = "with stops"
LAST_VIEWS = "last {} together"
"""Suffixes of a method's name for rows whose views of a stop, or whose last views, are localized jointly."""


class LocalizeSets(Protocol):
    """Localizes sets of a table's rows jointly: `label_sets` with the map and the camera of a scene bound."""

    def __call__(self, table: pd.DataFrame, sets: list[Any], *, rigs: list[Float] | None = None) -> pd.DataFrame: ...


def is_joint(config: PathsConfig) -> bool:
    """Return whether views are localized jointly, which needs the pixels of their matches."""
    return config.stops.looks > 1 or config.last_views > 1


def check_joint(config: PathsConfig) -> None:
    """Raise a ConfigError if stops are requested and no method supports them."""
    from wheretolook.planning.stops import can_stop

    if config.stops.looks > 1 and not any(map(can_stop, config.methods)):
        fix = "Add one that does, such as set, or omit paths.stops."
        raise ConfigError("stops need a method whose scores are probabilities", value=config.methods, fix=fix)


def choose_stop_views(
    views: pd.DataFrame, scorers: Mapping[str, Scorer], config: PathsConfig, progress: str
) -> pd.DataFrame:
    """Choose further views at the stops of paths, given the paths' views and a scorer for each method that can stop.

    Returns a row per further view with `STOP_COLUMNS` and its pose. `look` starts at 2; `together` is the joint score
    of all views of the stop, `turn_deg` the rotation that the stop takes.
    """
    from wheretolook.planning.stops import stops_along, within_pitch

    directions = within_pitch(config.axes(), config.planner)
    rows = []
    cam_from_world = []
    paths = list(views[views["method"].isin(list(scorers))].groupby(KEY, sort=False))
    for (pair, task, method), path in tqdm(paths, desc=progress, unit="path"):
        along = poses(path)
        centers = camera_centers(along)
        for stop in stops_along(scorers[method], centers, along[:, 2, :3], directions, config.stops, config.planner):
            for look, (score, axis) in enumerate(zip(stop.scores, stop.axes, strict=True), 2):
                values = (pair, task, method, stop.place, look, float(score), stop.together, stop.turn_deg)
                rows.append(dict(zip(STOP_COLUMNS, values, strict=True)))
                cam_from_world.append(poses_looking_along(centers[stop.place], axis))
    chosen = pd.DataFrame(rows, columns=STOP_COLUMNS)
    return chosen.assign(**pose_columns(np.stack(cam_from_world))) if rows else chosen


def localize_stops(
    views: pd.DataFrame, stop_views: pd.DataFrame, labels: pd.DataFrame, localize: LocalizeSets
) -> pd.DataFrame:
    """Return the views of the methods that can stop, each stop with the result of localizing all its views jointly.

    `labels` are those of the views, followed by those of the further views at stops, with their matches.
    """
    from wheretolook.planning.stops import can_stop

    result = _without_other_rules(views)
    result = result[result["method"].map(can_stop)].copy()
    waypoints = result[[*KEY, "waypoint"]].itertuples(index=False, name=None)
    row_of: dict[Any, int] = dict(zip(waypoints, result.index, strict=True))
    further: dict[Any, NDArray[np.int64]] = stop_views.groupby([*KEY, "waypoint"], sort=False).indices  # type: ignore[assignment]
    rows = [row_of[waypoint] for waypoint in further]
    sets = [[row, *(len(views) + more)] for row, more in zip(rows, further.values(), strict=True)]
    _replace_outcome(result, rows, localize(labels, sets))
    result.loc[rows, "score"] = [stop_views["together"].iloc[more[0]] for more in further.values()]
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
    result["n_looks"] = result["n_views"]
    turns = stop_views.drop_duplicates([*KEY, "waypoint"]).groupby(KEY)["turn_deg"].sum().to_dict()
    counts = stop_views.groupby(KEY).size().to_dict()
    result["turn_deg"] += [turns.get(key, 0.0) for key in result.index]
    result["n_looks"] += [counts.get(key, 0) for key in result.index]
    result = result.reset_index()
    return result.assign(method=result["method"].map(renamed))[[*paths.columns, "n_looks"]]


def _without_other_rules(views: pd.DataFrame) -> pd.DataFrame:
    """Return the views without those chosen by another rule, whose name follows the method's."""
    return views[~views["method"].str.contains(" ")].copy()


def _replace_outcome(views: pd.DataFrame, rows: list[int], outcome: pd.DataFrame) -> None:
    for name in OUTCOME:
        views.loc[rows, name] = outcome[name].astype(views[name].dtype).to_numpy()
