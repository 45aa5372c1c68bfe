"""What the viewer computes: scores of a floor, of all directions at a place, of one view; and where labels disagree."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float, poses_looking_along

if TYPE_CHECKING:
    import pandas as pd

    from wheretolook.scorers.base import Scorer, ViewReport
    from wheretolook.select.views import SelectedViews
    from wheretolook.select.where_to_look import WhereToLook

FLOOR_CELLS = 1200  # of a floor's rectangle, about
LEAST_CELL_M = 0.1
FLOOR_DIRECTIONS = 96
"""Directions looked along at each place of a floor, 19 degrees apart: the best of them is as good as the best of 500
to within a hundredth or two, and takes a third of the time."""

FIRST_PLACES = 12  # that are scored before a floor is drawn: fewer would say little of a house
VIEWS_AT_ONCE = 1 << 10  # labelled views scored between two looks at what else is to be done


@dataclass(eq=False)
class Floor:
    """Free places at one height, on a grid, and the best score at each as it comes in.

    `lower` (2,) and `cell_m` place the grid of `shape` (rows along y, columns along x); `cells` (K,) are flat indices
    of the free cells, each as far as can be from those before it; `ground_m` is the height of the ground below, where
    it is known; `scores` (K,) and the best direction's `axes` (K, 3) are NaN until computed.
    """

    height_m: float
    lower: Float
    cell_m: float
    shape: tuple[int, int]
    cells: NDArray[np.int64]
    ground_m: float | None = None
    scores: Float = field(init=False)
    axes: Float = field(init=False)
    n_scored: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self.scores, self.axes = np.full(len(self.cells), np.nan), np.full((len(self.cells), 3), np.nan)

    @property
    def points(self) -> Float:
        """Centres of the free cells (K, 3), metres."""
        rows, columns = np.divmod(self.cells, self.shape[1])
        xy = self.lower + (np.stack([columns, rows], axis=1) + 0.5) * self.cell_m
        return np.column_stack([xy, np.full(len(xy), self.height_m)])

    @property
    def done(self) -> bool:
        """Whether all places are scored."""
        return self.n_scored == len(self.cells)

    @property
    def n_first(self) -> int:
        """How many places are scored first, all over the floor: with them all of it has a colour."""
        return min(FIRST_PLACES, len(self.cells))

    def score_next(self, look: WhereToLook, n: int = 1) -> bool:
        """Score the next n places in the directions of `look`. Returns whether any were left."""
        rows = slice(self.n_scored, min(self.n_scored + n, len(self.cells)))
        if rows.start == rows.stop:
            return False
        axes = look.directions
        found = look.scorer.score_around(self.points[rows], axes)
        best = found.argmax(axis=1)
        self.scores[rows] = found.max(axis=1)
        self.axes[rows] = axes[best]
        self.n_scored = rows.stop
        return True

    def raster(self) -> Float:
        """Scores (rows, columns); NaN where a camera cannot be. A place not yet scored has the nearest one's."""
        values = np.full(self.shape[0] * self.shape[1], np.nan)
        if self.n_scored:
            from scipy.spatial import cKDTree

            at = self.points
            _, nearest = cKDTree(at[: self.n_scored]).query(at)
            values[self.cells] = self.scores[nearest]
        return values.reshape(self.shape)


def floor_at(space: Any, hides: Any, height_m: float) -> Floor:
    """The free places at a height, of a `space` with `bounds` and `is_free`, none inside geometry of the occlusion."""
    (x0, y0, _), (x1, y1, _) = np.asarray(space.bounds, dtype=np.float64)
    cell = max(LEAST_CELL_M, float(np.sqrt((x1 - x0) * (y1 - y0) / FLOOR_CELLS)))
    columns = max(1, ceil((x1 - x0) / cell))
    rows = max(1, ceil((y1 - y0) / cell))
    lower = np.array([(x0 + x1) / 2 - columns * cell / 2, (y0 + y1) / 2 - rows * cell / 2])
    floor = Floor(height_m, lower, cell, (rows, columns), np.arange(rows * columns))
    free = space.is_free(floor.points)
    free[free] = ~hides.inside_geometry(floor.points[free])
    cells = np.flatnonzero(free)
    order = farthest_first(np.stack(np.divmod(cells, columns), axis=1))
    ground = None
    if len(cells) and hasattr(space, "floor_below"):
        ground = float(np.median(space.floor_below(floor.points[cells])))
    return Floor(height_m, lower, cell, (rows, columns), cells[order], ground)


