"""Views along a route: the best that a camera can turn to one after the other, and what the route then costs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.lattices import axes_of_angles
from wheretolook.geometry.poses import Float
from wheretolook.planning.config import PathConfig
from wheretolook.planning.sequences import TurnLimit, best_sequence
from wheretolook.planning.turns import pan_tilt_angles
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.utils.errors import PlanningError

LIMIT_STEP_DEG = 0.5
"""Limits on turns are rounded down to multiples of this, so that routes of about the same length share one."""


SHORT_ROUTE, SEARCH, IMPROVEMENT = "short route", "search", "improvement"
"""What finds paths: a short route with views chosen along it, the search over places and views, the improvement of
either."""


@dataclass(frozen=True, eq=False)
class PlannedPath:
    """A path of a camera, sampled at its corners and every `PathConfig.spacing_m` or a little less.

    Attributes:
        positions: (W, 3) world, metres.
        axes: (W, 3) unit optical axes in the world.
        scores: (W,) of the viewpoint map at the views, 0 where it knows nothing; NaN without a map.
        cost: of the path (`PathConfig`), its scores taken from view to view.
        found_by: `SHORT_ROUTE`, `SEARCH` or `IMPROVEMENT`; empty where it was not planned.
    """

    positions: Float
    axes: Float
    scores: Float
    cost: float
    found_by: str = ""

    @property
    def length_m(self) -> float:
        """Length of the path."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    @property
    def turn_deg(self) -> float:
        """By how much the camera turns on its way, in all."""
        cosines = (self.axes[1:] * self.axes[:-1]).sum(1).clip(-1, 1)
        return float(np.degrees(np.arccos(cosines)).sum())


@dataclass(frozen=True, eq=False)
class RouteSamples:
    """Where a route is looked from.

    Attributes:
        corners: (S,) arc lengths of its corners, metres.
        even: (E,) of even steps, no longer than the spacing.
        along: (W,) of both together: without its corners a path would lead through those of the walls.
        positions: (W, 3) at `along`.
    """

    corners: Float
    even: Float
    along: Float
    positions: Float

    @classmethod
    def of(cls, places: Float, spacing_m: float) -> RouteSamples:
        """Of a polyline (S, 3) m."""
        corners = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
        even = np.linspace(0, corners[-1], max(1, math.ceil(corners[-1] / spacing_m - 1e-9)) + 1)
        along = np.union1d(even, corners)
        along = along[np.append(True, np.diff(along) > 1e-9)]
        return cls(corners, even, along, between(corners, places, along))


class RouteViews:
    """Chooses the views along routes of one viewpoint map.

    Args:
        viewpoint_map: what views are worth, in [0, 1].
        config: costs and limits.
        start_axis: (3,) unit axis that every route starts with; None for any.
    """

    def __init__(self, viewpoint_map: ViewpointMap, config: PathConfig, start_axis: Float | None = None) -> None:
        self.map, self.config, self.start_axis = viewpoint_map, config, start_axis
        low, high = np.sin(np.radians(config.pitch_deg))
        height = viewpoint_map.directions[:, 2]
        self._inside = (height >= low) & (height <= high)
        best = viewpoint_map.scores[:, self._inside].max(axis=1, initial=0.0)
        self._best = np.append(best, 0.0)  # of each row, and of none
        self._limits: dict[int, TurnLimit] = {}

    def least_cost(self, places: Float) -> float:
        """What a route (S, 3) m would cost at least, could the camera look anywhere at once."""
        samples = RouteSamples.of(places, self.config.spacing_m)
        return self._cost(samples.positions, self._best[self.map.rows(samples.positions)])

    def best(self, places: Float) -> PlannedPath | None:
        """A route (S, 3) m with the views that have the greatest sum of scores, exactly; turns are evenly made.

        Returns:
            None where the map's directions are too coarse for so small turns.
        """
        samples = RouteSamples.of(places, self.config.spacing_m)
        at = between(samples.corners, places, samples.even)
        limit = self._limit(float(samples.even[-1]) / (len(samples.even) - 1))
        rows = self.map.rows(at)
        scores = np.where((rows >= 0)[:, None] & self._inside, self.map.scores[rows], 0.0)
        scores = np.where(self._inside, scores, -np.inf)
        try:
            if self.start_axis is None:
                axes = limit.directions[best_sequence(scores, limit).direction_ids]
            else:
                chosen = best_sequence(scores[1:], limit, self.start_axis).direction_ids
                axes = np.concatenate([self.start_axis[None], limit.directions[chosen]])
        except PlanningError:
            return None  # the lattice is too coarse for so small turns
        return self.costed(samples.positions, turned_evenly(samples.even, axes, samples.along))

    def costed(self, positions: Float, axes: Float) -> PlannedPath:
        """A path with its scores and what it costs."""
        rows, nearest = self.map.rows(positions), (axes @ self.map.directions.T).argmax(1)
        scores = np.where(rows >= 0, self.map.scores[rows, nearest], 0.0).astype(np.float64)
        path = PlannedPath(positions, axes, scores, 0.0)
        turning = self.config.turn_weight_m * math.radians(path.turn_deg)
        return replace(path, cost=turning + self._cost(positions, scores))

    def _cost(self, positions: Float, scores: NDArray[np.floating]) -> float:
        """Of length and scores."""
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        return float((steps * (1 + self.config.score_weight * (1 - (scores[1:] + scores[:-1]) / 2))).sum())

    def _limit(self, step_m: float) -> TurnLimit:
        number = int(self.config.max_turn_deg_per_m * step_m / LIMIT_STEP_DEG)
        if number not in self._limits:
            self._limits[number] = TurnLimit.of(self.map.directions, number * LIMIT_STEP_DEG, pan_tilt=True)
        return self._limits[number]


def between(knots: Float, values: Float, at: Float) -> Float:
    """Values (S, C) at knots (S,), linearly between them."""
    return np.column_stack([np.interp(at, knots, column) for column in values.T])


def turned_evenly(knots: Float, axes: Float, at: Float) -> Float:
    """Unit axes (S, 3) at knots (S,), yaw and pitch turning evenly between them.

    So the pitch stays between those at the knots; on a great circle it would rise above them.
    """
    yaw, pitch = pan_tilt_angles(axes)
    return axes_of_angles(np.degrees(between(knots, np.column_stack([np.unwrap(yaw), pitch]), at)))
