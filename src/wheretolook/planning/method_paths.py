"""Paths of several methods from a start to a goal, and what the camera sees along them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.dataset.folders import Dataset
from wheretolook.dataset.scene import Scene
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.planning.config import FORWARD, PlanConfig
from wheretolook.planning.path_planning import check_ends, plan_path
from wheretolook.planning.route_views import PathView, PlannedPath
from wheretolook.planning.scene_map import check_methods, planner_map, weights_for
from wheretolook.rendering.warp_renderer import WarpRenderer


def plan_by_methods(
    scene: Scene,
    dataset: Dataset,
    methods: Iterable[str],
    start: ArrayLike,
    goal: ArrayLike,
    config: PlanConfig = PlanConfig(),
) -> dict[str, PlannedPath]:
    """Plan a path from start to goal, (3,) m in the world, by each method, with progress bars.

    What a method thinks of the views is its own map's scores. Methods are "forward", or names of scorers; empty for
    that of the weights, or bins without. `config` has weights for methods that have learnt, if they are of their kind
    (`weights_for`). Returns paths by the names of their methods, in the order given. Raises ConfigError if a method
    needs weights or there is none of that name, PlanningError if no path can be found.
    """
    methods, space = tuple(methods), scene.space
    check_methods(methods)
    check_ends(np.asarray([start, goal], dtype=np.float64), space, space.bounds)  # before maps are built
    paths: dict[str, PlannedPath] = {}
    for method in methods:
        views, name = None, method
        if method != FORWARD:
            views = planner_map(scene, dataset, config, method, weights_for(method, dataset, config.weights))
            name = method or views.origin.scorer
        paths.pop(name, None)  # a method named twice stands where it was named last
        paths[name] = plan_path(start, goal, space, space.bounds, views, config.planner)
    return paths


def path_views(
    path: PlannedPath, localization_map: LocalizationMap, renderer: WarpRenderer | None = None
) -> list[PathView]:
    """What the camera sees along a path: the landmarks in view, and the image if there is a renderer."""
    camera, points = localization_map.camera, localization_map.landmarks.points
    cam_from_world = poses_looking_along(path.positions, path.axes)
    seen = localization_map.landmarks_in_view(cam_from_world)
    images: Any = [None] * len(seen) if renderer is None else renderer.render(camera, cam_from_world).rgb
    views, size = [], (camera.width, camera.height)
    for number, (pose, image) in enumerate(zip(cam_from_world, images, strict=True)):
        pixels = camera.project(points[seen[number]] @ pose[:, :3].T + pose[:, 3])
        view = (path.positions[number], path.axes[number], float(path.scores[number]))
        views.append(PathView(*view, pixels, size, image))
    return views