def farthest_first(at: NDArray[np.int64]) -> NDArray[np.int64]:
    """An order (K,) of places (K, 2), each the farthest from all before it, from one in the middle on.

    However many of them are taken, no place is more than twice as far from these as it would be from the best choice
    of as many (Gonzalez, "Clustering to minimize the maximum intercluster distance", 1985).
    """
    order = np.zeros(len(at), dtype=np.int64)
    away = -((at - at.mean(axis=0)) ** 2).sum(1) if len(at) else np.empty(0)
    for k in range(len(at)):
        order[k] = away.argmax()
        to_it = ((at - at[order[k]]) ** 2).sum(1)
        away = to_it if k == 0 else np.minimum(away, to_it)
        away[order[k]] = -1
    return order


def heights_of(space: Any, centers: Float) -> tuple[float, float, float]:
    """Lowest and highest height a camera may be at, and where it usually was when it mapped; metres."""
    low, high = (float(z) for z in np.asarray(space.bounds)[:, 2])
    usual = float(np.median(centers[:, 2])) if len(centers) else (low + high) / 2
    return low, high, min(max(usual, low), high)


@dataclass(frozen=True, eq=False)
class Place:
    """What is known of a place: the score of each direction, and the best views."""

    position: Float  # (3,) metres
    directions: Float  # (D, 3) unit optical axes
    scores: Float  # (D,)
    best: SelectedViews  # the N best views, the best first


def look_around(look: WhereToLook, position: Float, n: int) -> Place:
    """Score all directions at a place, and find the n best views, those that `wheretolook select` gives.

    Raises a TableError if the place is outside the map or inside geometry.
    """
    best = look.best(np.asarray(position, dtype=np.float64)[None], n)
    scores = look.scorer.score_around(np.asarray(position, dtype=np.float64)[None], look.directions)[0]
    return Place(np.asarray(position, dtype=np.float64), look.directions, scores, best)


def report_of(scorer: Scorer, position: Float, axis: Float) -> ViewReport:
    """What there is to know of one view of a camera without roll; arrays of length 1. PoseError if it is none."""
    return scorer.report(poses_looking_along(np.asarray(position)[None], np.asarray(axis)[None]))


@dataclass(frozen=True, eq=False)
class SeenLandmarks:
    """The K landmarks that a view sees."""

    points: Float  # (K, 3) metres
    pixels: Float  # (K, 2)
    chances: Float  # (K,) of being found; NaN where nothing tells them


def landmarks_seen(scorer: Scorer, pose: Float, teller: Scorer | None = None) -> SeenLandmarks:
    """The landmarks a view (3, 4) sees, with their chances of being found by the scorer, or by another one."""
    known = scorer.landmark_probabilities(pose[None])
    if known is None and teller is not None:
        known = teller.landmark_probabilities(pose[None])
    around = scorer.localization_map
    rows = around.landmarks_in_view(pose[None])[0].astype(np.int64) if known is None else known.rows
    points = around.landmarks.points[rows]
    p_detect = np.full(len(rows), np.nan) if known is None else known.p_detect
    return SeenLandmarks(points, around.camera.project(points @ pose[:, :3].T + pose[:, 3]), p_detect)


@dataclass(frozen=True, eq=False)
class JudgedLabels:
    """Labelled views, and what the method said of them."""

    positions: Float  # (B, 3) metres
    axes: Float  # (B, 3)
    good: NDArray[np.bool_]  # whether the view localized
    scores: Float  # (B,)
    threshold: float

    @property
    def promised(self) -> NDArray[np.bool_]:
        """Views said to localize, that did not (B,)."""
        return (self.scores >= self.threshold) & ~self.good

    @property
    def missed(self) -> NDArray[np.bool_]:
        """Views said not to localize, that did (B,)."""
        return (self.scores < self.threshold) & self.good


def judged_labels(
    scorer: Scorer, table: pd.DataFrame, limits: tuple[float, float], threshold: float
) -> Generator[None, None, JudgedLabels]:
    """Score labelled viewpoints, a block at each step. The generator returns what came of it.

    A view is good if it localized with errors below limits in metres and degrees.
    """
    from wheretolook.dataset.viewpoint_table import is_good, poses

    cam_from_world = poses(table)
    scores = np.empty(len(cam_from_world))
    for begin in range(0, len(scores), VIEWS_AT_ONCE):
        rows = slice(begin, begin + VIEWS_AT_ONCE)
        scores[rows] = scorer.score(cam_from_world[rows])
        yield None
    positions = -(np.swapaxes(cam_from_world[..., :3], 1, 2) @ cam_from_world[..., 3:])[..., 0]
    return JudgedLabels(positions, cam_from_world[:, 2, :3], is_good(table, *limits), scores, threshold)
