"""Views along a path: routes through a viewpoint map, with stops."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.lattices import axes_of_angles
from wheretolook.geometry.poses import Float, pan_tilt_angles, poses_looking_along
from wheretolook.geometry.views import Views
from wheretolook.planning.config import PathConfig
from wheretolook.planning.view_sequence import TurnLimit, best_sequence, between, lengths_along
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.utils.errors import PlanningError


@dataclass(frozen=True, eq=False)
class Stop:
    """A position of a path where the camera turns away from the path's view and back (`wheretolook.planning.stops`).

    Attributes:
        place: row in the path.
        axes: (K, 3) unit axes of the further looks in the world, in their order.
        scores: (K,) their single-view scores.
        together: probability that they and the path's view localize jointly.
        turn_deg: sum of the angles between the axes from the path's view to them and back.
    """

    place: int
    axes: Float
    scores: Float
    together: float
    turn_deg: float


@dataclass(frozen=True, eq=False)
class PlannedPath:
    """A path of a camera, sampled at its corners and every `PathConfig.spacing_m` or a little less.

    Attributes:
        positions: (W, 3) m, world.
        axes: (W, 3) unit optical axes.
        scores: (W,) from the viewpoint map, 0 outside its free voxels, NaN without a map; from `plan_by_methods` the
            scores of these exact poses.
        cost: see `PathConfig`, by the trapezoidal rule over the map's scores.
        found_by: "short route", with views chosen along it; "search" over positions and views; or "improvement" of
            either. Empty if the path was not planned.
        stops: in the order of the path, not part of the cost.
    """

    positions: Float
    axes: Float
    scores: Float
    cost: float
    found_by: str = ""
    stops: tuple[Stop, ...] = ()

    @property
    def length_m(self) -> float:
        """Length of the path."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    @property
    def turn_deg(self) -> float:
        """Sum of the angles between consecutive axes, including further looks at stops."""
        return turning_deg(self.axes) + sum(stop.turn_deg for stop in self.stops)

    @property
    def views(self) -> Views:
        """All L views in their order: those of the path, each followed by the further looks of a stop.

        `waypoint` is the row in the path, `rank` the number at that position, 1 for the path's own view; `score` is that
        of a view on its own, `set_score` the joint one of all views there. `all_axes` is in this order.
        """
        counts = np.ones(len(self.positions), dtype=np.int64)
        for stop in self.stops:
            counts[stop.place] += len(stop.axes)
        waypoint = np.repeat(np.arange(len(counts)), counts)
        return Views(
            poses_looking_along(self.positions[waypoint], self.all_axes),
            waypoint=waypoint,
            rank=np.arange(len(waypoint)) - np.repeat(np.cumsum(counts) - counts, counts) + 1,
            score=self._with_further(self.scores, [stop.scores for stop in self.stops]),
            set_score=self.scores_with_stops[waypoint],
        )

    @property
    def all_axes(self) -> Float:
        """Unit axes (L, 3) of all views."""
        return self._with_further(self.axes, [stop.axes for stop in self.stops])

    def _with_further(self, values: Float, further: list[Float]) -> Float:
        """Merge values (W, ...) of the path's views and of each stop's further looks; (L, ...)."""
        if not further:
            return values
        after = np.repeat([stop.place + 1 for stop in self.stops], [len(of_stop) for of_stop in further])
        return np.insert(values, after, np.concatenate(further), axis=0)

    @property
    def scores_with_stops(self) -> Float:
        """Scores (W,), at stops the joint ones of all looks."""
        scores = self.scores.copy()
        scores[[stop.place for stop in self.stops]] = [stop.together for stop in self.stops]
        return scores


@dataclass(frozen=True, eq=False)
class RouteSamples:
    """Points along a route, by arc length in metres: S corners, E even steps of at most the spacing, and both.

    `along` (W,) holds both, as a path sampled without its corners would cut through walls, and `positions` (W, 3) m the
    points there.
    """

    corners: Float
    even: Float
    along: Float
    positions: Float

    @classmethod
    def of(cls, places: Float, spacing_m: float) -> RouteSamples:
        """Sample a polyline (S, 3) m."""
        corners = lengths_along(places)
        even = np.linspace(0, corners[-1], max(1, math.ceil(corners[-1] / spacing_m - 1e-9)) + 1)
        along = np.union1d(even, corners)
        along = along[np.append(True, np.diff(along) > 1e-9)]
        return cls(corners, even, along, between(corners, places, along))


