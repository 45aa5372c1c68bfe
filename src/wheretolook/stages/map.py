"""The map stage: a COLMAP model of every scene, of a folder of photographs, or from a model of one's own."""

from __future__ import annotations

import zlib
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from wheretolook.config import NOT_SCENES, Experiment
from wheretolook.dataset.dataset_lock import changes_dataset
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.geometry.camera import Camera, CameraConfig, PinholeCamera, describe_camera, draw_camera
from wheretolook.geometry.poses import Float
from wheretolook.mapping.config import MapConfig, ScaleConfig
from wheretolook.mapping.georeference import read_scale
from wheretolook.stages.preconditions import (
    Say,
    Tick,
    dataset_after,
    existing,
    mesh_fingerprint,
    naming_scene,
    open_scene,
    refuse_release,
)
from wheretolook.utils.artifact_cache import cache_key
from wheretolook.utils.confine import check_folder_name, path_within, safe_child
from wheretolook.utils.errors import ConfigError, MapError, SceneError
from wheretolook.utils.files import fingerprint


@changes_dataset("map")
def make_maps(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> Dataset:
    """Stage 2: a COLMAP model of every scene with its landmarks' attributes, `<scene>/map/`.

    Images are rendered along a walk, or for a scan where its frames were taken. With `map.photographs.images`, of one
    scene, made of the photographs there, which needs no mesh. With `map.existing.model`, of one scene made from that
    model, with or without a mesh. Raises SceneError or MapError if a mesh or a model cannot be read, or no landmark
    could be triangulated.
    """
    if experiment.map.existing.model is not None:
        refuse_release(experiment.root)
        return _map_existing(experiment, say, tick)
    if experiment.map.photographs.images is not None:
        refuse_release(experiment.root)
        return _map_photographs(experiment, say, tick)
    dataset = dataset_after(experiment, "scenes")
    apart = ("photographs", "existing", "camera", "draw_camera")  # the camera follows by itself
    settings = {name: value for name, value in experiment.map.record().items() if name not in apart}
    for files in dataset.scenes:
        scene = open_scene(experiment, dataset, files)
        seed = _seed(files)
        made_from = existing(files.mesh, SceneError, "scenes")
        floor = files.mapped_floor()
        camera = _mapping_camera(experiment.map, scene.camera, seed)
        shown_by = [asdict(scene.config.free_space), camera.record(), seed, made_from, *([floor] if floor else [])]
        key = cache_key("map", [settings, *shown_by])
        model = [files.map / name for name in ("cameras.bin", "images.bin", "points3D.bin")]
        if files.stage_cache("map", key).is_current(files.landmarks, *model):
            say(f"{scene.name}: reusing {files.map}")
        else:
            from wheretolook.mapping.rendered_map import build_map
            from wheretolook.mapping.walk import PartOfFloor

            taken = _poses_of_recording(files, experiment.map.n_images)
            with naming_scene(files.mesh):
                space = PartOfFloor(scene.mesh_space, floor) if floor else scene.mesh_space
                shown = (scene.mesh, scene.renderer, space, camera)
                workers = experiment.n_workers
                device = scene.device
                how = (scene.raycaster, workers, device)
                forget = files.stage_cache("map").clear
                report = build_map(*shown, experiment.map, seed, files.map, *how, before_replace=forget, poses=taken)
            files.stage_cache("map", key).store()
            found = f"{report.n_landmarks:,} landmarks from {report.n_registered} images"
            off = f"median {report.median_distance_to_mesh_cm:.2f} cm from the mesh"
            say(f"{scene.name}: {found}, {off} -> {files.map}")
        tick(1)
    return dataset


def _poses_of_recording(scene: SceneFolder, at_most: int) -> Float | None:
    """Poses (M, 3, 4) of a scan's frames, evenly so many of them, for its map: only there the mesh is whole."""
    if not scene.is_scanned:
        return None
    from wheretolook.mapping.colmap_model import colmap_poses

    poses = colmap_poses(scene.frames)
    return poses[np.unique(np.linspace(0, len(poses) - 1, min(len(poses), at_most)).round().astype(int))]


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

    settings = experiment.map.photographs
    root = experiment.root
    assert settings.images is not None
    name = settings.name or settings.images.resolve().name
    check_folder_name("a scene's name, map.photographs.name,", name, NOT_SCENES)
    scene = SceneFolder(safe_child(root, name, "a scene's name"), "test", experiment.camera.camera)
    dataset = _with_photographs(scene, experiment)
    files = [settings.images / name for name in list_photographs(settings.images)]
    tables = [path for path in (settings.scale.marker_table, settings.scale.positions) if path is not None]
    missing = next((path for path in tables if not path.is_file()), None)
    if missing is not None:
        raise ConfigError("there is no such table", path=missing, fix="Check map.photographs.scale.")
    images = [(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    used = [replace(settings, assume_metric=False).record(), experiment.map.extractor.record()]
    made_from = [images, [fingerprint(path) for path in tables]]
    key = cache_key("map", [*used, experiment.map.keep_database, _seed(scene), *made_from])
    if not scene.stage_cache("map", key).is_current(scene.landmarks, scene.mapping_cameras):
        from wheretolook.mapping.photograph_map import map_photographs

        how = (scene.folder / "photographs", _seed(scene), experiment.n_workers, experiment.warp_device)
        forget = scene.stage_cache("map").clear
        report = map_photographs(experiment.map, scene.map, *how, before_replace=forget)
        scene.stage_cache("map", key).store()
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


def _map_existing(experiment: Experiment, say: Say, tick: Tick) -> Dataset:
    """Make a scene of the model in `map.existing.model`: `<scene>/map/`, and `<scene>/mesh.glb` if a mesh is given.

    The scene joins those of the dataset that are made of photographs or models too. Raises what `map_existing` does,
    ConfigError if the dataset holds other scenes, and SceneError if the mesh cannot be used.
    """
    from wheretolook.mapping.colmap_model import read_model

    settings = experiment.map.existing
    photographs = experiment.map.photographs
    root = experiment.root
    assert settings.model is not None
    name = settings.scene_name
    check_folder_name("a scene's name, map.existing.name,", name, NOT_SCENES)
    if settings.mesh is not None and (settings.level or photographs.scale != ScaleConfig()):
        fix = "Give a model and a mesh that are both in metres with z up."
        raise ConfigError("a model that is turned or scaled leaves its mesh", value=str(settings.mesh), fix=fix)
    model = read_model(settings.model)
    scene = SceneFolder(safe_child(root, name, "a scene's name"), "test", experiment.camera.camera)
    scene = _with_own_camera(scene, model, experiment)
    dataset = _with_photographs(scene, experiment)
    tables = [photographs.scale.marker_table, photographs.scale.positions, settings.database]
    files = [*sorted(settings.model.iterdir()), *(path for path in tables if path is not None)]
    if photographs.images is not None:
        names = [image.name for _, image in sorted(model.images.items())]
        files += [path_within(photographs.images, name, "the name of a model's image") for name in names]
    stats = [(path, path.stat()) for path in files if path.is_file()]
    made_from = [(str(path), stat.st_size, stat.st_mtime_ns) for path, stat in stats]
    mesh = [] if settings.mesh is None else [mesh_fingerprint(settings.mesh)]
    chosen = {name: value for name, value in experiment.map.record().items() if name not in ("camera", "draw_camera")}
    key = cache_key("map", [chosen, _seed(scene), made_from, mesh])
    if scene.stage_cache("map", key).is_current(
        scene.landmarks, scene.mapping_cameras, *([scene.mesh] if mesh else [])
    ):
        say(f"{scene.name}: reusing {scene.map}")
    else:
        from wheretolook.mapping.imported_map import map_existing
        from wheretolook.mapping.sanity import warn_of_mesh
        from wheretolook.rendering.raycasting import MeshRaycaster
        from wheretolook.scenes.loading import load_mesh, save_glb

        loaded = None if settings.mesh is None else load_mesh(settings.mesh, settings.mesh_up, colored=False)
        scene.stage_cache("map").clear()
        how = (scene.folder / "photographs", _seed(scene), experiment.n_workers, experiment.warp_device)
        report = map_existing(experiment.map, scene.map, *how, reconstruction=model)
        scene.mesh.unlink(missing_ok=True)
        if settings.mesh is not None and loaded is not None:
            caster = MeshRaycaster(loaded, experiment.warp_device)
            warn_of_mesh(settings.mesh, scene.read_landmarks().points, caster)
            save_glb(loaded, scene.mesh)
        scene.stage_cache("map", key).store()
        left_out = f", {report.n_landmarks_removed:,} points left out" if report.n_landmarks_removed else ""
        anew = ", triangulated anew," if report.triangulated_anew else ""
        found = f"{report.n_landmarks:,} landmarks{anew} from {report.n_images} images{left_out}"
        say(f"{scene.name}: {found} -> {scene.map}")
    scale = read_scale(scene.map)
    assert scale is not None
    say(f"{scene.name}: {scale.describe()}; looked at with {describe_camera(scene.camera)}")
    dataset.save()
    tick(1)
    return dataset


def _with_own_camera(scene: SceneFolder, model: Any, experiment: Experiment) -> SceneFolder:
    """The scene with the model's camera, unless the settings name one that looks."""
    from wheretolook.mapping.colmap_model import camera_of_model

    if experiment.camera != CameraConfig():
        return scene
    settings = experiment.map.existing
    assert settings.model is not None
    try:
        return replace(scene, camera=camera_of_model(model, settings.model, settings.camera_id), own_camera=True)
    except MapError as error:
        fix = "Name one of the model's, --map.existing.camera_id 1, or describe another, such as --camera.fov_deg 70."
        raise MapError(error.problem, path=error.path, value=error.value, fix=fix) from error


def _with_photographs(scene: SceneFolder, experiment: Experiment) -> Dataset:
    """The experiment's dataset with this scene, which may be there already."""
    root = experiment.root
    scenes = [scene]
    if (root / "dataset.json").is_file():
        known = Dataset.load(root)
        scenes += [other for other in known.scenes if other.name != scene.name]
        if not all(read_scale(other.map) for other in known.scenes):  # maps of meshes have none
            problem = "this dataset holds scenes with meshes, which photographs do not join"
            names = [other.name for other in known.scenes]
            fix = "Give the photographs a dataset of their own: --name."
            raise ConfigError(problem, path=root, value=names, fix=fix)
        others = [other for other in known.scenes if not (other.own_camera or scene.own_camera)]
        for other in others:
            if other.camera != scene.camera:  # what was sampled with another camera is no longer valid
                other.stage_cache("map", other.stage_cache("map").stored_key or "").store()
        scenes = [replace(other, camera=scene.camera) if other in others else other for other in scenes]
    return Dataset(root, tuple(sorted(scenes, key=lambda scene: scene.name)))
