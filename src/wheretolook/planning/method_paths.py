"""Paths of several methods from a start to a goal, and what the camera sees along them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.dataset.environment import SceneEnvironment
from wheretolook.dataset.layout import Dataset
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.planning.config import FORWARD, PlanConfig
from wheretolook.planning.routes import PathView, PlannedPath
from wheretolook.planning.rrt import check_ends, plan_path
from wheretolook.planning.scene_map import check_methods, planner_map, planner_scorer
from wheretolook.planning.stops import can_stop, check_stopping, stops_along, within_pitch
from wheretolook.rendering.types import Renderer
from wheretolook.weights.resolve import resolve_weights


def plan_by_methods(
    scene: SceneEnvironment,
    dataset: Dataset,
    methods: Iterable[str],
    start: ArrayLike,
    goal: ArrayLike,
    config: PlanConfig = PlanConfig(),
) -> dict[str, PlannedPath]:
    """Plan a path from start to goal, (3,) m in the world, by each method, with progress bars.

    A method plans by its own viewpoint map, whose scores are those of views from the centres of voxels. The scores of
    the path returned are those that the method's scorer gives its very poses, in the scorer's units; NaN for "forward",
    which scores nothing. The path's cost stays what the planner made of the map. If `config.stops` asks for them, paths
    get stops (`stops_along`) by methods whose scores are probabilities; the last method's must be.

    Methods are "forward", or names of scorers; empty for that of the weights, or bins without. `config` has weights for
    methods that have learnt, if they are of their kind (`resolve_weights`). Returns paths by the names of their methods, in
    the order given. Raises ConfigError if a method needs weights or there is none of that name, or the last cannot
    stop; PlanningError if no path can be found.
    """
    methods = tuple(methods)
    space = scene.space
    check_methods(methods)
    stopping = config.stops.looks > 1
    if stopping and methods and methods[-1]:
        check_stopping(methods[-1])
    check_ends(np.asarray([start, goal], dtype=np.float64), space, space.bounds)  # before maps are built
    paths: dict[str, PlannedPath] = {}
    for number, method in enumerate(methods, 1):
        if method == FORWARD:
            name = method
            path = plan_path(start, goal, space, space.bounds, None, config.planner)
        else:
            weights = resolve_weights(method, config.weights, dataset=dataset)
            scorer = planner_scorer(scene, dataset, method, weights, config.anywhere)
            if stopping and number == len(methods):
                check_stopping(scorer.name)
            views = planner_map(scene, config, scorer)
            name = method or scorer.name
            path = plan_path(start, goal, space, space.bounds, views, config.planner)
            path = replace(path, scores=scorer.score(poses_looking_along(path.positions, path.axes)))
            if stopping and can_stop(scorer.name):
                around = within_pitch(views.directions, config.planner)
                about = (config.stops, config.planner)
                stops = stops_along(scorer, path.positions, path.axes, around, *about, progress="stops")
                path = replace(path, stops=stops)
        paths.pop(name, None)  # a method named twice stands where it was named last
        paths[name] = path
    return paths


def path_views(
    path: PlannedPath, localization_map: LocalizationMap, renderer: Renderer | None = None
) -> list[PathView]:
    """What the camera sees along a path: the landmarks in view, and the image if there is a renderer.

    The further looks of a stop follow the path's view there.
    """
    camera = localization_map.camera
    points = localization_map.landmarks.points
    places, looks = path.looks
    axes = path.all_axes
    scores = path.all_scores
    cam_from_world = poses_looking_along(path.positions[places], axes)
    seen = localization_map.landmarks_in_view(cam_from_world)
    images: Any = [None] * len(seen) if renderer is None else renderer.render(camera, cam_from_world).rgb
    views = []
    size = (camera.width, camera.height)
    n_looks = np.bincount(places)
    together = path.scores_with_stops
    for number, (place, pose, image) in enumerate(zip(places.tolist(), cam_from_world, images, strict=True)):
        pixels = camera.project(points[seen[number]] @ pose[:, :3].T + pose[:, 3])
        view = (path.positions[place], axes[number], float(scores[number]))
        stop = int(looks[number]), int(n_looks[place]), float(together[place]) if n_looks[place] > 1 else np.nan
        views.append(PathView(*view, pixels, size, image, *stop))
    return views
