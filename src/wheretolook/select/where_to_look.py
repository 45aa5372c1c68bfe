"""Which views are asked for: how many, within which pitch, and how far the camera may turn."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm.auto import tqdm

from wheretolook.dataset.config import ACCURACY, Accuracy
from wheretolook.dataset.scene import ColmapFiles, Scene, SceneConfig
from wheretolook.geometry.camera import Camera, PinholeCamera, parse_camera
from wheretolook.geometry.camera_turns import pan_tilt_angles
from wheretolook.geometry.lattices import Lattice, direction_lattice
from wheretolook.geometry.poses import Float, camera_centers, poses_looking_along, rigid_poses
from wheretolook.geometry.views import Views
from wheretolook.inputs.landmark_features import ReasonCounter
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.looks.next_look import NextLook, NextLookSelector, mean_scores_by_pitch
from wheretolook.looks.selection import best_views, separated
from wheretolook.mapping.config import FrameOptions
from wheretolook.mapping.map_frame import MapFrame
from wheretolook.planning.config import StopConfig
from wheretolook.planning.routes import PlannedPath
from wheretolook.planning.stops import stops_along
from wheretolook.planning.view_sequence import TurnLimit, best_sequence
from wheretolook.scorers.base import Scorer
from wheretolook.select.waypoints import SelectionRequest, Waypoints, grid_waypoints, usable_waypoints
from wheretolook.space.mapped_space import MappedSpace
from wheretolook.utils.devices import usable_device
from wheretolook.utils.errors import ConfigError, PlanningError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from wheretolook.select.image_localizer import Image, ImageLocalizer
    from wheretolook.select.localized import Localized


DRAWS = 32  # of the true pose, the same at each waypoint
ALTERNATIVES = 60  # directions with the best scores, which are compared


@dataclass(frozen=True)
class PoseUncertainty:
    """Gaussian uncertainty of a robot's pose: of x and y each in metres, and of yaw in degrees; height is known."""

    sigma_m: float
    yaw_sigma_deg: float

    def draws(self) -> tuple[Float, Float]:
        """Return errors of position (DRAWS, 3) m and rotations about the vertical (DRAWS, 3, 3), in the world."""
        normal = np.random.default_rng(0).standard_normal((DRAWS, 3))
        offsets = normal * (self.sigma_m, self.sigma_m, 0.0)
        yaw = np.radians(self.yaw_sigma_deg) * normal[:, 2]
        rotations = np.tile(np.eye(3), (DRAWS, 1, 1))
        rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(yaw)
        rotations[:, 1, 0] = np.sin(yaw)
        rotations[:, 0, 1] = -rotations[:, 1, 0]
        return offsets, rotations

    def expected_scores(
        self,
        scorer: Scorer,
        points: Float,
        axes: Float,
        allowed: NDArray[np.bool_],
        chosen: tuple[NDArray[np.int64], Float],
        progress: bool = False,
    ) -> tuple[Float, Float]:
        """Compute mean scores over draws of the true pose outside geometry, while the robot turns by its estimate.

        Args:
            scorer: scores views.
            points: (W, 3) m, estimated locations in the world.
            axes: (D, 3) directions scored at each.
            allowed: (W, D) those that are compared.
            chosen: rows of points (V,), and optical axes (V, 3), of the selected views.
            progress: show a bar.

        Returns:
            (V,) of each selected view, and (V,) the highest of all compared directions at its location.
        """
        of_view, view_axes = chosen
        expected, best = np.empty(len(of_view)), np.empty(len(of_view))
        offsets, rotations = self.draws()
        for row in tqdm(range(len(points)), desc="prior", unit="waypoint", disable=not progress):
            views = np.flatnonzero(of_view == row)
            directions = np.concatenate([view_axes[views], axes[allowed[row]]])
            at = points[row] + offsets
            free = ~scorer.localization_map.occlusion.inside_geometry(at)
            free |= ~free.any()
            pairs = zip(at[free], rotations[free], strict=True)
            scores = [scorer.score_directions(point[None], directions @ turn.T)[0] for point, turn in pairs]
            mean = np.mean(scores, axis=0)
            expected[views], best[views] = mean[: len(views)], mean.max()
        return expected, best


VIEWS_PER_STEP = {"cpu": 1 << 13, "cuda": 1 << 17}  # of the progress bar, in whole waypoints

