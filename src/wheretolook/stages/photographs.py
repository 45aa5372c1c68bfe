"""The map stage of a folder of photographs: a scene with a map, without a mesh, and perhaps without a scale."""

from __future__ import annotations

import re
import zlib
from dataclasses import asdict, replace
from pathlib import Path

from wheretolook.config import Experiment
from wheretolook.dataset.folders import Dataset, SceneFolder
from wheretolook.dataset.stamps import is_done, read_stamp, stage_key, write_stamp
from wheretolook.mapping.scale import read_scale
from wheretolook.stages.inputs import Say, Tick
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import fingerprint


def map_photograph_scene(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> Dataset:
    """Map the photographs in `map.photographs.images`: `<scene>/map/`, with finished steps in `<scene>/photographs/`.

    The scene joins those of the dataset that are made of photographs too.

    Raises:
        MapError, ConfigError: see `map_photographs`; or the dataset holds scenes with meshes.
    """
    from wheretolook.mapping.photographs import list_photographs

    settings, root = experiment.map.photographs, experiment.root
    assert settings.images is not None
    scene = SceneFolder(root / _scene_name(settings.images, settings.name), "test", experiment.camera.camera)
    dataset = _dataset_with(scene, experiment)
    files = [settings.images / name for name in list_photographs(settings.images)]
    tables = [path for path in (settings.scale.marker_table, settings.scale.positions) if path is not None]
    missing = next((path for path in tables if not path.is_file()), None)
    if missing is not None:
        raise ConfigError("there is no such table", path=missing, fix="Check map.photographs.scale.")
    seed = zlib.crc32(scene.name.encode()) % 2**31  # the scene's own, whichever scenes are beside it
    images = [(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    used = [asdict(replace(settings, assume_metric=False)), asdict(experiment.map.extractor)]
    made_from = [images, [fingerprint(path) for path in tables]]
    key = stage_key("map", [*used, experiment.map.keep_database, seed, *made_from])
    if not is_done(scene, "map", key, scene.landmarks, scene.mapping_cameras):
        from wheretolook.mapping.photograph_map import map_photographs

        how = (scene.folder / "photographs", seed, experiment.n_workers, experiment.warp_device)
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


def _scene_name(images: Path, name: str) -> str:
    name = name or images.resolve().name
    if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9._-]*", name) or name in ("weights", "results", "all"):
        fix = "Set map.photographs.name, of letters, digits, '.', '_' and '-'."
        raise ConfigError("a scene's name becomes a folder's", value=name, fix=fix)
    return name


def _dataset_with(scene: SceneFolder, experiment: Experiment) -> Dataset:
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
