"""Plan a walk through a scene with a camera at eye height, which covers part of the floor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra

from wheretolook.mapping.config import (
    CELL_M,
    EYE_HEIGHT_VARIATION_M,
    MAX_STEP_HEIGHT_M,
    PITCH_VARIATION_DEG,
    SWING_PERIOD,
    VISIT_RADIUS_M,
    WalkConfig,
)
from wheretolook.utils.errors import ConfigError, SceneError

Float = NDArray[np.float64]


class FreeSpaceQueries(Protocol):
    """The part of `wheretolook.space.free_space.FreeSpace` that a walk uses."""

    def is_free(self, points: Any) -> NDArray[np.bool_]: ...

    def segments_are_free(self, a: Any, b: Any) -> NDArray[np.bool_]: ...

    def floor_below(self, points: Any) -> NDArray[np.floating[Any]]: ...


@dataclass(frozen=True)
class PartOfFloor:
    """Free space above a part of the floor: rectangles (x0, y0, x1, y1) in metres; a step may lead between two."""

    space: FreeSpaceQueries
    rectangles: tuple[tuple[float, float, float, float], ...]

    def is_free(self, points: Any) -> NDArray[np.bool_]:
        """Whether a camera can be at points (N, 3)."""
        at = np.asarray(points, dtype=np.float64)[:, None, :2]
        part = np.asarray(self.rectangles, dtype=np.float64)
        free: NDArray[np.bool_] = np.any(((at >= part[:, :2]) & (at <= part[:, 2:])).all(-1), axis=-1)
        free[free] = self.space.is_free(np.asarray(points)[free])
        return free

    def segments_are_free(self, a: Any, b: Any) -> NDArray[np.bool_]:
        """Whether a camera can move straight from a (N, 3) to b (N, 3), both above this part; (N,)."""
        return self.is_free(a) & self.is_free(b) & self.space.segments_are_free(a, b)

    def floor_below(self, points: Any) -> NDArray[np.floating[Any]]:
        """Height (N,) of the floor below points (N, 3)."""
        return self.space.floor_below(points)


@dataclass(frozen=True, eq=False)
class Walk:
    """A walk and the camera poses along it."""

    positions: Float  # (n, 3) metres, camera centres in the order of the walk
    directions: Float  # (n, 3) unit optical axes in the world
    path: Float  # (M, 3) metres, corners of the walk at mean eye height; every segment between two corners is free
    coverage: float  # share of the reachable floor within `visit_radius_m` walking distance of the walk
    visit_radius_m: float  # the radius used

    @property
    def length_m(self) -> float:
        """Length of the path in metres."""
        return _length_m(self.path)


@dataclass(frozen=True, eq=False)
class _Places:
    """Eye positions (P, 3) above free floor, and a symmetric graph of free steps weighted by length."""

    eyes: Float
    steps: csr_matrix


def plan_walk(
    free_space: FreeSpaceQueries, bounds: ArrayLike, n_images: int, config: WalkConfig | None = None, seed: int = 0
) -> Walk:
    """Plan a walk from a random place to ever the nearest unvisited floor until enough is visited.

    `bounds` (2, 3) metres are the lowest and highest corner of the scene. The poses are spaced evenly along the walk
    and look mostly along it. Raises ConfigError for fewer than two, SceneError if there is no floor to walk on.
    """
    config = config or WalkConfig()
    if n_images < 2:
        raise ConfigError("a map needs at least two images", value=n_images)
    rng = np.random.default_rng(seed)
    places = _reachable_places(free_space, np.asarray(bounds, dtype=np.float64), config)
    start = int(rng.integers(len(places.eyes)))
    radius_m = VISIT_RADIUS_M
    while True:
        corners, coverage = _visit(places, start, radius_m, config.coverage)
        path = places.eyes[corners]
        if len(corners) == 1 or _length_m(path) <= (n_images - 1) * config.image_spacing_m:
            break
        radius_m *= 1.2
    positions, headings = _along(path, n_images, rng)
    positions = _vary_height(free_space, positions, config, rng)
    return Walk(positions, _swing(headings, config, rng), path, coverage, radius_m)


def _length_m(path: Float) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def _reachable_places(free_space: FreeSpaceQueries, bounds: Float, config: WalkConfig) -> _Places:
    """The largest connected set of places, over all storeys of the scene."""
    low, high = bounds
    nx, ny = np.maximum(np.ceil((high - low)[:2] / CELL_M).astype(int), 1)
    heights = np.arange(low[2] + config.eye_height_m, high[2] + config.eye_height_m, 1.0)
    i, j, h = np.meshgrid(np.arange(nx), np.arange(ny), np.arange(len(heights)), indexing="ij")
    cell = np.stack([i.ravel(), j.ravel()], axis=1)
    probes = np.column_stack([low[:2] + (cell + 0.5) * CELL_M, heights[h.ravel()]])
    floor = np.asarray(free_space.floor_below(probes), dtype=np.float64)
    found = np.isfinite(floor)
    # Several probes of a cell may hit the same floor: one place for each floor of each cell.
    key = np.column_stack([cell[found], np.rint(100 * floor[found]).astype(np.int64)])
    key, first = np.unique(key, axis=0, return_index=True)
    eyes = probes[found][first]
    eyes[:, 2] = floor[found][first] + config.eye_height_m
    # Only below the top of the scene: a roof is not a floor to walk on.
    free = eyes[:, 2] < high[2]
    free[free] = free_space.is_free(eyes[free])
    key = key[free]
    eyes = eyes[free]
    if len(eyes) == 0:
        value = f"eye height {config.eye_height_m} m"
        fix = "Check that the scene is in metres with z up, or lower eye_height_m or the clearance of free space."
        raise SceneError("there is no free floor to walk on at eye height", value=value, fix=fix)
    a, b = _neighbours(key)
    # There must be floor at about the same height at both places and half way: no step off a gallery or over a gap.
    middle = (eyes[a] + eyes[b]) / 2
    below = middle[:, 2] - config.eye_height_m - np.asarray(free_space.floor_below(middle), dtype=np.float64)
    drop = np.column_stack([eyes[a, 2] - eyes[b, 2], below])
    near = (np.abs(drop) <= MAX_STEP_HEIGHT_M).all(1)  # False where there is no floor (NaN)
    a = a[near]
    b = b[near]
    if len(a):
        clear = np.asarray(free_space.segments_are_free(eyes[a], eyes[b]), dtype=bool)
        a = a[clear]
        b = b[clear]
    length = np.linalg.norm(eyes[a] - eyes[b], axis=1)
    both = (np.concatenate([length, length]), (np.concatenate([a, b]), np.concatenate([b, a])))
    steps = csr_matrix(both, shape=(len(eyes), len(eyes)))
    _, component = connected_components(steps, directed=False)
    members = np.flatnonzero(component == np.bincount(component).argmax())
    if len(members) < 2:
        problem = "no two neighbouring places of the floor are joined by a free step"
        fix = "Lower cell_m or the clearance of free space."
        raise SceneError(problem, value=f"cell {CELL_M} m", fix=fix)
    return _Places(eyes[members], steps[members][:, members])


def _neighbours(key: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of places (a, b) whose cells (first two columns) touch at a side or corner, each pair once."""
    width = int(key[:, 1].max()) + 3
    code = key[:, 0] * width + key[:, 1]  # sorted, since the rows of key are
    pairs = []
    for di, dj in ((0, 1), (1, -1), (1, 0), (1, 1)):
        target = code + di * width + dj
        valid = (key[:, 1] + dj) >= 0
        first = np.searchsorted(code, target, "left")
        last = np.searchsorted(code, target, "right")
        count = np.where(valid, last - first, 0)
        a = np.repeat(np.arange(len(code)), count)
        b = np.repeat(first, count) + np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        pairs.append(np.stack([a, b]))
    a, b = np.concatenate(pairs, axis=1)
    return a, b


