"""The map stage: a COLMAP model of every scene, or of a folder of photographs."""

from __future__ import annotations

import zlib
from dataclasses import asdict, replace

import numpy as np

from wheretolook.config import NOT_SCENES, Experiment, check_folder_name
from wheretolook.dataset.folders import Dataset, SceneFolder
from wheretolook.dataset.stamps import is_done, read_stamp, stage_key, write_stamp
from wheretolook.geometry.camera import Camera, PinholeCamera, draw_camera
from wheretolook.mapping.config import MapConfig
from wheretolook.mapping.scale import read_scale
from wheretolook.stages.inputs import Say, Tick, dataset_after, existing, naming_scene, open_scene, refuse_release
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.utils.files import fingerprint


def make_maps(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> Dataset:
    """Stage 2: a COLMAP model of every scene with its landmarks' attributes, `<scene>/map/`.

    With `map.photographs.images`, of one scene, made of the photographs there, which needs no mesh. Raises
    SceneError or MapError if a mesh cannot be read, or no landmark could be triangulated.
    """
    if experiment.map.photographs.images is not None:
        refuse_release(experiment.root)
        return _map_photographs(experiment, say, tick)
    dataset = dataset_after(experiment, "scenes")
    apart = ("photographs", "camera", "draw_camera")  # the camera follows by itself
    settings = {name: value for name, value in asdict(experiment.map).items() if name not in apart}
    for files in dataset.scenes:
        scene = open_scene(experiment, dataset, files)
        seed = _seed(files)
        made_from = existing(files.mesh, SceneError, "scenes")
        floor, camera = files.mapped_floor(), _mapping_camera(experiment.map, scene.camera, seed)
        shown_by = [asdict(scene.config.free_space), camera.record(), seed, made_from, *([floor] if floor else [])]
        key = stage_key("map", [settings, *shown_by])
        model = [files.map / name for name in ("cameras.bin", "images.bin", "points3D.bin")]
        if is_done(files, "map", key, files.landmarks, *model):
            say(f"{scene.name}: reusing {files.map}")
        else:
            from wheretolook.mapping.building import build_map
            from wheretolook.mapping.walk import PartOfFloor

            with naming_scene(files.mesh):
                space = PartOfFloor(scene.mesh_space, floor) if floor else scene.mesh_space
                shown = (scene.mesh, scene.renderer, space, camera)
                workers, device = experiment.n_workers, scene.device
                report = build_map(*shown, experiment.map, seed, files.map, scene.raycaster, workers, device)
            write_stamp(files, "map", key)
            found = f"{report.n_landmarks:,} landmarks from {report.n_registered} images"
            off = f"median {report.median_distance_to_mesh_cm:.2f} cm from the mesh"
            say(f"{scene.name}: {found}, {off} -> {files.map}")
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


def _seed(scene: SceneFolder) -> int:
    """The scene's own, whichever scenes are beside it."""
    return zlib.crc32(scene.name.encode()) % 2**31


def _map_photographs(experiment: Experiment, say: Say, tick: Tick) -> Dataset:
    """Map the photographs in `map.photographs.images`: `<scene>/map/`, with finished steps in `<scene>/photographs/`.

    The scene joins those of the dataset that are made of photographs too. Raises what `map_photographs` does, and
    ConfigError if the dataset holds scenes with meshes.
    """
    from wheretolook.mapping.photographs import list_photographs

    settings, root = experiment.map.photographs, experiment.root
    assert settings.images is not None
    name = settings.name or settings.images.resolve().name
    check_folder_name("a scene's name, map.photographs.name,", name, NOT_SCENES)
    scene = SceneFolder(root / name, "test", experiment.camera.camera)
    dataset = _with_photographs(scene, experiment)
    files = [settings.images / name for name in list_photographs(settings.images)]
    tables = [path for path in (settings.scale.marker_table, settings.scale.positions) if path is not None]
    missing = next((path for path in tables if not path.is_file()), None)
    if missing is not None:
        raise ConfigError("there is no such table", path=missing, fix="Check map.photographs.scale.")
    images = [(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    used = [asdict(replace(settings, assume_metric=False)), asdict(experiment.map.extractor)]
    made_from = [images, [fingerprint(path) for path in tables]]
    key = stage_key("map", [*used, experiment.map.keep_database, _seed(scene), *made_from])
    if not is_done(scene, "map", key, scene.landmarks, scene.mapping_cameras):
        from wheretolook.mapping.photograph_map import map_photographs

        how = (scene.folder / "photographs", _seed(scene), experiment.n_workers, experiment.warp_device)
        report = map_photographs(experiment.map, scene.map, *how)
        write_stamp(scene, "map", key)
        used_images = f"{report.n_registered} of {report.n_images} photographs"
        say(f"{scene.name}: {report.n_landmarks:,} landmarks from {used_images} -> {scene.map}")
        if report.unregistered:
            say(f"{scene.name}: not placed: {', '.join(report.unregistered)}")
    else:
        say(f"{scene.name}: reusing {scene.map}")
    scale = read_scale(scene.map)
    assert scale is not None
    say(f"{scene.name}: {scale.describe()}")
    dataset.save()
    tick(1)
    return dataset


def _with_photographs(scene: SceneFolder, experiment: Experiment) -> Dataset:
    """The experiment's dataset with this scene, which may be there already."""
    root = experiment.root
    scenes = [scene]
    if (root / "dataset.json").is_file():
        known = Dataset.load(root)
        scenes += [other for other in known.scenes if other.name != scene.name]
        if not all(other.is_photographed for other in known.scenes):
            problem = "this dataset holds scenes with meshes, which photographs do not join"
            names, fix = [other.name for other in known.scenes], "Give the photographs a dataset of their own: --name."
            raise ConfigError(problem, path=root, value=names, fix=fix)
        for other in known.scenes:
            if other.camera != scene.camera:  # what was sampled with another camera is no longer valid
                write_stamp(other, "map", read_stamp(other, "map") or "")
        scenes = [replace(other, camera=scene.camera) for other in scenes]
    return Dataset(root, tuple(sorted(scenes, key=lambda scene: scene.name)))
