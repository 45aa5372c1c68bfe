"""Select views at waypoints: the best ones, sets that localize jointly, or a sequence with stops."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from tqdm.auto import tqdm

from wheretolook.geometry.poses import Float, camera_centers, pan_tilt_angles, poses_looking_along
from wheretolook.geometry.views import Views
from wheretolook.inputs.landmark_features import ReasonCounter
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.looks.selection import best_views, separated
from wheretolook.planning.config import StopConfig
from wheretolook.planning.routes import PlannedPath
from wheretolook.planning.stops import stops_along
from wheretolook.planning.view_sequence import TurnLimit, best_sequence
from wheretolook.scorers.base import Scorer
from wheretolook.select.waypoints import SelectionRequest, Waypoints
from wheretolook.utils.errors import ConfigError, TableError


def select_views(
    scorer: Scorer,
    reasons: ReasonCounter,
    directions: Float,
    waypoints: Waypoints,
    request: SelectionRequest,
    progress: bool = False,
) -> Views:
    """Select views along some of directions (D, 3), unit vectors in the world, at waypoints in the map's own frame.

    Returns the views in that frame, with the scorer's report and the counts of `reasons`. Raises as
    `wheretolook.select.where_to_look.WhereToLook.best`.
    """
    axes = _within_pitch(directions, request)
    localization_map = scorer.localization_map
    world_from_map = localization_map.frame.world_from_map
    rows = np.flatnonzero(usable_waypoints(localization_map, waypoints, request.skip))
    waypoints = waypoints[rows]
    allowed = _within_pan(axes, waypoints, world_from_map.rotation, request)
    waypoints = replace(waypoints, points=world_from_map.apply(waypoints.points))
    scores = _scores(scorer, waypoints.points, axes, progress)
    candidates = ScoredDirections(scorer, waypoints, axes, np.where(allowed, scores, -np.inf))
    if request.looks is None:
        views = candidates.best(request)
    elif request.least_score is None:
        views = candidates.best_sets(request.looks, request.max_total_turn_deg, progress)
    else:
        views = candidates.sequence_with_stops(request, progress)
    if request.sigma_m or request.yaw_sigma_deg:
        prior = PoseUncertainty(request.sigma_m or 0.0, request.yaw_sigma_deg or 0.0)
        views = prior.with_expected_scores(views, candidates, progress)
    return with_reasons(reasons, replace(views, waypoint=rows[views.waypoint])).in_frame(localization_map.frame)


def usable_waypoints(localization_map: LocalizationMap, waypoints: Waypoints, skip: bool = False) -> NDArray[np.bool_]:
    """Return at which waypoints views can be scored, (W,): at all of them, unless `skip` leaves others out.

    A waypoint is outside the map if it is farther from every landmark, and from every mapping camera, than all but 5 %
    of the landmarks were from the cameras that mapped them. Raises a TableError that names the first of those outside
    the map or inside geometry, or if none is left.
    """
    landmarks = localization_map.landmarks
    world_from_map = localization_map.frame.world_from_map
    points = world_from_map.apply(waypoints.points)
    reach = float(np.quantile(landmarks.mapping_distance_m, 0.95))
    to_landmark = cKDTree(landmarks.points).query(points)[0]
    nearest: Float = to_landmark
    if localization_map.mapping_poses is not None:
        centers = camera_centers(localization_map.mapping_poses.astype(np.float64))
        nearest = np.minimum(nearest, cKDTree(centers).query(points)[0])
    outside = nearest > reach
    inside = ~outside & (to_landmark <= 1e-6)  # landmarks are on surfaces
    rest = np.flatnonzero(~outside & ~inside)
    inside[rest] = localization_map.occlusion.inside_geometry(points[rest])
    bad = outside | inside
    if not bad.any() or (skip and not bad.all()):
        return np.asarray(~bad)
    problems = []
    for row in np.flatnonzero(bad)[:5]:
        why = (
            f"{nearest[row] / world_from_map.scale:.3g} from all landmarks and cameras"
            if outside[row]
            else "inside geometry"
        )
        problems.append(f"{waypoints.where(row)} {why}")
    low, high = np.quantile(world_from_map.inverse.apply(landmarks.points), (0.01, 0.99), axis=0).round(1).tolist()
    fix = f"The map's landmarks are within {low} to {high}, in its unit: check unit and axes"
    fix += "." if bad.all() else ", or leave these out: --skip, in Python skip=True."
    problem = f"{bad.sum()} of {len(waypoints)} waypoints are outside the map or inside geometry"
    raise TableError(problem, path=waypoints.path, value="; ".join(problems), fix=fix)


def _within_pitch(directions: Float, request: SelectionRequest) -> Float:
    """Return the directions within the limit on pitch. Raises ConfigError if they are too few."""
    low, high = request.pitch_deg or (-90.0, 90.0)
    pitch = np.degrees(pan_tilt_angles(directions)[1])
    axes = directions[(pitch >= low - 1e-9) & (pitch <= high + 1e-9)]
    needed = request.looks or request.n
    if len(axes) < needed:
        fix = "Ask for fewer views, score more directions, or widen the limit on pitch."
        raise ConfigError("there are fewer directions than views", value=f"{len(axes)} for {needed}", fix=fix)
    return axes


def _within_pan(
    axes: Float, waypoints: Waypoints, world_from_map: Float, request: SelectionRequest
) -> NDArray[np.bool_]:
    """Return which of axes (D, 3) are within the limit on pan, (W, D), by the rotation (3, 3) to the world."""
    if request.pan_deg is None:
        return np.ones((len(waypoints), len(axes)), dtype=bool)
    pan = np.degrees(pan_tilt_angles(axes)[0]) - waypoints.heading_deg(world_from_map)[:, None]
    low, high = request.pan_deg
    tolerance = 1e-9
    return np.asarray((pan - low + tolerance) % 360 <= high - low + 2 * tolerance)


def _scores(scorer: Scorer, locations: Float, axes: Float, progress: bool) -> Float:
    """Score all directions (D, 3) at locations (L, 3), (L, D)."""
    on_cpu = scorer.localization_map.device == "cpu"
    step = max(1, (1 << 13 if on_cpu else 1 << 17) // len(axes))  # of the progress bar
    scores = np.empty((len(locations), len(axes)))
    with tqdm(total=len(locations), desc="score", unit="waypoint", disable=not progress) as bar:
        for begin in range(0, len(locations), step):
            block = locations[begin : begin + step]
            scores[begin : begin + step] = scorer.score_directions(block, axes)
            bar.update(len(block))
    return scores


@dataclass(frozen=True, eq=False)
class ScoredDirections:
    """Directions at W waypoints, whose points are in the world, and their scores.

    `axes` (D, 3) are unit vectors in the world, `scores` (W, D) of views along them; -inf where one is not allowed.
    """

    scorer: Scorer
    waypoints: Waypoints
    axes: Float
    scores: Float

    def best(self, request: SelectionRequest) -> Views:
        """Select the n best views at each waypoint, or the best sequence."""
        if request.max_turn_deg is not None:
            chosen = self._sequence(request.max_turn_deg)[:, None]
        elif request.apart_deg is not None or request.pan_deg is not None:
            chosen = self._separate(request)
        else:
            # Where many landmarks are in view, the scores of all directions are of other samples of them; so those of a
            # few more views are computed again.
            chosen = np.argsort(-self.scores, axis=1, kind="stable")[:, : request.n + 3]
        n, k = chosen.shape
        poses = poses_looking_along(self.waypoints.points[:, None], self.axes[chosen]).reshape(-1, 3, 4)
        views = reported(self.scorer, self.waypoints, np.repeat(np.arange(n), k), poses)
        order = np.argsort(-views.score.reshape(-1, k), axis=1, kind="stable")[:, : request.n]
        best = views[(np.arange(n)[:, None] * k + order).ravel()]
        return replace(best, rank=np.tile(np.arange(1, order.shape[1] + 1), n))

    def best_sets(self, n: int, max_turn_deg: float | None, progress: bool) -> Views:
        """Select the n views at each waypoint with the best joint score."""
        chosen = []
        set_scores = []
        points = tqdm(self.waypoints.points, desc="looks", unit="waypoint", disable=not progress)
        for point, scores in zip(points, self.scores, strict=True):
            choice = self.axes[np.isfinite(scores)]
            best = best_views(self.scorer, point, choice, scores[np.isfinite(scores)], n, max_turn_deg)
            chosen.extend(choice[[*best.rows]])
            set_scores.append(best.score)
        rows = np.repeat(np.arange(len(set_scores)), n)
        poses = poses_looking_along(self.waypoints.points[rows], np.array(chosen))
        views = reported(self.scorer, self.waypoints, rows, poses)
        return replace(views, rank=np.tile(np.arange(1, n + 1), len(set_scores)), set_score=np.repeat(set_scores, n))

    def sequence_with_stops(self, request: SelectionRequest, progress: bool) -> Views:
        """Select the best sequence, with further looks where it scores too little."""
        assert request.looks is not None and request.max_turn_deg is not None and request.least_score is not None
        points = self.waypoints.points
        chosen = self.axes[self._sequence(request.max_turn_deg)]
        config = StopConfig(request.looks, request.least_score)
        allowed = np.isfinite(self.scores)
        text = "stops" if progress else None
        stops = stops_along(self.scorer, points, chosen, self.axes, config, progress=text, allowed=allowed)
        scores = self.scorer.score(poses_looking_along(points, chosen))
        path = PlannedPath(points, chosen, scores, np.nan, stops=stops).views
        views = reported(self.scorer, self.waypoints, path.waypoint, path.cam_from_world)
        return replace(views, rank=path.rank, set_score=path.set_score)

    def _sequence(self, max_turn_deg: float) -> NDArray[np.int64]:
        """Return the rows (W,) of axes with the greatest sum of scores within a limit on turns.

        Raises ConfigError if the limit allows no turn and seems to be in radians.
        """
        limit = TurnLimit.of(self.axes, max_turn_deg)
        if 0 < max_turn_deg <= np.pi and limit.neighbours.shape[1] == 1 < len(self.axes):
            problem = "max_turn_deg is in degrees, and less than the angle between any two directions"
            fix = "Convert radians; else score more directions, or give 0."
            raise ConfigError(problem, value=max_turn_deg, fix=fix)
        return best_sequence(self.scores, limit).direction_ids

    def _separate(self, request: SelectionRequest) -> NDArray[np.int64]:
        """Return the rows (W, n) of axes with the best scores that are allowed and far enough from one another.

        Raises ConfigError, which names the waypoint, if there are fewer.
        """
        chosen = []
        for row, scores in enumerate(self.scores):
            order = np.argsort(-scores, kind="stable")[: np.isfinite(scores).sum()]
            chosen.append(separated(self.axes, order, request.n, request.apart_deg or 0))
            if len(chosen[-1]) < request.n:
                problem = f"{self.waypoints.label(row)} has too few views within the limits"
                value = f"{len(chosen[-1])} of {request.n}"
                fix = "Ask for fewer views, score more directions, or widen the limits."
                raise ConfigError(problem, path=self.waypoints.path, value=value, fix=fix)
        return np.array(chosen)


def reported(scorer: Scorer, waypoints: Waypoints, rows: NDArray[np.int64], poses: Float) -> Views:
    """Return the scorer's report of poses (V, 3, 4) in the world, at the waypoints of rows (V,), each of rank 1."""
    step = _views_at_once(scorer) * max(1, len(rows) // max(1, len(waypoints)))
    views = Views.concatenate(scorer.report(poses[begin : begin + step]) for begin in range(0, len(poses), step))
    ids = tuple(waypoints.ids[row] for row in rows)
    read_as = (waypoints.read_as,) * len(rows) if waypoints.read_as else None
    return replace(views, waypoint=rows, waypoint_id=ids, read_as=read_as, rank=np.ones_like(rows))


def with_reasons(reasons: ReasonCounter, views: Views) -> Views:
    """Return views in the world with the numbers of landmarks that are hard to match."""
    step = _views_at_once(reasons)
    poses = views.cam_from_world
    counts = Views.concatenate(reasons.count(poses[begin : begin + step]) for begin in range(0, len(poses), step))
    return replace(views, **counts.columns)


def _views_at_once(of_map: Scorer | ReasonCounter) -> int:
    return max(1, (1 << 24) // max(1, len(of_map.localization_map.landmarks)))  # lines of sight tested at once


@dataclass(frozen=True)
class PoseUncertainty:
    """Gaussian uncertainty of a robot's pose: of x and y each in metres, and of yaw in degrees; height is known."""

    sigma_m: float
    yaw_sigma_deg: float

    def draws(self) -> tuple[Float, Float]:
        """Return errors of position (32, 3) m and rotations about the vertical (32, 3, 3), in the world.

        They are the same at each waypoint.
        """
        normal = np.random.default_rng(0).standard_normal((32, 3))
        offsets = normal * (self.sigma_m, self.sigma_m, 0.0)
        yaw = np.radians(self.yaw_sigma_deg) * normal[:, 2]
        rotations = np.tile(np.eye(3), (len(normal), 1, 1))
        rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(yaw)
        rotations[:, 1, 0] = np.sin(yaw)
        rotations[:, 0, 1] = -rotations[:, 1, 0]
        return offsets, rotations

    def with_expected_scores(self, views: Views, candidates: ScoredDirections, progress: bool = False) -> Views:
        """Return views in the world with their expected scores, and the highest ones of all candidates there.

        They are means over draws of the true pose outside geometry, while the robot turns by its estimate; of the
        candidates, the 60 with the best scores are compared.
        """
        scorer = candidates.scorer
        points = candidates.waypoints.points
        compared = candidates.scores >= -np.sort(-candidates.scores, axis=1)[:, :60][:, -1:]
        compared &= np.isfinite(candidates.scores)
        expected = np.empty(len(views))
        best = np.empty(len(views))
        offsets, rotations = self.draws()
        for row in tqdm(range(len(points)), desc="prior", unit="waypoint", disable=not progress):
            here = np.flatnonzero(views.waypoint == row)
            directions = np.concatenate([views.axes[here], candidates.axes[compared[row]]])
            at = points[row] + offsets
            free = ~scorer.localization_map.occlusion.inside_geometry(at)
            free |= ~free.any()
            scores = []
            for point, turn in zip(at[free], rotations[free], strict=True):
                scores.append(scorer.score_directions(point[None], directions @ turn.T)[0])
            mean = np.mean(scores, axis=0)
            expected[here] = mean[: len(here)]
            best[here] = mean.max()
        return replace(views, expected_score=expected, best_expected_score=best)