class RouteViews:
    """Chooses the views along routes by the scores, in [0, 1], of a viewpoint map.

    Every route starts with the unit axis `start_axis` (3,), if given.
    """

    def __init__(self, viewpoint_map: ViewpointMap, config: PathConfig, start_axis: Float | None = None) -> None:
        self.map = viewpoint_map
        self.config = config
        self.start_axis = start_axis
        low, high = np.sin(np.radians(config.pitch_deg))
        height = viewpoint_map.directions[:, 2]
        self._inside = (height >= low) & (height <= high)
        best = viewpoint_map.scores[:, self._inside].max(axis=1, initial=0.0)
        self._best = np.append(best, 0.0)  # best score of each row; the last entry is for row -1
        self._limits: dict[int, TurnLimit] = {}

    def least_cost(self, places: Float) -> float:
        """Compute a lower bound of the cost of a route (S, 3) m: the best view everywhere, and rotations for free."""
        samples = RouteSamples.of(places, self.config.spacing_m)
        return self._cost(samples.positions, self._best[self.map.rows(samples.positions)])

    def best(self, places: Float) -> PlannedPath | None:
        """Choose the views along a route (S, 3) m with the greatest sum of scores, exactly; rotations are spread evenly.

        None if the map's directions are too coarse for the limit on rotations.
        """
        samples = RouteSamples.of(places, self.config.spacing_m)
        at = between(samples.corners, places, samples.even)
        limit = self._limit(float(samples.even[-1]) / (len(samples.even) - 1))
        rows = self.map.rows(at)
        scores = np.where((rows >= 0)[:, None], self.map.scores[rows], 0.0)
        scores = np.where(self._inside, scores, -np.inf)
        try:
            if self.start_axis is None:
                axes = limit.directions[best_sequence(scores, limit).direction_ids]
            else:
                chosen = best_sequence(scores[1:], limit, self.start_axis).direction_ids
                axes = np.concatenate([self.start_axis[None], limit.directions[chosen]])
        except PlanningError:
            return None
        return self.costed(samples.positions, turned_evenly(samples.even, axes, samples.along))

    def costed(self, positions: Float, axes: Float) -> PlannedPath:
        """Return the path through positions (W, 3) m with axes (W, 3), with its scores and cost."""
        rows = self.map.rows(positions)
        nearest = (axes @ self.map.directions.T).argmax(1)
        scores = np.where(rows >= 0, self.map.scores[rows, nearest], 0.0).astype(np.float64)
        path = PlannedPath(positions, axes, scores, 0.0)
        turning = self.config.turn_weight_m * math.radians(path.turn_deg)
        return replace(path, cost=turning + self._cost(positions, scores))

    def _cost(self, positions: Float, scores: NDArray[np.floating]) -> float:
        """Compute the part of the cost that depends on length and scores."""
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        return float((steps * (1 + self.config.score_weight * (1 - (scores[1:] + scores[:-1]) / 2))).sum())

    def _limit(self, step_m: float) -> TurnLimit:
        # rounded down to half degrees, so that routes of similar spacing share a limit
        number = int(self.config.max_turn_deg_per_m * step_m / 0.5)
        if number not in self._limits:
            self._limits[number] = TurnLimit.of(self.map.directions, number * 0.5, pan_tilt=True)
        return self._limits[number]


def turning_deg(axes: Float) -> float:
    """Sum the angles between consecutive unit axes (W, 3)."""
    cosines = (axes[1:] * axes[:-1]).sum(1).clip(-1, 1)
    return float(np.degrees(np.arccos(cosines)).sum())


def turned_evenly(knots: Float, axes: Float, at: Float) -> Float:
    """Interpolate unit axes (S, 3) at knots (S,) linearly in yaw and pitch at (W,); (W, 3).

    The pitch thus stays between those at the knots, which it would not on a great circle.
    """
    yaw, pitch = pan_tilt_angles(axes)
    return axes_of_angles(np.degrees(between(knots, np.column_stack([np.unwrap(yaw), pitch]), at)))
