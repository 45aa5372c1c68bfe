"""Viewpoint maps of a scene, or of any occlusion model and scorer, and paths planned by several methods."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from tqdm.auto import tqdm

from wheretolook.dataset.config import Accuracy
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.scene import Scene
from wheretolook.dataset.viewpoint_table import pose_columns
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import ViewLattice, VoxelGrid, spread_rows
from wheretolook.geometry.poses import Float, poses_looking_along, rotation_looking_along, transform
from wheretolook.geometry.similarity import Similarity
from wheretolook.geometry.views import Views
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.planning.config import FORWARD, MAX_DIRECTIONS, PlanConfig
from wheretolook.planning.routes import PlannedPath
from wheretolook.planning.rrt import Space, check_ends, plan_path
from wheretolook.planning.stops import check_stopping, stops_along, within_pitch
from wheretolook.planning.viewpoint_map import MapOrigin, ViewpointMap
from wheretolook.rendering.warp_renderer import Renderer
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.registry import FALLBACK, is_probability, make_scorer, methods_named, scorers
from wheretolook.scorers.weights import load_scorer, resolve_weights
from wheretolook.utils.errors import ConfigError, SceneError, check_range
from wheretolook.visibility.counting import SurveyOptions, survey
from wheretolook.visibility.occlusion import DevicePoints

Text = str | None  # text of progress bars; None shows none


def build_viewpoint_map(
    scorer: Scorer, grid: VoxelGrid, free: ArrayLike, directions: ArrayLike, lattice: str = "", progress: Text = None
) -> ViewpointMap:
    """Score every direction at the centre of every free voxel of a grid; the result answers in the map's own frame.

    Args:
        scorer: any method, on the localization map to be used.
        grid: of V voxels, metres.
        free: ids (L,) of the voxels that a camera can be in, or a mask (V,) of all voxels.
        directions: (D, 3) optical axes in the world, of any length.
        lattice: name of the directions, for the map's origin.
        progress: text of the progress bar; None shows none.

    Raises:
        SceneError: no voxel is free, or the centre of one is inside geometry.
        MapError: the map has no landmarks.
        ConfigError: no directions or more than 65,536, or ids outside the grid.
        ValueError: directions that are not (D, 3), not finite or of length 0.
    """
    axes = _unit(directions)
    given = np.asarray(free)
    rows = np.flatnonzero(given) if given.dtype == bool else np.unique(given.astype(np.int64))
    if len(rows) == 0:
        raise SceneError("no voxel is free", value=len(grid), fix="Refine the grid, or check its position.")
    if rows[0] < 0 or rows[-1] >= len(grid):
        raise ConfigError("ids of free voxels lie outside the grid", value=(int(rows[0]), int(rows[-1])))
    landmarks = scorer.localization_map.landmarks
    row_of_voxel = np.full(len(grid), -1, dtype=np.int32)
    row_of_voxel[rows] = np.arange(len(rows))
    ranked, scores, n_visible = _score_and_count(scorer, grid.centers()[rows], axes, progress)
    digests = landmark_digests(landmarks)
    in_world = ViewpointMap(
        grid=grid,
        row_of_voxel=row_of_voxel,
        directions=axes,
        ranked=ranked,
        scores=scores,
        n_visible=n_visible,
        landmark_ids=landmarks.ids,
        landmark_digests=digests,
        origin=_origin(scorer, lattice, digests),
    )
    return in_world.in_frame(scorer.localization_map.frame.world_from_map)


def landmark_digests(landmarks: Landmarks) -> NDArray[np.uint64]:
    """Compute digests (N, 2) of each landmark's position and of its attributes: BLAKE2b of 8 bytes, little-endian."""
    attributes = np.concatenate([landmarks.mapping_direction, landmarks.attributes()], axis=1)
    return np.stack([_digests(landmarks.points), _digests(attributes)], axis=1)


def _digests(rows: NDArray[Any]) -> NDArray[np.uint64]:
    digests = b"".join(hashlib.blake2b(row.tobytes(), digest_size=8).digest() for row in rows)
    return np.frombuffer(digests, dtype="<u8").astype(np.uint64)


