"""Computations of the viewer: scores of a floor, a location and a view; comparison with labels."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float, camera_centers

if TYPE_CHECKING:
    import pandas as pd

    from wheretolook.scorers.base import Scorer
    from wheretolook.select.views import SelectedViews
    from wheretolook.select.where_to_look import WhereToLook

FLOOR_CELLS = 1200  # approximate number of cells in a floor's rectangle
MIN_CELL_M = 0.1
FLOOR_DIRECTIONS = 96
"""Directions per cell of a floor, 19 degrees apart: the best score is within 0.02 of that of 500 directions, in a third
of the time."""

FIRST_CELLS = 12  # scored before a floor is drawn
BLOCK = 1 << 10  # labelled views scored per step


@dataclass(eq=False)
class Floor:
    """Free cells of a horizontal grid, and the best score in each once computed."""

    height_m: float
    lower: Float  # (2,) m, corner of the grid
    cell_m: float
    shape: tuple[int, int]  # rows along y, columns along x
    cells: NDArray[np.int64]  # (K,) flat indices of free cells, in farthest-first order
    ground_m: float | None = None  # height of the ground below, if known
    scores: Float = field(init=False)  # (K,) NaN until computed
    axes: Float = field(init=False)  # (K, 3) best directions
    n_scored: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self.scores = np.full(len(self.cells), np.nan)
        self.axes = np.full((len(self.cells), 3), np.nan)

    @property
    def points(self) -> Float:
        """Centres of the free cells (K, 3), metres."""
        rows, columns = np.divmod(self.cells, self.shape[1])
        xy = self.lower + (np.stack([columns, rows], axis=1) + 0.5) * self.cell_m
        return np.column_stack([xy, np.full(len(xy), self.height_m)])

    @property
    def done(self) -> bool:
        """Whether all cells are scored."""
        return self.n_scored == len(self.cells)

    @property
    def n_first(self) -> int:
        """Number of cells, spread over the floor, that are scored before it is drawn."""
        return min(FIRST_CELLS, len(self.cells))

    def score_next(self, selector: WhereToLook, n: int = 1) -> bool:
        """Score the next n cells in the selector's directions. Returns whether any were left."""
        if self.done:
            return False
        rows = slice(self.n_scored, min(self.n_scored + n, len(self.cells)))
        scores = selector.scorer.score_around(self.points[rows], selector.directions)
        self.scores[rows] = scores.max(axis=1)
        self.axes[rows] = selector.directions[scores.argmax(axis=1)]
        self.n_scored = rows.stop
        return True

    def raster(self) -> Float:
        """Return scores (rows, columns), NaN outside free space; cells not yet scored have the nearest one's score."""
        values = np.full(self.shape[0] * self.shape[1], np.nan)
        if self.n_scored:
            from scipy.spatial import cKDTree

            points = self.points
            _, nearest = cKDTree(points[: self.n_scored]).query(points)
            values[self.cells] = self.scores[nearest]
        return values.reshape(self.shape)


def floor_at(space: Any, occlusion: Any, height_m: float) -> Floor:
    """Make the floor of the free cells at a height of `space`, without those inside the occlusion model's geometry."""
    (x0, y0, _), (x1, y1, _) = np.asarray(space.bounds, dtype=np.float64)
    cell = max(MIN_CELL_M, float(np.sqrt((x1 - x0) * (y1 - y0) / FLOOR_CELLS)))
    columns = max(1, ceil((x1 - x0) / cell))
    rows = max(1, ceil((y1 - y0) / cell))
    lower = np.array([(x0 + x1) / 2 - columns * cell / 2, (y0 + y1) / 2 - rows * cell / 2])
    points = Floor(height_m, lower, cell, (rows, columns), np.arange(rows * columns)).points
    free = space.is_free(points)
    free[free] = ~occlusion.inside_geometry(points[free])
    cells = np.flatnonzero(free)
    ground = None
    if len(cells) and hasattr(space, "floor_below"):
        ground = float(np.median(space.floor_below(points[cells])))
    order = farthest_first(np.stack(np.divmod(cells, columns), axis=1))
    return Floor(height_m, lower, cell, (rows, columns), cells[order], ground)


