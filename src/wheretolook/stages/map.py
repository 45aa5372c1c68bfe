"""The map stage: a COLMAP model of every scene."""

from __future__ import annotations

import zlib
from dataclasses import asdict

import numpy as np

from wheretolook.config import Experiment
from wheretolook.dataset.folders import Dataset
from wheretolook.dataset.stamps import is_done, stage_key, write_stamp
from wheretolook.geometry.camera import Camera, PinholeCamera, draw_camera
from wheretolook.mapping.config import MapConfig
from wheretolook.stages.inputs import Say, Tick, dataset_after, existing, naming_scene, open_scene, refuse_release
from wheretolook.stages.photographs import map_photograph_scene
from wheretolook.utils.errors import ConfigError, SceneError


def make_maps(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> Dataset:
    """Stage 2: a COLMAP model of every scene with its landmarks' attributes, `<scene>/map/`.

    With `map.photographs.images`, of a scene made of the photographs there; see `map_photograph_scene`.

    Raises:
        SceneError, MapError: a mesh cannot be read, or no landmark could be triangulated.
    """
    if experiment.map.photographs.images is not None:
        refuse_release(experiment.root)
        return map_photograph_scene(experiment, say, tick)
    dataset = dataset_after(experiment, "scenes")
    apart = ("photographs", "camera", "draw_camera")  # the camera follows by itself
    settings = {name: value for name, value in asdict(experiment.map).items() if name not in apart}
    for files in dataset.scenes:
        scene = open_scene(experiment, dataset, files)
        seed = zlib.crc32(scene.name.encode()) % 2**31  # the scene's own, whichever scenes are beside it
        made_from = existing(files.mesh, SceneError, "scenes")
        camera = _mapping_camera(experiment.map, scene.camera, seed)
        key = stage_key("map", [settings, asdict(scene.config.free_space), camera.record(), seed, made_from])
        model = [files.map / name for name in ("cameras.bin", "images.bin", "points3D.bin")]
        if is_done(files, "map", key, files.landmarks, *model):
            say(f"{scene.name}: reusing {files.map}")
        else:
            from wheretolook.mapping.building import build_map

            with naming_scene(files.mesh):
                shown = (scene.mesh, scene.renderer, scene.mesh_space, camera)
                workers, device = experiment.n_workers, scene.device
                report = build_map(*shown, experiment.map, seed, files.map, scene.raycaster, workers, device)
            write_stamp(files, "map", key)
            found = f"{report.n_landmarks:,} landmarks from {report.n_registered} images"
            say(
                f"{scene.name}: {found}, median {report.median_distance_to_mesh_cm:.2f} cm from the mesh -> {files.map}"
            )
        tick(1)
    return dataset


def _mapping_camera(config: MapConfig, looking: Camera, seed: int) -> PinholeCamera:
    """The camera that maps: given, drawn, or the one that looks.

    Raises:
        ConfigError: it has distortion.
    """
    if config.draw_camera:
        return draw_camera(np.random.default_rng([seed, 1]))
    camera = looking if config.camera is None else config.camera.camera
    if not isinstance(camera, PinholeCamera):
        fix = "Give one without distortion: --map.camera '{width: 640, height: 480, fov_deg: 90}'."
        raise ConfigError("a mesh is mapped with a pinhole camera", value=camera.model, fix=fix)
    return camera
