"""Plan paths between the same starts and goals by several methods (paper, Sec. 4.3).

Views along a given path are the optimal sequence, or by ActLoc's greedy rule.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from tqdm.auto import tqdm

from wheretolook.dataset.viewpoint_table import pose_columns
from wheretolook.geometry.poses import Float, pan_tilt_angles, poses_looking_along
from wheretolook.planning.config import FORWARD
from wheretolook.planning.routes import PlannedPath
from wheretolook.planning.rrt import plan_path
from wheretolook.planning.view_sequence import (
    TurnLimit,
    ViewSequence,
    best_sequence,
    between,
    check_reached,
    check_scores,
    lengths_along,
)
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.space.free_space import FreeSpace
from wheretolook.space.mapped_space import MappedSpace
from wheretolook.utils.errors import PlanningError, SceneError
from wheretolook_paper.paths.config import PathsConfig

PLANNED = "planned"
GIVEN = "given"
"""Tasks: a method chooses positions and views, or only the views along a given path."""

Space = FreeSpace | MappedSpace
Rule = Callable[[Float, TurnLimit], ViewSequence]


GRID_M = 0.25
MAX_NODES = 200_000
"""Step and size limit of the grid that decides whether a goal is reachable."""

BLOCK = 10_000  # points tested for free space at a time


SPACING_M = 0.2  # distance of waypoints in the Active Localization Benchmark
TURN_PENALTY = 0.02
"""Penalty of ActLoc's greedy rule (lambda) for each step of its lattice of yaws and pitches."""


def greedy_sequence(scores: ArrayLike, limit: TurnLimit) -> ViewSequence:
    """Choose directions in the order of the waypoints: the best score less a penalty for turning (ActLoc).

    The penalty is for each step of 20 degrees of yaw and of pitch. Only directions within the limit are allowed. See
    `best_sequence` for the arguments and what is raised.
    """
    values = check_scores(scores, limit)
    n, d = values.shape
    penalty = TURN_PENALTY * _cells(limit.directions)
    ids = np.empty(n, dtype=np.int64)
    for waypoint in range(n):
        value = values[waypoint]
        if waypoint > 0:
            near = limit.neighbours[ids[waypoint - 1]]
            allowed = np.bincount(near, minlength=d + 1)[:d] > 0
            value = np.where(allowed, value - penalty[ids[waypoint - 1]], -np.inf)
        check_reached(value, waypoint, limit)
        ids[waypoint] = value.argmax()
    return ViewSequence(ids, values[np.arange(n), ids])


def resample_path(points: ArrayLike, spacing_m: float = SPACING_M) -> Float:
    """Return waypoints (W, 3) m along a polyline (P, 3) m: its first point, one every `spacing_m` along it, and its last.

    The last leg may be shorter than the others.
    """
    path = np.asarray(points, dtype=np.float64)
    at = lengths_along(path)
    # a remainder that is only rounding adds no waypoint
    return between(at, path, np.append(np.arange(0, at[-1] - 1e-9 * spacing_m, spacing_m), at[-1]))


def _cells(directions: Float) -> Float:
    """Compute differences (D, D) of pitch plus, the short way round, of yaw between directions, in steps of 20 degrees."""
    yaw, pitch = map(np.degrees, pan_tilt_angles(directions))
    across = np.abs(yaw[:, None] - yaw)
    return np.asarray((np.abs(pitch[:, None] - pitch) + np.minimum(across, 360 - across)) / 20)


RULES: dict[str, Rule] = {"": best_sequence, "greedy": greedy_sequence}
"""Selection of views along a given path, optimal and by ActLoc's rule, by the suffix of the method's name."""