def farthest_first(points: NDArray[np.int64]) -> NDArray[np.int64]:
    """Order points (K, 2) from a central one, each the farthest from all before it; indices (K,).

    The first n cover the rest within twice the optimal distance (Gonzalez, "Clustering to minimize the maximum
    intercluster distance", 1985).
    """
    order = np.zeros(len(points), dtype=np.int64)
    distance = -((points - points.mean(axis=0)) ** 2).sum(1) if len(points) else np.empty(0)
    for k in range(len(points)):
        order[k] = distance.argmax()
        to_new = ((points - points[order[k]]) ** 2).sum(1)
        distance = to_new if k == 0 else np.minimum(distance, to_new)
        distance[order[k]] = -1
    return order


def height_range(space: Any, mapping_centers: Float) -> tuple[float, float, float]:
    """Return the lowest and highest free height, and the median height of the mapping cameras (M, 3), metres."""
    low, high = (float(z) for z in np.asarray(space.bounds)[:, 2])
    usual = float(np.median(mapping_centers[:, 2])) if len(mapping_centers) else (low + high) / 2
    return low, high, min(max(usual, low), high)


@dataclass(frozen=True, eq=False)
class ScoredLocation:
    """A location with the score of each direction and its best views."""

    position: Float  # (3,) m
    directions: Float  # (D, 3) unit optical axes
    scores: Float  # (D,)
    best: SelectedViews  # best first


def score_location(selector: WhereToLook, position: Float, n: int) -> ScoredLocation:
    """Score all directions at a position (3,) m and select the n best views, as `wheretolook select` does.

    Raises TableError if the position is outside the map or inside geometry.
    """
    position = np.asarray(position, dtype=np.float64)
    best = selector.best(position[None], n)
    scores = selector.scorer.score_around(position[None], selector.directions)[0]
    return ScoredLocation(position, selector.directions, scores, best)


@dataclass(frozen=True, eq=False)
class VisibleLandmarks:
    """The K landmarks visible in a view."""

    points: Float  # (K, 3) m
    pixels: Float  # (K, 2)
    probabilities: Float  # (K,) of being detected; NaN if unknown


def visible_landmarks(scorer: Scorer, pose: Float, fallback: Scorer | None = None) -> VisibleLandmarks:
    """Return the landmarks visible in a view (3, 4) with detection probabilities by `scorer` or by `fallback`."""
    localization_map = scorer.localization_map
    estimated = scorer.landmark_probabilities(pose[None])
    if estimated is None and fallback is not None:
        estimated = fallback.landmark_probabilities(pose[None])
    if estimated is None:
        rows = localization_map.landmarks_in_view(pose[None])[0].astype(np.int64)
        probabilities = np.full(len(rows), np.nan)
    else:
        rows = estimated.rows
        probabilities = estimated.p_detect
    points = localization_map.landmarks.points[rows]
    pixels = localization_map.camera.project(points @ pose[:, :3].T + pose[:, 3])
    return VisibleLandmarks(points, pixels, probabilities)


@dataclass(frozen=True, eq=False)
class ScoredLabels:
    """Labelled views and their scores."""

    positions: Float  # (B, 3) m
    axes: Float  # (B, 3)
    good: NDArray[np.bool_]  # (B,) whether the view localized
    scores: Float  # (B,)
    threshold: float

    @property
    def false_positive(self) -> NDArray[np.bool_]:
        """Views (B,) predicted to localize that did not."""
        return (self.scores >= self.threshold) & ~self.good

    @property
    def false_negative(self) -> NDArray[np.bool_]:
        """Views (B,) predicted not to localize that did."""
        return (self.scores < self.threshold) & self.good


def score_labels(
    scorer: Scorer, table: pd.DataFrame, limits: tuple[float, float], threshold: float
) -> Generator[None, None, ScoredLabels]:
    """Score labelled viewpoints block by block; the generator returns the result.

    A view is good if its errors are below `limits` (m, degrees).
    """
    from wheretolook.dataset.viewpoint_table import is_good, poses

    cam_from_world = poses(table)
    scores = np.empty(len(cam_from_world))
    for begin in range(0, len(scores), BLOCK):
        rows = slice(begin, begin + BLOCK)
        scores[rows] = scorer.score(cam_from_world[rows])
        yield None
    centers = camera_centers(cam_from_world)
    return ScoredLabels(centers, cam_from_world[:, 2, :3], is_good(table, *limits), scores, threshold)