def _visit(places: _Places, start: int, radius_m: float, coverage: float) -> tuple[NDArray[np.int64], float]:
    """Indices of the places along the walk, and the share of all places visited."""
    here = start
    corners = [here]
    fresh = [here]
    visited = np.zeros(len(places.eyes), dtype=bool)
    while True:
        reached = dijkstra(places.steps, indices=fresh, min_only=True, limit=radius_m)
        visited |= np.isfinite(reached)
        if visited.mean() >= coverage:
            break
        distance, previous = dijkstra(places.steps, indices=here, return_predecessors=True)
        target = int(np.where(visited, np.inf, distance).argmin())
        fresh = [target]
        while (last := int(previous[fresh[-1]])) != here and last >= 0:
            fresh.append(last)
        fresh.reverse()
        corners += fresh
        here = target
    return np.array(corners), float(visited.mean())


def _along(path: Float, n_images: int, rng: np.random.Generator) -> tuple[Float, Float]:
    """Points spaced evenly along the path (n, 3), and the direction of the path ahead of each (n, 3)."""
    look_ahead_m = 1.0
    start = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.linspace(0, start[-1], n_images)

    def point(s: Float) -> Float:
        return np.stack([np.interp(s, start, path[:, k]) for k in range(3)], axis=1)

    behind = np.maximum(np.minimum(at, start[-1] - look_ahead_m), 0)
    heading = point(behind + look_ahead_m) - point(behind)
    heading[:, 2] = 0
    # Where the walk turns back on itself, the heading vanishes; keep the last one there.
    length = np.linalg.norm(heading, axis=1)
    angle = rng.uniform(0, 2 * np.pi)
    last = np.array([np.cos(angle), np.sin(angle), 0.0])
    for k in range(n_images):
        if length[k] > 0.1:
            last = heading[k] / length[k]
        heading[k] = last
    return point(at), heading


def _vary_height(free_space: FreeSpaceQueries, positions: Float, config: WalkConfig, rng: np.random.Generator) -> Float:
    varied = positions.copy()
    varied[:, 2] += EYE_HEIGHT_VARIATION_M * rng.uniform(-1, 1, len(positions))
    free = np.asarray(free_space.segments_are_free(positions, varied), dtype=bool)
    return np.where(free[:, None], varied, positions)


def _swing(headings: Float, config: WalkConfig, rng: np.random.Generator) -> Float:
    n = len(headings)
    phase = 2 * np.pi * (np.arange(n) / SWING_PERIOD + rng.uniform())
    yaw = np.arctan2(headings[:, 1], headings[:, 0])
    yaw = yaw + np.radians(config.swing_deg * np.sin(phase) + rng.normal(0, 5, n))
    pitch = np.radians(config.pitch_deg + PITCH_VARIATION_DEG * rng.uniform(-1, 1, n))
    return np.column_stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
