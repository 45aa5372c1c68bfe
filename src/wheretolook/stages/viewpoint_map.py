"""The viewpoint-map stage: every direction scored at every free voxel of a scene."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from wheretolook.config import Experiment
from wheretolook.stages.inputs import Say, Tick, dataset_after, naming_scene

if TYPE_CHECKING:
    from wheretolook.planning.viewpoint_map import ViewpointMap


def viewpoint_map(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> dict[str, ViewpointMap]:
    """For planners: every direction scored at every free voxel of a scene, `<scene>/viewpoint-map/`.

    Needs the map stage only. It is built anew each time.

    Returns:
        The viewpoint map of each scene asked for, by the scene's name.

    Raises:
        ConfigError: no such scene or method, or the method needs weights. WeightsError: the weights cannot be used.
        SceneError: there is no mesh, or no voxel is free. MapFormatError: something else is where the map belongs.
    """
    from wheretolook.dataset.scene import is_photographed, occlusion_without_mesh, space_and_occlusion
    from wheretolook.planning.scene_map import default_weights, scene_viewpoint_map

    dataset, config = dataset_after(experiment, "map"), experiment.viewpoint_map
    if not config.method and config.weights is None and (weights := default_weights(dataset, say)) is not None:
        say(f"scored by {weights}")
        config = replace(config, weights=weights)
    built: dict[str, ViewpointMap] = {}
    for scene in [dataset.scene(config.scene)] if config.scene else dataset.scenes:
        name = scene.name
        photographed = is_photographed(scene)
        hides = occlusion_without_mesh(experiment.occlusion) if photographed else experiment.occlusion
        with naming_scene(scene.map if photographed else scene.mesh):
            space, occlusion = space_and_occlusion(scene, dataset.camera, experiment, hides)
            found = scene_viewpoint_map(scene, dataset.camera, config, space, occlusion, experiment.warp_device)
        folder = config.out or scene.folder / "viewpoint-map"
        found.save(folder)
        built[name] = found
        n_rows, n_directions = found.scores.shape
        say(f"{name}: {n_directions} directions at {n_rows} free voxels of {len(found.grid)}, scored by "
            f"{found.origin.scorer} -> {folder}")  # fmt: skip
        tick(1)
    return built
