"""Preconditions of commands: datasets, files and settings that earlier commands must have left."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.dataset.config import RELEASE_FILE
from wheretolook.dataset.environment import EnvironmentConfig, SceneEnvironment
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.features.config import ExtractorConfig
from wheretolook.geometry.camera import CameraConfig, describe_camera
from wheretolook.utils.errors import ConfigError, MapError, SceneError, TableError, WeightsError
from wheretolook.utils.files import fingerprint, read_json_object
from wheretolook.utils.texts import LOG
from wheretolook.utils.validation import from_record

if TYPE_CHECKING:
    from wheretolook.commands.options import DatasetOptions, SceneOptions
    from wheretolook.localization.config import LabelConfig
    from wheretolook.localization.shard import SceneJob


def load_dataset(
    options: DatasetOptions, required_stage: str, exempt: Callable[[SceneFolder], bool] = lambda scene: False
) -> Dataset:
    """Load a command's dataset, and check that a stage has been run on the present input of each scene but exempt ones.

    Raises ConfigError if it was made with another camera, or is a release where meshes and maps are needed; TableError
    if it does not exist, or the stage has not been run.
    """
    _ = options.warp_device  # a missing GPU is an error now, not after hours of other work
    dataset = Dataset.load(options.root)
    if required_stage != "label":
        refuse_release(options.root)
    wanted = options.camera.camera
    unnamed = options.camera == CameraConfig()
    others = [scene.camera for scene in dataset.scenes if scene.camera != wanted and not (scene.own_camera and unnamed)]
    if others:
        fix = "Run the scenes stage with this configuration, or give another --name."
        problem = "the dataset was made with another camera"
        raise ConfigError(problem, path=options.root, value=others[0], fix=fix)
    for scene in dataset.scenes:
        if scene.stage_cache(required_stage).stored_key is None and not exempt(scene):
            problem = f"`wheretolook {required_stage}` has not been run for this scene since its input was made"
            raise TableError(problem, path=scene.folder, fix=f"Run `wheretolook {required_stage}`.")
    return dataset


def open_scene(options: SceneOptions, files: SceneFolder) -> SceneEnvironment:
    """Return a scene of the dataset with a command's occlusion, free space and device; nothing is read yet."""
    scenes = options.scenes
    config = EnvironmentConfig(options.occlusion, scenes.free_space, scenes.mapped_space)
    scene = SceneEnvironment(files, config=config, device=options.device)
    if files.own_camera:
        camera = f"the camera of its map, {describe_camera(files.camera)}"
        LOG.info("%s: %s", files.name, "; ".join((camera, *scene.frame.doubts)))
    return scene


def refuse_release(root: Path) -> None:
    """Raise ConfigError if a folder holds a release."""
    if (root / RELEASE_FILE).is_file():
        problem = "a release has no meshes and maps, and would be lost if they were made again"
        fix = "Use it with train, evaluate and release only, or give another --name."
        raise ConfigError(problem, path=root, fix=fix)


@contextmanager
def naming_file(path: Path) -> Iterator[None]:
    """Add a file's path to errors of code that knows only its content."""
    try:
        yield
    except (SceneError, MapError, TableError) as error:
        if error.path is not None:
            raise
        raise type(error)(error.problem, path=path, value=error.value, fix=error.fix) from error


def extractor_of(scene: SceneFolder, given: ExtractorConfig | None = None) -> ExtractorConfig:
    """Return the keypoint extractor that the map was made with; queries must use the same.

    `given`, if of the same method, names the weights where they have moved. Raises MapError without the map's report, or
    if its landmarks have no descriptors to match queries with; WeightsError if the weights are missing.
    """
    path = scene.map / "report.json"
    try:
        report = read_json_object(path)
        extractor = from_record(ExtractorConfig, report["config"]["extractor"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise MapError("the map's report is missing or damaged", path=path, fix="Run the map stage again.") from error
    if not report.get("has_descriptors", True):
        fix = "Run the map stage again with --database, or with --images to triangulate again."
        raise MapError("the landmarks have no descriptors, so nothing can be localized", path=scene.map, fix=fix)
    if given is not None and given.weights and given.method == extractor.method:
        extractor = replace(extractor, weights=given.weights)
    if extractor.weights and not Path(extractor.weights).is_file():
        fix = f"Give their new path: --mapping.extractor.method {extractor.method} --mapping.extractor.weights FILE."
        raise WeightsError("the weights that this map was made with are missing", path=extractor.weights, fix=fix)
    return extractor


def scene_job(files: SceneFolder, label: LabelConfig, extractor: ExtractorConfig, device: str) -> SceneJob:
    """Return what workers need to label viewpoints of a scene on a device, with keypoints of the map's extractor."""
    from wheretolook.localization.shard import SceneJob

    cameras = tuple(files.cameras().items()) if files.cameras_file.is_file() else ()
    made_from = files.mesh, files.landmarks, files.camera, label.localizer, extractor, device
    return SceneJob(*made_from, cameras=cameras, appearance=label.appearance)


def existing(path: Path, error: type[SceneError] | type[MapError], stage: str) -> str:
    """Return the fingerprint of a file that a stage makes; raise `error`, naming the stage, without the file."""
    if not path.is_file():
        raise error("this file is missing", path=path, fix=f"Run the {stage} stage first.")
    return fingerprint(path)


def mesh_fingerprint(path: Path) -> str:
    """Return sizes and dates of a mesh and the files next to it. Raises SceneError if there is no mesh."""
    if not path.exists():
        raise SceneError("there is no such mesh", path=path, fix="Check the path.")
    files = [path]
    if path.is_dir() or path.suffix.lower() != ".glb":  # materials and textures are files next to it
        files = sorted(file for file in (path if path.is_dir() else path.parent).iterdir() if file.is_file())
    return " ".join(f"{file.resolve()}:{file.stat().st_size}:{file.stat().st_mtime_ns}" for file in files)