def _score_and_count(
    scorer: Scorer, locations: Float, directions: Float, progress: Text
) -> tuple[NDArray[np.uint16], NDArray[np.float32], NDArray[np.uint32]]:
    """Return ranked ids, scores and numbers of landmarks in view, each (L, D), of directions at locations (L, 3) m."""
    localization_map = scorer.localization_map
    camera, occlusion, device = localization_map.camera, localization_map.occlusion, localization_map.device
    points = localization_map.landmarks.points
    occlusion.check(locations, points)
    ranked = np.empty((len(locations), len(directions)), dtype=np.uint16)
    scores = np.empty(ranked.shape, dtype=np.float32)
    n_visible = np.empty(ranked.shape, dtype=np.uint32)
    # enough views at once to fill a GPU, few enough for the progress bar to move
    block = max(1, (1 << 14 if device == "cpu" else 1 << 18) // len(directions))
    # fewer where there are very many landmarks: each is tested from each of them on the host
    checked = spread_rows(len(locations), max(10, min(1000, (1 << 28) // len(points))))
    counting = SurveyOptions(keep=1, keep_occlusion=False, device=device)
    on_device = None
    with tqdm(total=len(locations), desc=progress, unit="voxel", disable=progress is None) as bar:
        for begin in range(0, len(locations), block):
            rows = slice(begin, begin + block)
            at = locations[rows]
            values, counts = scorer.score_and_count(at, directions)
            if counts is None:
                on_device = on_device or DevicePoints(points, device)
                rotations = rotation_looking_along(directions)
                counts = survey(camera, rotations, at, on_device, occlusion, counting).counts
            ranked[rows] = np.argsort(-values, axis=1, kind="stable")
            scores[rows] = values
            n_visible[rows] = counts
            some = checked[(checked >= begin) & (checked < begin + block)]
            if len(some):  # warns of views out of range
                scorer.score(poses_looking_along(locations[some], directions[ranked[some, 0]]))
            bar.update(len(values))
    return ranked, scores, n_visible


def _unit(directions: ArrayLike) -> Float:
    axes = np.asarray(directions, dtype=np.float64).reshape(-1, 3)
    check_range("the number of directions", len(axes), 1, MAX_DIRECTIONS)
    rotation_looking_along(axes)  # raises if one has no length or is not finite
    length = np.linalg.norm(axes, axis=1, keepdims=True)
    return np.where(np.abs(length - 1) < 1e-12, axes, axes / length)  # unit vectors stay the same to the bit


def _origin(scorer: Scorer, lattice: str, digests: NDArray[np.uint64]) -> MapOrigin:
    localization_map = scorer.localization_map
    camera = localization_map.camera
    digest = hashlib.sha256(localization_map.landmarks.ids.tobytes() + digests.tobytes()).hexdigest()[:16]
    intrinsics = camera.colmap.record()
    if isinstance(camera, PinholeCamera):  # stored in one form, whatever the model
        intrinsics |= {"model": "PINHOLE", "params": [float(v) for v in (camera.fx, camera.fy, camera.cx, camera.cy)]}
    return MapOrigin(scorer.name, lattice, intrinsics, localization_map.occlusion.name, digest)


def scene_scorer(
    scene: Scene,
    method: str = "",
    weights: Path | None = None,
    anywhere: bool = False,
    accuracy: Accuracy | None = None,
) -> Scorer:
    """Build the scorer of a scene by a method; an empty one stands for that of the weights, or bins.

    With `anywhere`, weights adapted to another scene are allowed. An `accuracy` is that of its scores.

    Raises:
        ConfigError: no such method, or it needs weights, or has no such accuracy. WeightsError: the weights cannot be used.
        MapError: the map lacks what the method needs.
    """
    if weights is not None and not method:
        scorer = load_scorer(scene.localization_map, weights, anywhere=anywhere)
    else:
        scorer = make_scorer(method or FALLBACK, scene.localization_map, weights=weights, anywhere=anywhere)
    return scorer if accuracy is None else scorer.at_accuracy(accuracy)


def scene_viewpoint_map(scene: Scene, views: ViewLattice, scorer: Scorer) -> ViewpointMap:
    """Build the viewpoint map of a scene by a scorer of its views, with progress bars.

    Raises SceneError if no voxel is free, MapError if there are no landmarks.
    """
    grid, free = scene.free_voxels(views, scene.space)
    return build_viewpoint_map(scorer, grid, free, views.axes(), views.lattice, f"viewpoint map {scene.name}")


def planner_map(scene: Scene, views: ViewLattice, scorer: Scorer) -> ViewpointMap:
    """Build the map for planners: in the world, scores in [0, 1], and views wherever a camera can be.

    Scores that are no probabilities are replaced by ranks, and partially free voxels are filled. Raises as
    `scene_viewpoint_map`.
    """
    scored = scene_viewpoint_map(scene, views, scorer).in_frame(Similarity())
    if not is_probability(scored.origin.scorer):
        scored = shares_below(scored)
    return fill_partially_free_voxels(scored, scene.space)


def check_methods(methods: Iterable[str]) -> None:
    """Raise a ConfigError if there is no method of a name; an empty one stands for that of the weights."""
    for name in filter(None, methods):
        methods_named([name], scorers())


def shares_below(viewpoint_map: ViewpointMap) -> ViewpointMap:
    """Replace each score by the share of all views in the map that score lower: a ranking in [0, 1].

    Planning weighs scores against metres, and information has other units and no upper limit.
    """
    ordered = np.sort(viewpoint_map.scores, axis=None)
    shares = np.searchsorted(ordered, viewpoint_map.scores, side="left") / max(1, ordered.size - 1)
    origin = viewpoint_map.origin.derive("scores replaced by ranks")
    return replace(viewpoint_map, scores=shares.astype(np.float32), origin=origin)


def fill_partially_free_voxels(viewpoint_map: ViewpointMap, space: Space) -> ViewpointMap:
    """Give voxels with free space but an occupied centre the views of the nearest voxel in reach.

    A voxel is in reach if a camera can go straight to its centre, so no views are taken through walls. In the result, a
    derived map (`MapOrigin.derived`), voxels share rows, so it cannot be saved.
    """
    rows = viewpoint_map.row_of_voxel.copy()
    centers = viewpoint_map.grid.centers()
    size = viewpoint_map.grid.voxel_m
    known = np.flatnonzero(rows >= 0)
    unknown = np.flatnonzero(rows < 0)
    # points (27, 3) of a voxel that are tested, relative to its centre in units of its size
    offsets = np.stack(np.meshgrid(*[(-1 / 3, 0.0, 1 / 3)] * 3, indexing="ij"), -1).reshape(-1, 3)
    points = centers[unknown][:, None] + offsets * size
    free = space.is_free(points.reshape(-1, 3)).reshape(len(unknown), len(offsets))
    order = np.argsort((offsets**2).sum(1), kind="stable")
    for voxel, inside, is_free in zip(unknown, points, free, strict=True):
        if not is_free.any():
            continue
        start = inside[order[is_free[order]][0]]  # the free point nearest to the centre
        # at most two voxels away along each axis
        near = known[(np.abs(centers[known] - centers[voxel]) <= (2 + 1e-6) * size).all(1)]
        near = near[np.argsort(np.linalg.norm(centers[near] - start, axis=1), kind="stable")]
        if len(near):
            clear = space.segments_are_free(np.tile(start, (len(near), 1)), centers[near])
            if clear.any():
                rows[voxel] = viewpoint_map.row_of_voxel[near[int(np.argmax(clear))]]
    return replace(viewpoint_map, row_of_voxel=rows, origin=viewpoint_map.origin.derive("views borrowed by neighbours"))


def plan_by_methods(
    scene: Scene,
    dataset: Dataset | None,
    methods: Iterable[str],
    start: ArrayLike,
    goal: ArrayLike,
    config: PlanConfig = PlanConfig(),
) -> dict[str, PlannedPath]:
    """Plan a path from start to goal, (3,) in the map's own frame, by each method, with progress bars.

    Returned paths are in the world: metres, z up. A method plans by its own viewpoint map, whose scores are of views from the centres of voxels. The scores of the
    returned path are of its exact poses, in the scorer's units; NaN for "forward". Its cost is still the planner's. If
    `config.stops` asks for them, paths get stops (`stops_along`) where the method's scores are probabilities; the last
    method's must be.

    Methods are "forward", or names of scorers; empty for that of the weights, or bins without. `config` has weights for
    learned methods, if they are of their kind (`resolve_weights`); without them they are the dataset's or the bundled
    ones. Returns paths by the names of their methods, in
    the order given. Raises ConfigError if a method needs weights or there is none of that name, or the last cannot
    stop; PlanningError if no path can be found.
    """
    methods = tuple(methods)
    space = scene.space
    check_methods(methods)
    stopping = config.stops.looks > 1
    if stopping and methods and methods[-1]:
        check_stopping(methods[-1])
    world_from_map = scene.frame.world_from_map
    start, goal = ends = world_from_map.apply(np.array([start, goal], dtype=np.float64))
    check_ends(ends, space, space.bounds, world_from_map.inverse)  # before maps are built
    paths: dict[str, PlannedPath] = {}
    for number, method in enumerate(methods, 1):
        if method == FORWARD:
            name = method
            path = plan_path(start, goal, space, space.bounds, None, config.planner)
        else:
            weights = resolve_weights(method, config.weights, dataset=dataset)
            accuracy = config.accuracy if number == len(methods) else None
            scorer = scene_scorer(scene, method, weights, config.anywhere, accuracy)
            views = planner_map(scene, config, scorer)
            name = method or scorer.name
            path = plan_path(start, goal, space, space.bounds, views, config.planner)
            path = replace(path, scores=scorer.score(poses_looking_along(path.positions, path.axes)))
            if stopping and (is_probability(scorer.name) or number == len(methods)):
                axes = within_pitch(views.directions, config.planner)
                stops = stops_along(
                    scorer, path.positions, path.axes, axes, config.stops, config.planner, progress="stops"
                )
                path = replace(path, stops=stops)
        paths.pop(name, None)  # a method named twice comes where it was named last
        paths[name] = path
    return paths


def path_views(path: PlannedPath, localization_map: LocalizationMap, renderer: Renderer | None = None) -> Views:
    """Return `PlannedPath.views` with the camera, the pixels of the landmarks in view, and images if there is a renderer."""
    views = path.views
    camera = localization_map.camera
    points = localization_map.landmarks.points
    pixels = []
    visible = localization_map.landmarks_in_view(views.cam_from_world)
    for row, pose in enumerate(views.cam_from_world):
        pixels.append(camera.project(transform(pose, points[visible[row]])))
    images = None if renderer is None else renderer.render(camera, views.cam_from_world).rgb
    return replace(views, camera=camera, pixels=tuple(pixels), images=images)


def path_table(path: PlannedPath, map_from_world: Similarity, stopping: bool) -> pd.DataFrame:
    """Return a row a view: position, axis, its score (NaN if the method scores nothing), pose cam_from_world.

    All are in the map's own frame; where its unit is not the metre, positions are `x_units` instead of `x_m`. With
    stops, further looks are rows of the same location; `look` counts from 1, the path's own view, and `together` is the
    joint score of all looks of the stop (NaN elsewhere).
    """
    views = path.views
    at = map_from_world.apply(path.positions[views.waypoint])
    along = path.all_axes @ map_from_world.rotation.T
    unit = "m" if map_from_world.scale == 1 else "units"
    names = (*(f"{axis}_{unit}" for axis in "xyz"), "axis_x", "axis_y", "axis_z")
    columns = dict(zip(names, (*at.T, *along.T), strict=True))
    poses = map_from_world.apply_to_poses(views.cam_from_world)
    table = pd.DataFrame({**columns, "score": views.score, **pose_columns(poses)})
    if stopping:
        at_stop = np.bincount(views.waypoint)[views.waypoint] > 1
        table = table.assign(look=views.rank, together=np.where(at_stop, views.set_score, np.nan))
    return table