SPARE = 3
"""Views of a waypoint, beyond those asked for, whose scores are computed again: where many landmarks are in view, the
scores of all directions are computed from other samples of them."""

CONFIG = SceneConfig(occlusion_cache_bytes=1 << 30)

PAN_TOLERANCE_DEG = 1e-9
SIGHT_LINES = 1 << 24  # lines of sight tested at once


class WhereToLook:
    """Scores views of a map, and selects the best ones at any location.

        look = WhereToLook.from_colmap("sparse/0")
        views = look.best([(1.0, 2.0, 1.5), (1.2, 2.0, 1.5)])
        views.save("views.csv")

    Locations, poses and views are in the map's own frame and unit, `frame`. `scorer` is any method on a localization
    map; `directions` (D, 3) are the optical axes that are scored at each location, in the world (z up); cameras do not
    roll. `space` is where a camera can be in the world, for grids; None for the space near the mapping cameras.
    """

    def __init__(
        self, scorer: Scorer, directions: ArrayLike | None = None, space: Any = None, files: ColmapFiles | None = None
    ) -> None:
        self.scorer = scorer
        self._space = space
        self._files = files
        axes = direction_lattice(500) if directions is None else np.asarray(directions, dtype=np.float64)
        self.directions = axes / np.linalg.norm(axes, axis=1, keepdims=True)

    @classmethod
    def from_colmap(
        cls,
        path: str | Path,
        *,
        weights: str | Path | None = None,
        method: str = "",
        camera: Camera | str | int | None = None,
        fov_deg: float | None = None,
        mesh: str | Path | None = None,
        depth: str | Path | None = None,
        depth_scale: float = 1000.0,
        occlusion: str | None = None,
        database: str | Path | None = None,
        directions: int = 500,
        lattice: Lattice = "fibonacci",
        max_reprojection_error_px: float | None = None,
        device: str = "auto",
        anywhere: bool = False,
        **frame: Any,
    ) -> WhereToLook:
        """Open any COLMAP model (binary or text), of any unit and direction up.

        A `MapWarning` states what was assumed of an unknown unit or direction up.

        Args:
            path: folder of the model.
            weights: file or folder of weights; None for the bundled ones.
            method: name of a method, such as "set" or "visible"; "" for that of the weights.
            camera: the camera of the views: a camera, a text such as "PINHOLE,640,480,320,320,320,240", or the
                camera_id of one of the model. None for the model's own.
            fov_deg: instead, a pinhole of that horizontal field of view in degrees, of 640 x 480 px.
            mesh: mesh of the scene in the map's frame, for true occlusion.
            depth: folder of depth images of the model's images, for occlusion by the surface they fuse to.
            depth_scale: units of integer depth images in a metre.
            occlusion: "mesh", "tsdf" (depth images), "hidden-points" (from the landmarks alone) or "none" (landmarks
                are visible through walls); None for the first of these that there is data for.
            database: the model's database, for descriptors and so the landmarks' ambiguity.
            directions: number of directions that are scored at each location.
            lattice: how they are distributed: "fibonacci" evenly; "yaw-pitch" 6 pitches x 18 yaws as in ActLoc.
            max_reprojection_error_px: landmarks with a larger mean error are dropped; None for the map's own default.
            device: "auto" for a GPU if there is one, "cpu", or "cuda:0".
            anywhere: whether weights that are adapted to another scene may score in this one.
            frame: scale, distance, positions or up, see `wheretolook.mapping.config.FrameOptions`.

        Raises:
            MapError, SceneError: the model or database, the mesh or depth images cannot be used.
            WeightsError: the weights cannot be used, or there are none.
            ConfigError: no such method, camera, occlusion, lattice or device.
        """
        from wheretolook.scorers.registry import make_scorer
        from wheretolook.scorers.weights import load_scorer, resolve_weights

        device = usable_device(device)
        camera = _described_camera(camera, fov_deg)
        axes = direction_lattice(directions, lattice)
        resolve_weights(method, weights)  # so that missing ones are reported before anything is read
        mesh, depth, database = (None if file is None else Path(file) for file in (mesh, depth, database))
        options = FrameOptions(**frame)
        files = ColmapFiles(Path(path), mesh, depth, depth_scale, database, max_reprojection_error_px, options)
        scene = Scene.of_colmap(files, camera, occlusion, CONFIG, device)
        here = scene.localization_map
        weights = resolve_weights(method, weights, here.landmarks.features)
        if not method:
            return cls(load_scorer(here, weights, anywhere), axes, scene.space, files)
        return cls(make_scorer(method, here, weights=weights, anywhere=anywhere), axes, scene.space, files)

    @property
    def localization_map(self) -> LocalizationMap:
        """The map, with the camera of the views and the occlusion model."""
        return self.scorer.localization_map

    @property
    def frame(self) -> MapFrame:
        """The map's own frame: its unit and direction up, and how they are known."""
        return self.localization_map.frame

    def localize(
        self,
        images: Image | Sequence[Image],
        turns: str | Path | ArrayLike | None = None,
        camera: Camera | str | int | None = None,
        prior: Sequence[float] | None = None,
        accuracy: Accuracy = ACCURACY,
    ) -> Localized:
        """Localize an image, or several from one location with `turns`, in the map; needs its descriptors.

        Args:
            images: files, or arrays (H, W, 3) uint8 RGB.
            turns: rotations `cam_from_rig` (N, 3, 3) of several images, or a file of them.
            camera: of the images, or its camera_id in the model; None for the model's, or a pinhole of the EXIF focal
                length.
            prior: rough x, y, z of the camera, and perhaps yaw in degrees: one more hypothesis.
            accuracy: limits in metres and degrees that the probability refers to.

        Raises errors as `wheretolook.select.image_localizer.ImageLocalizer.open` and `.localize`.
        """
        camera = parse_camera(camera) if isinstance(camera, str) else camera
        return self._localizer.localize(images, turns, camera, prior, accuracy)

    def next_look(
        self,
        result: Localized,
        pitch_deg: tuple[float, float] = (-45.0, 45.0),
        pan_deg: tuple[float, float] | None = None,
        up: ArrayLike | None = None,
    ) -> NextLook:
        """Select where a camera that turns in place looks next, given the result of `localize` for all views so far.

        Args:
            result: of one image or several from one location.
            pitch_deg: lowest and highest pitch.
            pan_deg: lowest and highest pan, to the left from the first view; None for any.
            up: direction up (3,) in the rig, the frame of the given turns; by default see `NextLookSelector.select`.

        Raises PlanningError if the limits leave no new view, or nothing was localized.
        """
        if result.joint is None:
            raise PlanningError("without matches no next view can be selected", value=result.names)
        return self._next_look_selector.select(result.joint, up, pitch_deg, pan_deg)

    @cached_property
    def _next_look_selector(self) -> NextLookSelector:
        return NextLookSelector(self.scorer, mean_scores_by_pitch(self.scorer))

    @cached_property
    def _localizer(self) -> ImageLocalizer:
        from wheretolook.select.image_localizer import ImageLocalizer

        if self._files is None:
            raise ConfigError("only a map opened by from_colmap localizes images")
        files = self._files
        return ImageLocalizer.open(files.model, files.database, files.frame, device=self.localization_map.device)

    @property
    def space(self) -> Any:
        """Where a camera can be in the world, by mesh, depth images, or the map only."""
        if self._space is None:
            poses = self.localization_map.mapping_poses
            assert poses is not None
            self._space = MappedSpace(self.localization_map.landmarks.points, camera_centers(poses.astype(np.float64)))
        return self._space

    def grid(self, spacing_m: float) -> Waypoints:
        """Return waypoints so many metres apart in all free space. Raises ConfigError or SceneError if none."""
        grid = grid_waypoints(self.localization_map, self.space, spacing_m)
        return replace(grid, points=self.frame.world_from_map.inverse.apply(grid.points))

    def at_accuracy(self, accuracy: Accuracy) -> WhereToLook:
        """Return the same whose scores are probabilities of errors within limits in metres and degrees: (0.25, 2).

        Raises a ConfigError as `wheretolook.scorers.base.Scorer.at_accuracy`.
        """
        look = copy(self)
        look.scorer = self.scorer.at_accuracy(accuracy)
        return look

    def score(self, cam_from_world: ArrayLike) -> Float:
        """Score poses (B, 3, 4) or (B, 4, 4), or one of them, world-to-camera, (B,).

        Higher is better, of learned methods a probability. Raises PoseError if a pose is no rigid transform.
        """
        return self.scorer.score(self.frame.world_from_map.apply_to_poses(rigid_poses(cam_from_world)))

    def report(self, cam_from_world: ArrayLike, names: Sequence[str] = (), skip: bool = False) -> Views:
        """Score poses, as `score` takes them, and report each as a view; names count from 0 unless given.

        Raises a PoseError as `score`, and a TableError if one is outside the map or inside geometry, unless `skip`
        leaves those out.
        """
        poses = rigid_poses(cam_from_world)
        waypoints = Waypoints.of(camera_centers(poses), names)
        rows = np.flatnonzero(usable_waypoints(self.localization_map, waypoints, skip))
        poses = self.frame.world_from_map.apply_to_poses(poses[rows])
        return self._explained(self._reported(waypoints, rows, poses))

    def best(
        self,
        points: ArrayLike | Waypoints,
        n: int = 1,
        *,
        ids: Sequence[str] = (),
        heading_deg: ArrayLike | None = None,
        progress: bool = False,
        accuracy: Accuracy | None = None,
        **options: Any,
    ) -> Views:
        """Select the best view, the n best, or the best set of views, at each of points (W, 3) of the map.

        Args:
            points: locations of the camera.
            n: number of views of each point.
            ids: names of the points; counts from 0 unless given.
            heading_deg: yaws (W,) of the robot at the points, for a limit on pan.
            progress: show a progress bar.
            accuracy: limits of the errors that the scores refer to, see `at_accuracy`.
            options: further fields of `wheretolook.select.where_to_look.SelectionRequest`. With `looks`, the rank is the
                order to look in, and `set_score` the probability that the set localizes; with `least_score`, the view
                of the sequence has rank 1.

        Raises:
            TableError: points of another shape, not finite, outside the map or inside geometry.
            ConfigError: an option is out of range, no direction is within the limit on pitch, or a least score is asked
                of scores that are no probabilities.
            PlanningError: no sequence, or no set of looks, keeps the limit on turns.
        """
        if accuracy is not None:
            look = self.at_accuracy(accuracy)
            return look.best(points, n, ids=ids, heading_deg=heading_deg, progress=progress, **options)
        request = SelectionRequest(n=n, **options)
        axes = self._allowed(request)
        waypoints = Waypoints.of(points, ids, heading_deg)
        rows = np.flatnonzero(usable_waypoints(self.localization_map, waypoints, request.skip))
        waypoints = waypoints[rows]
        allowed = self._within_pan(waypoints, axes, request)
        waypoints = replace(waypoints, points=self.frame.world_from_map.apply(waypoints.points))
        scores = self._candidate_scores(waypoints.points, axes, progress)
        scores[~allowed] = -np.inf
        if request.looks is None:
            views = self._single_views(waypoints, axes, scores, request)
        elif request.least_score is None:
            views = self._view_sets(waypoints, axes, scores, request.looks, request.max_total_turn_deg, progress)
        else:
            views = self._sequence_with_stops(waypoints, axes, scores, request, progress)
        if request.sigma_m or request.yaw_sigma_deg:
            prior = PoseUncertainty(request.sigma_m or 0.0, request.yaw_sigma_deg or 0.0)
            chosen = views.waypoint, views.axes @ self.frame.world_from_map.rotation.T
            allowed &= scores >= -np.sort(-scores, axis=1)[:, :ALTERNATIVES][:, -1:]
            expected, best = prior.expected_scores(self.scorer, waypoints.points, axes, allowed, chosen, progress)
            views = replace(views, expected_score=expected, best_expected_score=best)
        return replace(self._explained(views), waypoint=rows[views.waypoint])

    def _single_views(self, waypoints: Waypoints, axes: Float, scores: Float, request: SelectionRequest) -> Views:
        """Select the n best views at each waypoint by scores (W, D) of axes (D, 3), or the best sequence."""
        if request.max_turn_deg is not None:
            chosen = best_sequence(scores, _turn_limit(axes, request.max_turn_deg)).direction_ids[:, None]
        elif request.apart_deg is not None or request.pan_deg is not None:
            chosen = _separate_views(waypoints, axes, scores, request)
        else:
            chosen = np.argsort(-scores, axis=1, kind="stable")[:, : request.n + SPARE]
        k = chosen.shape[1]
        step = max(1, SIGHT_LINES // max(1, len(self.localization_map.landmarks)))
        blocks = np.split(np.arange(len(waypoints)), range(step, len(waypoints), step))
        poses = poses_looking_along(waypoints.points[:, None], axes[chosen])
        reported = [self._reported(waypoints, np.repeat(block, k), poses[block].reshape(-1, 3, 4)) for block in blocks]
        views = Views.concatenate(reported)
        order = np.argsort(-views.score.reshape(-1, k), axis=1, kind="stable")[:, : request.n]
        best = views[(np.arange(len(waypoints))[:, None] * k + order).ravel()]
        return replace(best, rank=np.tile(np.arange(1, order.shape[1] + 1), len(waypoints)))

    def _view_sets(
        self, waypoints: Waypoints, axes: Float, scores: Float, n: int, max_turn_deg: float | None, progress: bool
    ) -> Views:
        """Select the n views at each waypoint with the best joint score, by scores (W, D) of axes (D, 3)."""
        pairs = zip(waypoints.points, tqdm(scores, desc="looks", unit="waypoint", disable=not progress), strict=True)
        sets = []
        chosen: list[Float] = []
        for point, values in pairs:
            choice = axes[np.isfinite(values)]
            sets.append(best_views(self.scorer, point, choice, values[np.isfinite(values)], n, max_turn_deg))
            chosen.extend(choice[[*sets[-1].rows]])
        rank = np.tile(np.arange(1, n + 1), len(sets))
        set_scores = np.repeat([view_set.score for view_set in sets], n)
        rows = np.repeat(np.arange(len(sets)), n)
        poses = poses_looking_along(waypoints.points[rows], np.array(chosen))
        return self._reported(waypoints, rows, poses, rank, set_scores)

    def _sequence_with_stops(
        self, waypoints: Waypoints, axes: Float, scores: Float, request: SelectionRequest, progress: bool
    ) -> Views:
        """Select the best sequence by scores (W, D) of axes (D, 3), with further looks where it scores too little."""
        assert request.looks is not None and request.max_turn_deg is not None and request.least_score is not None
        points = waypoints.points
        chosen = axes[best_sequence(scores, _turn_limit(axes, request.max_turn_deg)).direction_ids]
        config = StopConfig(request.looks, request.least_score)
        allowed = np.isfinite(scores)
        text = "stops" if progress else None
        stops = stops_along(self.scorer, points, chosen, axes, config, progress=text, allowed=allowed)
        path = PlannedPath(points, chosen, self.scorer.score(poses_looking_along(points, chosen)), np.nan, stops=stops)
        places, rank = path.looks
        poses = poses_looking_along(points[places], path.all_axes)
        return self._reported(waypoints, places, poses, rank, path.scores_with_stops[places])

    def _reported(
        self,
        waypoints: Waypoints,
        rows: NDArray[np.int64],
        poses: Float,
        rank: NDArray[np.int64] | None = None,
        set_score: Float | None = None,
    ) -> Views:
        """Return the views with poses (V, 3, 4) at the waypoints of rows (V,), with their scores."""
        return replace(
            self.scorer.report(poses),
            cam_from_world=self.frame.world_from_map.inverse.apply_to_poses(poses),
            frame=self.frame,
            waypoint=rows,
            waypoint_id=tuple(waypoints.ids[row] for row in rows),
            rank=np.ones_like(rows) if rank is None else rank,
            set_score=set_score,
        )

    def floor_plan(self, views: Views) -> Figure:
        """Draw views on a plan of the landmarks, in the map's unit, upright: a Matplotlib figure."""
        from wheretolook.figures.floor_plan import floor_plan_figure

        frame = self.frame.world_from_map
        landmarks = frame.inverse.apply(self.localization_map.landmarks.points)
        points, positions, axes = (points @ frame.rotation.T for points in (landmarks, views.positions, views.axes))
        return floor_plan_figure(points, positions, axes, views.score, views.waypoint_id)

    @cached_property
    def reasons(self) -> ReasonCounter:
        """Counts the landmarks in views that are hard to match."""
        return ReasonCounter(self.localization_map)

    def _explained(self, views: Views) -> Views:
        """Return views with the numbers of landmarks that are hard to match."""
        step = max(1, SIGHT_LINES // max(1, len(self.localization_map.landmarks)))
        poses = self.frame.world_from_map.apply_to_poses(views.cam_from_world)
        counts = Views.concatenate(self.reasons.count(poses[row : row + step]) for row in range(0, len(poses), step))
        return replace(views, **{**counts.columns, "cam_from_world": views.cam_from_world})

    def _candidate_scores(self, locations: Float, axes: Float, progress: bool) -> Float:
        """Score all directions (D, 3) at locations (L, 3), (L, D)."""
        kind = self.localization_map.device.partition(":")[0]
        scores = np.empty((len(locations), len(axes)))
        step = max(1, VIEWS_PER_STEP[kind] // len(axes))
        with tqdm(total=len(locations), desc="score", unit="waypoint", disable=not progress) as bar:
            for begin in range(0, len(locations), step):
                block = locations[begin : begin + step]
                scores[begin : begin + step] = self.scorer.score_directions(block, axes)
                bar.update(len(block))
        return scores

    def _allowed(self, request: SelectionRequest) -> Float:
        """Return the directions within the limit on pitch, (D, 3). Raises ConfigError if they are too few."""
        low, high = request.pitch_deg or (-90.0, 90.0)
        pitch = np.degrees(pan_tilt_angles(self.directions)[1])
        axes = self.directions[(pitch >= low - 1e-9) & (pitch <= high + 1e-9)]
        needed = request.looks or request.n
        if len(axes) < needed:
            fix = "Ask for fewer views, score more directions, or widen the limit on pitch."
            raise ConfigError("there are fewer directions than views", value=f"{len(axes)} for {needed}", fix=fix)
        return axes

    def _within_pan(self, waypoints: Waypoints, axes: Float, request: SelectionRequest) -> NDArray[np.bool_]:
        """Return which of axes (D, 3) are within the limit on pan, (W, D)."""
        if request.pan_deg is None:
            return np.ones((len(waypoints), len(axes)), dtype=bool)
        heading = waypoints.heading_deg(self.frame.world_from_map.rotation)
        pan = np.degrees(pan_tilt_angles(axes)[0]) - heading[:, None]
        low, high = request.pan_deg
        return np.asarray((pan - low + PAN_TOLERANCE_DEG) % 360 <= high - low + 2 * PAN_TOLERANCE_DEG)


def _separate_views(waypoints: Waypoints, axes: Float, scores: Float, request: SelectionRequest) -> NDArray[np.int64]:
    """Return rows (W, n) of axes (D, 3) with the best scores (W, D), above -inf, that are far enough from one another.

    Raises ConfigError, which names the waypoint, if there are fewer.
    """
    best = [np.argsort(-values, kind="stable")[: np.isfinite(values).sum()] for values in scores]
    chosen = [separated(axes, order, request.n, request.apart_deg or 0) for order in best]
    for row, views in enumerate(chosen):
        if len(views) < request.n:
            problem = f"{waypoints.label(row)} has too few views within the limits"
            fix = "Ask for fewer views, score more directions, or widen the limits."
            raise ConfigError(problem, path=waypoints.path, value=f"{len(views)} of {request.n}", fix=fix)
    return np.array(chosen)


def _turn_limit(axes: Float, max_turn_deg: float) -> TurnLimit:
    """Return the limit for directions (D, 3). Raises ConfigError if it allows no turn and seems to be in radians."""
    limit = TurnLimit.of(axes, max_turn_deg)
    if 0 < max_turn_deg <= np.pi and limit.neighbours.shape[1] == 1 < len(axes):
        problem = "max_turn_deg is in degrees, and less than the angle between any two directions"
        raise ConfigError(problem, value=max_turn_deg, fix="Convert radians; else score more directions, or give 0.")
    return limit


def _described_camera(camera: Camera | str | int | None, fov_deg: float | None) -> Camera | int | None:
    """Return the camera of a text or of a field of view. Raises ConfigError if both are given, or it is invalid."""
    if fov_deg is None:
        return parse_camera(camera) if isinstance(camera, str) else camera
    if camera is not None:
        raise ConfigError("a camera is described in two ways", value=fov_deg, fix="Give camera or fov_deg.")
    return PinholeCamera.of_field_of_view(fov_deg, 640, 480)
