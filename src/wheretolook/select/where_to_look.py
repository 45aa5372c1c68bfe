"""The entry point in Python: views of your own COLMAP model, and images localized in it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.dataset.config import ACCURACY, Accuracy
from wheretolook.dataset.scene import ColmapFiles, Scene
from wheretolook.extend.config import TargetOptions, check_extension
from wheretolook.extend.places import drawn_views, free_places, photograph_candidates, pitches_within, places_at_heights
from wheretolook.geometry.camera import Camera, PinholeCamera, describe_camera
from wheretolook.geometry.camera_files import read_camera
from wheretolook.geometry.lattices import Lattice, direction_lattice
from wheretolook.geometry.poses import Float, camera_centers, compose_poses, rigid_poses
from wheretolook.geometry.views import Views
from wheretolook.inputs.landmark_features import ReasonCounter
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.looks.next_look import NextLook, NextLookSelector, mean_scores_by_pitch
from wheretolook.mapping.config import FrameOptions
from wheretolook.mapping.map_frame import MapFrame
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.registry import is_probability, make_scorer
from wheretolook.scorers.weights import resolve_weights
from wheretolook.select.rig import read_rig, rig_scores
from wheretolook.select.selection import reported, select_views, usable_waypoints, with_reasons
from wheretolook.select.waypoints import SelectionRequest, Waypoints, grid_waypoints
from wheretolook.space.mapped_space import MappedSpace
from wheretolook.training.weights import method_of_weights
from wheretolook.utils.devices import usable_device
from wheretolook.utils.errors import CameraError, ConfigError, MapError, MapWarning, PlanningError, check_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from wheretolook.extend.audit import Audit
    from wheretolook.extend.plan import Extension
    from wheretolook.select.image_localizer import Image, ImageLocalizer
    from wheretolook.select.localized import Localized


class WhereToLook:
    """Scores views of a map, and selects the best ones at any location.

        look = WhereToLook.from_colmap("sparse/0")
        views = look.best([(1.0, 2.0, 1.5), (1.2, 2.0, 1.5)])
        views.save("views.csv")

    Locations, poses and views are in the map's own frame and unit, `frame`. `scorer` is any method on a localization
    map; `directions` (D, 3) are the optical axes that are scored at each location, in the world (z up); cameras do not
    roll. `space` is where a camera can be in the world, for grids; None for the space near the mapping cameras. `build`
    makes the scorer for another camera.
    """

    def __init__(
        self,
        scorer: Scorer,
        directions: ArrayLike | None = None,
        space: Any = None,
        files: ColmapFiles | None = None,
        build: Callable[[LocalizationMap], Scorer] | None = None,
    ) -> None:
        self.scorer = scorer
        self._build = build
        self._accuracy: Accuracy | None = None
        self.camera_of: dict[str, int] = {}  # camera_id by the name of an image, if each has its camera
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
        mesh_up: str = "z",
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
            weights: file or folder of weights, or their name on the Hugging Face hub; None for the bundled ones.
            method: name of a method, such as "set" or "visible"; "" for that of the weights.
            camera: the camera of the views: a camera, a text such as "PINHOLE,640,480,320,320,320,240", a file as
                `read_camera` reads it, or the camera_id of one of the model. None for the model's camera; "each" for that
                of the image of the same name, in `report`.
            fov_deg: instead, a pinhole of that horizontal field of view in degrees, of 640 x 480 px.
            mesh: mesh of the scene in the map's frame, for true occlusion.
            mesh_up: which axis of the mesh's file is the map's z: "x", "y" or "z", with "-" if it points down.
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
        device = usable_device(device)
        of_each = camera == "each"
        camera = _described_camera(None if of_each else camera, fov_deg)
        axes = direction_lattice(directions, lattice)
        check_names("option of the frame", frame, FrameOptions)
        resolve_weights(method, weights)  # so that missing ones are reported before anything is read
        mesh, depth, database = (None if file is None else Path(file) for file in (mesh, depth, database))
        options = FrameOptions(**frame)
        files = ColmapFiles(Path(path), mesh, depth, depth_scale, database, max_reprojection_error_px, options, mesh_up)
        scene = Scene.of_colmap(files, camera, occlusion, device, cache_bytes=1 << 30)
        of_each &= fov_deg is None and len({*scene.map.cameras.values()}) > 1
        if of_each:
            scene.camera = next(iter(scene.map.cameras.values()))
        here = scene.localization_map
        weights = resolve_weights(method, weights, here.landmarks.features)

        if not method:
            assert weights is not None
            method = method_of_weights(weights)

        def build(localization_map: LocalizationMap) -> Scorer:
            return make_scorer(method, localization_map, weights=weights, anywhere=anywhere)

        look = cls(build(here), axes, scene.space, files, build)
        if of_each and (images := scene.map.images) is not None:
            look.camera_of = dict(zip(images.image_names, images.image_cameras.tolist(), strict=True))
        return look

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
        camera: Camera | str | Path | int | None = None,
        prior: Sequence[float] | None = None,
        accuracy: Accuracy = ACCURACY,
    ) -> Localized:
        """Localize an image, or several from one location with `turns`, in the map; needs its descriptors.

        Args:
            images: files, or arrays (H, W, 3) uint8 RGB.
            turns: rotations `cam_from_rig` (N, 3, 3) of several images, or a file of them.
            camera: of the images, its camera_id in the model, or a file of the cameras of images; None to assume one, see
                `QueryImages`.
            prior: rough x, y, z of the camera, and perhaps yaw in degrees: one more hypothesis.
            accuracy: limits in metres and degrees that the probability refers to.

        Raises errors as `wheretolook.select.image_localizer.ImageLocalizer.open` and `.localize`.
        """
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

    def grid(self, spacing_m: float, height_m: float | None = None) -> Waypoints:
        """Return waypoints so many metres apart in all free space, or at one height in the world.

        Raises ConfigError or SceneError if there is none.
        """
        grid = grid_waypoints(self.localization_map, self.space, spacing_m, height_m)
        return replace(grid, points=self.frame.world_from_map.inverse.apply(grid.points))

    def at_accuracy(self, accuracy: Accuracy) -> WhereToLook:
        """Return the same whose scores are probabilities of errors within limits in metres and degrees: (0.25, 2).

        Raises a ConfigError as `wheretolook.scorers.base.Scorer.at_accuracy`.
        """
        look = copy(self)
        look.scorer = self.scorer.at_accuracy(accuracy)
        look._accuracy = accuracy
        return look

    def score(self, cam_from_world: ArrayLike) -> Float:
        """Score poses (B, 3, 4) or (B, 4, 4), or one of them, world-to-camera, (B,).

        Higher is better, of learned methods a probability. Raises PoseError if a pose is no rigid transform.
        """
        return self.scorer.score(self.frame.world_from_map.apply_to_poses(rigid_poses(cam_from_world)))

    def report(self, cam_from_world: ArrayLike, names: Sequence[str] = (), skip: bool = False) -> Views:
        """Score poses, as `score` takes them, and report each as a view; names count from 0 unless given.

        Raises a PoseError as `score`, and a TableError if one is outside the map or inside geometry, unless `skip`
        leaves those out. Of a map opened for the camera of each image, a MapError if a pose has no image's name.
        """
        poses = rigid_poses(cam_from_world)
        waypoints = Waypoints.of(camera_centers(poses), names)
        rows = np.flatnonzero(usable_waypoints(self.localization_map, waypoints, skip))
        in_world = self.frame.world_from_map.apply_to_poses(poses)
        if not self.camera_of:
            views = with_reasons(self.reasons, reported(self.scorer, waypoints, rows, in_world[rows]))
            return views.in_frame(self.frame)
        camera_ids = np.array([self.camera_of.get(name, -1) for name in waypoints.ids])
        for row in rows[camera_ids[rows] < 0]:
            fix = "Name poses like images of the map, or give one camera: --camera-id or --camera, in Python camera."
            problem = f"the map has {len({*self.camera_of.values()})} cameras, and a pose is of none of its images"
            raise MapError(problem, path=waypoints.path, value=waypoints.ids[row], fix=fix)
        parts = []
        for number in np.unique(camera_ids[rows]).tolist():
            here = rows[camera_ids[rows] == number]
            look = self._of_camera(self.localization_map.map.cameras[number])
            views = with_reasons(look.reasons, reported(look.scorer, waypoints, here, in_world[here]))
            parts.append(replace(views, camera_id=np.full(len(views), number)))
        together = replace(Views.concatenate(parts), camera=None).in_frame(self.frame)
        return together[np.argsort(together.waypoint, kind="stable")]

    def report_rig(self, rig: str | Path, rig_from_world: ArrayLike, names: Sequence[str] = ()) -> Views:
        """Score all cameras of a rig, a rig_id or file as of `read_rig`, at poses of the rig (W, 3, 4), world-to-rig.

        The best camera of each pose has rank 1. `sensor` names the camera, `any_score` is the probability that at least
        one localizes alone, `set_score` that all do jointly. Raises errors as `report` and `read_rig`, CameraError if
        the scorer does not serve a camera, and ConfigError for another accuracy than that of the weights.
        """
        if self._accuracy is not None:
            problem = "a rig is scored at the accuracy of the weights: leave the accuracy out"
            raise ConfigError(problem, value=self._accuracy)
        poses = rigid_poses(rig_from_world)
        parts = []
        scorers = []
        for name, camera, cam_from_rig in read_rig(rig, self.localization_map.map):
            look = self._of_camera(camera)
            if not getattr(look.scorer, "serves_camera", False):
                problem = f"the method {look.scorer.name} does not predict detections by the camera {name} of the rig"
                fix = "Use the method set, and a field of view of its training range."
                raise CameraError(problem, path=rig, value=describe_camera(camera), fix=fix)
            views = look.report(compose_poses(cam_from_rig, poses), names)
            parts.append(replace(views, sensor=(name,) * len(views)))
            scorers.append(look.scorer)
        views = Views.concatenate(parts)
        scores = views.score.reshape(len(parts), -1)
        in_world = self.frame.world_from_map.apply_to_poses(views.cam_from_world).reshape(*scores.shape, 3, 4)
        found = [rig_scores(scorers, in_world[:, row], scores[:, row]) for row in range(len(poses))]
        any_score, set_score = np.repeat(found, len(parts), axis=0).T
        rank = np.tile(np.arange(1, len(parts) + 1), len(poses))
        best_first = views[np.lexsort((-views.score, views.waypoint))]
        return replace(best_first, camera=None, rank=rank, any_score=any_score, set_score=set_score)

    def _of_camera(self, camera: Camera) -> WhereToLook:
        """Return the same for another camera."""
        assert self._build is not None
        scorer = self._build(self.localization_map.of_camera(camera))
        return WhereToLook(scorer if self._accuracy is None else scorer.at_accuracy(self._accuracy))

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
        waypoints = Waypoints.of(points, ids, heading_deg)
        check_names("option of best", options, SelectionRequest, ("ids", "heading_deg", "progress", "accuracy"))
        return self.select(waypoints, SelectionRequest(n=n, **options), progress)

    def select(self, waypoints: Waypoints, request: SelectionRequest, progress: bool = False) -> Views:
        """Select the requested views at waypoints; raises as `best`."""
        return select_views(self.scorer, self.reasons, self.directions, waypoints, request, progress)

    def audit(
        self, at: ArrayLike | Waypoints | Audit | None = None, heading_deg: ArrayLike | None = None, **options: Any
    ) -> Audit:
        """Score the views that a robot will have, at points (W, 3) of the map or in all free space.

        Args:
            at: locations of the camera, or an audit of another map, whose views are scored again; None for all free space
                at the heights of the camera.
            heading_deg: yaws (W,) of the robot at the points, for a limit on pan.
            options: fields of `wheretolook.extend.config.TargetOptions`; with points, `height_m` moves them up or down.

        A `MapWarning` counts the views of another map's audit that are outside this map.

        Raises:
            TableError: as `best`.
            ConfigError: an option is out of range, the scores are no probabilities, a height is given without a floor, or
                a limit on pan without points.
            SceneError: there is no place where a camera can be.
        """
        if not is_probability(self.scorer.name):
            fix = "Use the method set, or another learned one."
            raise ConfigError("the scores of this method are no probabilities", value=self.scorer.name, fix=fix)
        from wheretolook.extend.audit import Audit  # imports pandas, which scores do not need

        check_names("option of audit", options, TargetOptions, ("at", "heading_deg"))
        request = TargetOptions(**options)
        if request.height_m and isinstance(self.space, MappedSpace):
            fix = "Give --mesh or --depth, or leave the height out."
            raise ConfigError("heights are above a floor, which landmarks do not show", value=request.height_m, fix=fix)
        to_world = self.frame.world_from_map
        if isinstance(at, Audit):
            again = to_world.apply_to_poses(at.views.cam_from_world)
            outside = ~usable_waypoints(self.localization_map, Waypoints.of(at.views.positions), skip=True)
            if outside.any():
                text = f"{outside.sum()} of {len(again)} target views are outside this map, or inside its geometry"
                warnings.warn(f"{self.localization_map.map.path}: {text}", MapWarning, stacklevel=2)
            apart_m = at.apart_m * to_world.scale / at.views.frame.world_from_map.scale
            return Audit(self._target_views(again, at.views.waypoint, at.views.waypoint_id), apart_m, at.space)
        heading = None
        apart_m = 1.0
        if at is None:
            if request.pan_deg is not None:
                fix = "Give the places and headings of the robot, --targets, or leave pan out."
                raise ConfigError("pan is relative to headings", value=request.pan_deg, fix=fix)
            places, apart_m = free_places(self.localization_map, self.space, request.height_m, 300)
            waypoints = Waypoints.of(places)
        else:
            waypoints = Waypoints.of(at, (), heading_deg)
            waypoints = waypoints[usable_waypoints(self.localization_map, waypoints, request.skip)]
            places = to_world.apply(waypoints.points)
            if request.height_m:
                places = places_at_heights(self.space, places, request.height_m)
                each = waypoints[np.tile(np.arange(len(waypoints)), len(request.height_m))]
                waypoints = replace(each, points=to_world.inverse.apply(places))
                kept = usable_waypoints(self.localization_map, waypoints, request.skip)
                waypoints, places = waypoints[kept], places[kept]
            heading = None if request.pan_deg is None else waypoints.heading_deg(to_world.rotation)
        pitches = pitches_within(request.pitch_deg)
        limits = request.pan_deg or (-180.0, 180.0)
        poses, rows = drawn_views(places, request.views, pitches, heading, limits, request.seed)
        space = None if isinstance(self.space, MappedSpace) else self.space
        return Audit(self._target_views(poses, rows, tuple(waypoints.ids[row] for row in rows)), apart_m, space)

    def _target_views(self, poses: Float, rows: NDArray[np.int64], names: Sequence[str]) -> Views:
        """Return views at poses (T, 3, 4) in the world, with rows and names of their places, in the map's own frame."""
        waypoints = Waypoints.of(camera_centers(poses), names)
        views = with_reasons(self.reasons, reported(self.scorer, waypoints, np.arange(len(poses)), poses))
        return replace(views, waypoint=rows).in_frame(self.frame)

    def extend(
        self,
        n: int,
        at: ArrayLike | Waypoints | None = None,
        heading_deg: ArrayLike | None = None,
        *,
        until: float = 1.0,
        least_p: float = 0.3,
        **options: Any,
    ) -> Extension:
        """Plan the next photographs of the place, so that most views that a robot will have localize in the map.

        They come in pairs, since a landmark needs two images; one of each pair registers in the map so far.

        Args:
            n: number of photographs.
            at: where the robot's camera will be, as in `audit`; the photographs may be anywhere in free space.
            heading_deg: yaws (W,) of the robot at the points, for a limit on pan.
            until: share of the target views that localize at which the photographs end.
            least_p: least probability that one of a pair registers.
            options: fields of `wheretolook.extend.config.TargetOptions`.

        Raises:
            MapError: no photograph registers in the map.
            TableError, ConfigError, SceneError: as `audit`; n is below 1, or a share is none.
        """
        from wheretolook.extend.plan import Planner

        check_extension(n, until, least_p)
        audit = self.audit(at, heading_deg, **options)
        request = TargetOptions(**options)
        candidates = photograph_candidates(self.localization_map, self.space, request)
        return Planner(self.scorer, self.space, audit.views, candidates).plan(n, least_p, until, request.seed)

    def floor_plan(self, views: Views) -> Figure:
        """Draw views on a plan of the landmarks, in the map's unit, upright: a Matplotlib figure."""
        from wheretolook.figures.floor_plan import floor_plan_figure

        frame = self.frame.world_from_map
        landmarks = frame.inverse.apply(self.localization_map.landmarks.points)
        points, positions, axes = (points @ frame.rotation.T for points in (landmarks, views.positions, views.axes))
        return floor_plan_figure(points, positions, axes, views.score, views.waypoint_id, self.frame)

    @cached_property
    def reasons(self) -> ReasonCounter:
        """Counts the landmarks in views that are hard to match."""
        return ReasonCounter(self.localization_map)


def _described_camera(camera: Camera | str | int | None, fov_deg: float | None) -> Camera | int | None:
    """Return the camera of a text or of a field of view. Raises ConfigError if both are given, or it is invalid."""
    if fov_deg is None:
        return read_camera(camera) if isinstance(camera, str) else camera
    if camera is not None:
        raise ConfigError("a camera is described in two ways", value=fov_deg, fix="Give camera or fov_deg.")
    return PinholeCamera.of_field_of_view(fov_deg, 640, 480)
