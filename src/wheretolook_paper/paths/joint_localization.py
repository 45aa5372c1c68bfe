"""Joint localization along compared paths: the views of a stop, and the last views of a path linked by odometry."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation
from tqdm.auto import tqdm

from wheretolook.dataset.viewpoint_table import pose_columns, poses
from wheretolook.geometry.poses import Float, camera_centers, invert_poses, poses_looking_along, rotation_angle_deg
from wheretolook.planning.stops import stops_along, within_pitch
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.registry import is_probability
from wheretolook_paper.paths.config import PathsConfig

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