@dataclass(frozen=True, eq=False)
class ComparedPaths:
    """Planned paths of a scene and their views.

    `paths` has a row for each pair, task (`PLANNED`, `GIVEN`) and method: `planned`, whether there is a path, its
    `length_m`, `turn_deg`, `n_views`, `promised`, the mean score of its views by the method's map (NaN for "forward"),
    and `found_by` (`PlannedPath.found_by`). `views` has a row for each view: pair, task, method, waypoint, score, and
    `wheretolook.dataset.viewpoint_table.POSE_COLUMNS`.
    """

    paths: pd.DataFrame
    views: pd.DataFrame


def draw_pairs(space: Space, config: PathsConfig) -> Float:
    """Draw starts and goals (P, 2, 3) m in free space, far enough apart and connected.

    Heights above floors are those of `config`; without a mesh they are random. Raises SceneError without enough room.
    """
    rng = np.random.default_rng(config.seed)
    low, high = space.bounds
    reachability = Reachability(space)
    found: list[Float] = []
    for _ in range(50 * config.pairs):  # draws for each pair before giving up
        if len(found) == config.pairs:
            break
        points = rng.uniform(low, high, (400, 3))
        points = points[space.is_free(points)]
        if isinstance(space, FreeSpace) and len(points):
            points[:, 2] = space.floor_below(points) + rng.uniform(*config.height_m, len(points))
            points = points[space.is_free(points)]
        ends = points[:2]
        apart = len(ends) == 2 and np.linalg.norm(ends[1] - ends[0]) >= config.min_distance_m
        if apart and reachability.connects(ends[0], ends[1]):
            found.append(ends)
    if len(found) < config.pairs:
        problem = f"found only {len(found)} starts and goals {config.min_distance_m:g} m apart with a way between them"
        raise SceneError(problem, value=config.pairs, fix="Lower paths.min_distance_m or paths.pairs.")
    return np.array(found)


