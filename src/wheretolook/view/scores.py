"""Scores of a floor, a location and labelled views."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field
from math import ceil
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float

if TYPE_CHECKING:
    from wheretolook.scorers.base import Scorer
    from wheretolook.select.views import SelectedViews
    from wheretolook.select.where_to_look import WhereToLook

FLOOR_CELLS = 1200  # approximate number of cells in a floor's rectangle
MIN_CELL_M = 0.1
FLOOR_DIRECTIONS = 96
"""Directions per cell of a floor, 19 degrees apart: the best score is within 0.02 of that of 500 directions, in a third
of the time."""

FIRST_CELLS = 12  # scored before a floor is drawn
ABOVE_GROUND_M = 0.03  # above carpets
BLOCK = 1 << 10  # labelled views scored per step


@dataclass(eq=False)
class Floor:
    """Free cells of a horizontal grid, and the best score in each once computed."""

    selector: WhereToLook  # scores the cells in its directions
    height_m: float
    lower: Float  # (2,) m, corner of the grid
    cell_m: float
    shape: tuple[int, int]  # rows along y, columns along x
    cells: NDArray[np.int64]  # (K,) flat indices of free cells, in farthest-first order
    drawn_m: float  # height at which the floor is drawn
    scores: Float = field(init=False)  # (K,) NaN until computed
    axes: Float = field(init=False)  # (K, 3) best directions
    n_scored: int = 0

    def __post_init__(self) -> None:
        self.scores = np.full(len(self.cells), np.nan)
        self.axes = np.full((len(self.cells), 3), np.nan)

    @property
    def points(self) -> Float:
        """Centres of the free cells (K, 3), metres."""
        rows, columns = np.divmod(self.cells, self.shape[1])
        xy = self.lower + (np.stack([columns, rows], axis=1) + 0.5) * self.cell_m
        return np.column_stack([xy, np.full(len(xy), self.height_m)])

    def score_next(self, n: int) -> bool:
        """Score the next n cells. Returns whether any were left."""
        rows = slice(self.n_scored, min(self.n_scored + n, len(self.cells)))
        if rows.start == rows.stop:
            return False
        scores = self.selector.scorer.score_directions(self.points[rows], self.selector.directions)
        self.scores[rows] = scores.max(axis=1)
        self.axes[rows] = self.selector.directions[scores.argmax(axis=1)]
        self.n_scored = rows.stop
        return True

    def raster(self) -> Float:
        """Return scores (rows, columns), NaN outside free space; cells not yet scored have the nearest one's score."""
        from scipy.spatial import cKDTree

        values = np.full(self.shape, np.nan)
        if self.n_scored:
            _, nearest = cKDTree(self.points[: self.n_scored]).query(self.points)
            values.flat[self.cells] = self.scores[nearest]
        return values


def floor_at(selector: WhereToLook, height_m: float) -> Floor:
    """Make the floor of the free cells at a height of the selector's space, without those inside geometry.

    It is drawn on the ground if its height is known, where it hides less than at the camera's height.
    """
    space = selector.space
    low, high = np.asarray(space.bounds, dtype=np.float64)[:, :2]
    cell = max(MIN_CELL_M, float(np.sqrt(np.prod(high - low) / FLOOR_CELLS)))
    columns, rows = (max(1, ceil(length)) for length in (high - low) / cell)
    lower = (low + high) / 2 - np.array([columns, rows]) * cell / 2
    floor = Floor(selector, height_m, lower, cell, (rows, columns), np.arange(rows * columns), height_m)
    free = space.is_free(floor.points)
    free[free] = ~selector.localization_map.occlusion.inside_geometry(floor.points[free])
    cells = np.flatnonzero(free)
    drawn_m = height_m
    if len(cells) and hasattr(space, "floor_below"):
        drawn_m = float(np.median(space.floor_below(floor.points[cells]))) + ABOVE_GROUND_M
    order = farthest_first(np.stack(np.divmod(cells, columns), axis=1))
    return Floor(selector, height_m, lower, cell, (rows, columns), cells[order], drawn_m)


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
    best = selector.best(position[None], n)
    scores = selector.scorer.score_directions(position[None], selector.directions)[0]
    return ScoredLocation(position, selector.directions, scores, best)


def score_in_blocks(scorer: Scorer, cam_from_world: Float) -> Generator[None, None, Float]:
    """Score poses (B, 3, 4) block by block; the generator returns the scores (B,)."""
    scores = np.empty(len(cam_from_world))
    for begin in range(0, len(scores), BLOCK):
        rows = slice(begin, begin + BLOCK)
        scores[rows] = scorer.score(cam_from_world[rows])
        yield
    return scores
