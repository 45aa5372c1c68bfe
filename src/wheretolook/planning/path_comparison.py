"""Paths between the same starts and goals, planned by several methods, to be localized along (paper, Sec. 4.3)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from tqdm.auto import tqdm

from wheretolook.geometry.poses import Float, poses_looking_along
from wheretolook.planning.config import PathConfig, PathsConfig
from wheretolook.planning.path_planning import plan_path
from wheretolook.planning.route_views import PlannedPath
from wheretolook.planning.sequences import TurnLimit, ViewSequence, best_sequence, greedy_sequence, resample_path
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.planning.ways import Ways
from wheretolook.space.free_space import FreeSpace
from wheretolook.space.mapped_space import MappedSpace
from wheretolook.utils.errors import PlanningError, SceneError
from wheretolook.viewpoints.table import pose_columns

FORWARD = "forward"
"""The method that needs no map: the shortest path, looking ahead."""

PLANNED, GIVEN = "planned", "given"
"""What a method may choose: places and views, or the views along a path that is given."""

Rule = Callable[[Float, TurnLimit], ViewSequence]

RULES: dict[str, Rule] = {"": best_sequence, "greedy": greedy_sequence}
"""How the views along a given path are chosen, exactly and by ActLoc's rule, by what is added to a method's name."""

DRAWS = 50
"""Pairs drawn for each one wanted, before a scene is said to have too little room."""

WAYS_M = 0.25
"""Grid of places by which to find out whether there is a way from a start to a goal."""


@dataclass(frozen=True, eq=False)
class ComparedPaths:
    """What was planned in a scene.

    Attributes:
        paths: a row for each pair, task (`PLANNED`, `GIVEN`) and method: `planned`, whether there is a path, its
            `length_m`, `turn_deg`, `n_views`, `promised`, the mean score of its views by the method's own map (NaN for
            "forward"), and `found_by` (`PlannedPath.found_by`).
        views: a row for each view along them: pair, task, method, waypoint, score, and
            `wheretolook.viewpoints.table.POSE_COLUMNS`.
    """

    paths: pd.DataFrame
    views: pd.DataFrame


def draw_pairs(space: FreeSpace | MappedSpace, config: PathsConfig) -> Float:
    """Starts and goals (P, 2, 3) m in free space, far enough from each other, with a way between them.

    Args:
        space: where a camera can be. Above floors, heights are those asked for; without a mesh, they are drawn.
        config: number of pairs, distance, heights, seed.

    Raises:
        SceneError: there is too little room.
    """
    rng = np.random.default_rng(config.seed)
    low, high = space.bounds
    ways = Ways(space, WAYS_M)
    found: list[Float] = []
    for _ in range(DRAWS * config.pairs):
        if len(found) == config.pairs:
            break
        ends = _free_points(space, rng.uniform(low, high, (400, 3)), config, rng)[:2]
        if len(ends) < 2 or np.linalg.norm(ends[1] - ends[0]) < config.min_distance_m:
            continue
        if ways.joins(ends[0], ends[1]):  # not in parts of the scene between which there is no way
            found.append(ends)
    if len(found) < config.pairs:
        raise SceneError(
            f"found only {len(found)} starts and goals {config.min_distance_m:g} m apart with a way between them",
            value=config.pairs,
            fix="Lower paths.min_distance_m or paths.pairs.",
        )
    return np.array(found)


def _free_points(space: FreeSpace | MappedSpace, points: Float, config: PathsConfig, rng: np.random.Generator) -> Float:
    points = points[space.is_free(points)]
    if isinstance(space, FreeSpace) and len(points):
        points[:, 2] = space.floor_below(points) + rng.uniform(*config.height_m, len(points))
        points = points[space.is_free(points)]
    return points


def shares_below(viewpoint_map: ViewpointMap) -> ViewpointMap:
    """The map with the share of all its views that score lower in place of each score: a ranking, in [0, 1].

    Planning weighs scores against metres. Information has no upper end and other units, so it enters by its ranks.
    """
    ordered = np.sort(viewpoint_map.scores, axis=None)
    shares = np.searchsorted(ordered, viewpoint_map.scores, side="left") / max(1, ordered.size - 1)
    origin = viewpoint_map.origin.derive("scores replaced by ranks")
    return replace(viewpoint_map, scores=shares.astype(np.float32), origin=origin)


def plan_pairs(
    pairs: Float,
    space: FreeSpace | MappedSpace,
    maps: Mapping[str, ViewpointMap],
    config: PathsConfig,
    progress: str | None = None,
) -> ComparedPaths:
    """Plan between pairs by every method; then choose views along the shortest paths by every method.

    Args:
        pairs: (P, 2, 3) starts and goals, metres.
        space: where a camera can be.
        maps: viewpoint map of each method but "forward", scores in [0, 1].
        config: planner, and limit on turns along given paths.
        progress: title of a progress bar; None shows none.

    Raises:
        PlanningError: no path was found at all.
    """
    paths: list[dict[str, Any]] = []
    tables: list[pd.DataFrame] = []

    def add(pair: int, task: str, method: str, path: PlannedPath | None) -> None:
        about = {"pair": pair, "task": task, "method": method, "planned": path is not None}
        if path is None:
            paths.append(
                {**about, "length_m": np.nan, "turn_deg": np.nan, "n_views": 0, "promised": np.nan, "found_by": ""}
            )
            return
        promised = float(path.scores.mean())
        paths.append(
            {
                **about,
                "length_m": path.length_m,
                "turn_deg": path.turn_deg,
                "n_views": len(path.positions),
                "promised": promised,
                "found_by": path.found_by,
            }
        )
        of_view = {
            "waypoint": np.arange(len(path.positions)),
            "score": path.scores,
            **pose_columns(poses_looking_along(path.positions, path.axes)),
        }
        tables.append(pd.DataFrame({"pair": pair, "task": task, "method": method, **of_view}))

    limits = {name: TurnLimit.of(views.directions, config.max_turn_deg) for name, views in maps.items()}
    with tqdm(total=len(pairs) * (1 + len(maps)), desc=progress, unit="path", disable=progress is None) as bar:
        for number, ends in enumerate(pairs):
            shortest = _planned(ends, space, None, config.planner)
            add(number, PLANNED, FORWARD, shortest)
            bar.update()
            for name, views in maps.items():
                add(number, PLANNED, name, _planned(ends, space, views, config.planner))
                bar.update()
            along = None if shortest is None else resample_path(shortest.positions, config.planner.spacing_m)
            add(number, GIVEN, FORWARD, _looking_ahead(shortest, along))
            for name, views in maps.items():
                for rule, choose in RULES.items():
                    path = None if along is None else _looking_about(along, views, limits[name], config, choose)
                    add(number, GIVEN, f"{name} {rule}".strip(), path)
    if not tables:
        raise PlanningError("no path was found at all", value=f"{len(pairs)} pairs", fix="Raise paths.planner.time_s.")
    return ComparedPaths(pd.DataFrame(paths), pd.concat(tables, ignore_index=True))


def _planned(
    ends: Float, space: FreeSpace | MappedSpace, viewpoint_map: ViewpointMap | None, config: PathConfig
) -> PlannedPath | None:
    try:
        return plan_path(ends[0], ends[1], space, space.bounds, viewpoint_map, config, progress=False)
    except PlanningError:
        return None


def _looking_ahead(shortest: PlannedPath | None, given: Float | None) -> PlannedPath | None:
    """The path at its waypoints, with the axes of the nearest view of the shortest path."""
    if shortest is None or given is None:
        return None
    nearest = np.linalg.norm(given[:, None] - shortest.positions[None], axis=2).argmin(1)
    return PlannedPath(given, shortest.axes[nearest], np.full(len(given), np.nan), shortest.cost)


def _looking_about(
    given: Float, viewpoint_map: ViewpointMap, limit: TurnLimit, config: PathsConfig, choose: Rule
) -> PlannedPath | None:
    """The views along a given path that a rule chooses within the limits; None where it leads to where none is left."""
    rows = viewpoint_map.rows(given)
    low, high = np.sin(np.radians(config.planner.pitch_deg))
    inside = (limit.directions[:, 2] >= low) & (limit.directions[:, 2] <= high)
    scores = np.where((rows >= 0)[:, None], viewpoint_map.scores[rows], 0.0).astype(np.float64)
    try:
        chosen = choose(np.where(inside, scores, -np.inf), limit)
    except PlanningError:
        return None
    return PlannedPath(given, limit.directions[chosen.direction_ids], chosen.scores, np.nan)