class Reachability:
    """Reachability in free space: connected components of a grid whose edges are free straight segments.

    The step `GRID_M` is enlarged if there would be more than `MAX_NODES` nodes.
    """

    def __init__(self, space: Space) -> None:
        self.space = space
        low, high = np.asarray(space.bounds, dtype=np.float64)
        step_m = max(GRID_M, float(np.prod(high - low) / MAX_NODES) ** (1 / 3))
        axes = [np.arange(a + step_m / 2, max(b, a + step_m), step_m) for a, b in zip(low, high, strict=True)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        number = np.full(points.shape[:3], -1)
        blocks = np.array_split(points.reshape(-1, 3), points.size // (3 * BLOCK) + 1)
        free = np.concatenate([space.is_free(block) for block in blocks]).reshape(number.shape)
        number[free] = np.arange(free.sum())
        self._nodes: Float = points[free]
        lines = [np.moveaxis(number, axis, 0) for axis in range(3)]
        edges = np.concatenate([np.stack([line[:-1].ravel(), line[1:].ravel()], axis=1) for line in lines])
        edges = edges[(edges >= 0).all(1)]
        edges = edges[space.segments_are_free(self._nodes[edges[:, 0]], self._nodes[edges[:, 1]])]
        n = len(self._nodes)
        graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
        self._part = connected_components(graph, directed=False)[1] if n else np.empty(0, dtype=np.int32)
        self._tree = cKDTree(self._nodes)

    def connects(self, a: ArrayLike, b: ArrayLike) -> bool:
        """Return whether points (3,) m are connected."""
        return bool(self._parts_near(a) & self._parts_near(b))

    def _parts_near(self, point: ArrayLike) -> set[int]:
        if not len(self._nodes):
            return set()
        # the nearest eight nodes of the grid are tried as connections
        near = np.atleast_1d(self._tree.query(point, k=min(8, len(self._nodes)))[1])
        straight = self.space.segments_are_free(np.tile(point, (len(near), 1)), self._nodes[near])
        return set(self._part[near[straight]].tolist())


def plan_pairs(
    pairs: Float, space: Space, maps: Mapping[str, ViewpointMap], config: PathsConfig, progress: str | None = None
) -> ComparedPaths:
    """Plan between pairs by every method, and choose views along the shortest paths by every method.

    `pairs` are starts and goals (P, 2, 3) m, `maps` the viewpoint map of each method except "forward", with scores in
    [0, 1]. Raises PlanningError if no path was found at all.
    """
    limits = {name: TurnLimit.of(views.directions, config.max_turn_deg) for name, views in maps.items()}
    found: list[tuple[dict[str, Any], PlannedPath | None]] = []
    for number, ends in enumerate(tqdm(pairs, progress, unit="pair", disable=progress is None)):
        planned = {name: _planned(ends, space, views, config) for name, views in {FORWARD: None, **maps}.items()}
        found += [({"pair": number, "task": PLANNED, "method": name}, path) for name, path in planned.items()]
        given: dict[str, PlannedPath | None] = {FORWARD: None}
        if (shortest := planned[FORWARD]) is not None:
            along = resample_path(shortest.positions, config.planner.spacing_m)
            given[FORWARD] = _forward_views(shortest, along)
        for name, views in maps.items():
            for rule, choose in RULES.items():
                chosen = None if shortest is None else _chosen_views(along, views, limits[name], config, choose)
                given[f"{name} {rule}".strip()] = chosen
        found += [({"pair": number, "task": GIVEN, "method": name}, path) for name, path in given.items()]
    if all(path is None for _, path in found):
        raise PlanningError("no path was found at all", value=f"{len(pairs)} pairs", fix="Raise paths.planner.time_s.")
    tables = [
        pd.DataFrame({**key, "waypoint": np.arange(len(path.positions)), "score": path.scores}).assign(
            **pose_columns(poses_looking_along(path.positions, path.axes))
        )
        for key, path in found
        if path is not None
    ]
    return ComparedPaths(pd.DataFrame([_row(*one) for one in found]), pd.concat(tables, ignore_index=True))


def _row(key: dict[str, Any], path: PlannedPath | None) -> dict[str, Any]:
    if path is None:
        missing = {"length_m": np.nan, "turn_deg": np.nan, "n_views": 0, "promised": np.nan, "found_by": ""}
        return {**key, "planned": False, **missing}
    numbers = {"length_m": path.length_m, "turn_deg": path.turn_deg, "n_views": len(path.positions)}
    promised = float(path.scores.mean())
    return {**key, "planned": True, **numbers, "promised": promised, "found_by": path.found_by or ""}


def _planned(ends: Float, space: Space, viewpoint_map: ViewpointMap | None, config: PathsConfig) -> PlannedPath | None:
    try:
        return plan_path(ends[0], ends[1], space, space.bounds, viewpoint_map, config.planner, progress=False)
    except PlanningError:
        return None


def _forward_views(shortest: PlannedPath, given: Float) -> PlannedPath:
    """Return the given waypoints with the axes of the nearest views of the shortest path."""
    nearest = np.linalg.norm(given[:, None] - shortest.positions[None], axis=2).argmin(1)
    return PlannedPath(given, shortest.axes[nearest], np.full(len(given), np.nan), shortest.cost)


def _chosen_views(
    given: Float, viewpoint_map: ViewpointMap, limit: TurnLimit, config: PathsConfig, choose: Rule
) -> PlannedPath | None:
    """Choose views along a given path by a rule within the limits; None if the rule reaches a dead end."""
    rows = viewpoint_map.rows(given)
    low, high = np.sin(np.radians(config.planner.pitch_deg))
    inside = (limit.directions[:, 2] >= low) & (limit.directions[:, 2] <= high)
    scores = np.where((rows >= 0)[:, None], viewpoint_map.scores[rows], 0.0).astype(np.float64)
    try:
        chosen = choose(np.where(inside, scores, -np.inf), limit)
    except PlanningError:
        return None
    return PlannedPath(given, limit.directions[chosen.direction_ids], chosen.scores, np.nan)
