"""Plan paths by several methods, and render the views along them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.dataset.environment import Environment
from wheretolook.dataset.layout import Dataset
from wheretolook.geometry.poses import poses_looking_along, transform
from wheretolook.geometry.views import Views
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.planning.config import FORWARD, PlanConfig
from wheretolook.planning.routes import PlannedPath
from wheretolook.planning.rrt import check_ends, plan_path
from wheretolook.planning.scene_map import check_methods, planner_map, scene_scorer
from wheretolook.planning.stops import check_stopping, stops_along, within_pitch
from wheretolook.rendering.warp_renderer import Renderer
from wheretolook.scorers.registry import is_probability
from wheretolook.scorers.weights import resolve_weights


def plan_by_methods(
    scene: Environment,
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
    for pose, rows in zip(views.cam_from_world, localization_map.landmarks_in_view(views.cam_from_world), strict=True):
        pixels.append(camera.project(transform(pose, points[rows])))
    images = None if renderer is None else renderer.render(camera, views.cam_from_world).rgb
    return replace(views, camera=camera, pixels=tuple(pixels), images=images)
