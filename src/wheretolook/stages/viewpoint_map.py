"""The viewpoint-map stage: every direction scored at every free voxel of a scene."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from wheretolook.config import Experiment
from wheretolook.dataset.dataset_lock import reads_dataset
from wheretolook.stages.preconditions import Say, Tick, dataset_after, naming_scene, open_scene

if TYPE_CHECKING:
    from wheretolook.planning.viewpoint_map import ViewpointMap


@reads_dataset("viewpoint-map")
def viewpoint_map(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> dict[str, ViewpointMap]:
    """For planners: every direction scored at every free voxel of a scene, `<scene>/viewpoint-map/`.

    Needs the map stage only. It is built anew each time. Returns those of the scenes asked for, by the scene's name.

    Raises:
        ConfigError: no such scene or method, or the method needs weights. WeightsError: the weights cannot be used.
        SceneError: there is no mesh, or no voxel is free. MapFormatError: something else is where the map belongs.
    """
    from wheretolook.planning.scene_map import scene_scorer, scene_viewpoint_map
    from wheretolook.weights.resolve import resolve_weights

    dataset = dataset_after(experiment, "map")
    config = experiment.viewpoint_map
    if (
        not config.method
        and config.weights is None
        and (weights := resolve_weights(dataset=dataset, log=say)) is not None
    ):
        say(f"scored by {weights}")
        config = replace(config, weights=weights)
    built: dict[str, ViewpointMap] = {}
    for files in [dataset.scene(config.scene)] if config.scene else dataset.scenes:
        scene = open_scene(experiment, dataset, files)
        with naming_scene(scene.source):
            scorer = scene_scorer(scene, config.method, config.weights, config.anywhere)
            views = scene_viewpoint_map(scene, config, scorer)
        folder = config.out or files.folder / "viewpoint-map"
        views.save(folder)
        built[scene.name] = views
        n_rows, n_directions = views.scores.shape
        scored = f"{n_directions} directions at {n_rows} free voxels of {len(views.grid)}"
        say(f"{scene.name}: {scored}, scored by {views.origin.scorer} -> {folder}")
        tick(1)
    return built
