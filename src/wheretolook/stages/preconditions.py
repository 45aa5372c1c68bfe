"""What a stage asks of what earlier ones left: is it there, is it of these settings, is it what it was."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.config import Experiment
from wheretolook.dataset.environment import EnvironmentConfig, SceneEnvironment
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.names import RELEASE_FILE
from wheretolook.geometry.camera import CameraConfig
from wheretolook.utils.errors import ConfigError, MapError, SceneError, TableError, WeightsError
from wheretolook.utils.files import fingerprint
from wheretolook.utils.options import recorded
from wheretolook.utils.reading import read_json_object

if TYPE_CHECKING:
    from wheretolook.features.config import ExtractorConfig

Say = Callable[[str], None]  # told in a line what a stage has done

Tick = Callable[[float], None]
"""Told how much of a stage's work is done: 1 a scene, or 1 in all for stages that do not go scene by scene."""


def dataset_after(
    experiment: Experiment, needs: str, but: Callable[[SceneFolder], bool] = lambda scene: False
) -> Dataset:
    """The dataset, if the stage that is needed has been run for all of its scenes as they are now, but for some.

    Raises ConfigError if it was made with another camera, or is a release where meshes and maps are needed; TableError
    if there is none, or the stage has not been run.
    """
    dataset = Dataset.load(experiment.root)
    if needs != "label":
        refuse_release(experiment.root)
    wanted = experiment.camera.camera
    unnamed = experiment.camera == CameraConfig()
    others = [scene.camera for scene in dataset.scenes if scene.camera != wanted and not (scene.own_camera and unnamed)]
    if others:
        fix = "Run the scenes stage with this configuration, or give the experiment another name."
        problem = "the dataset was made with another camera"
        raise ConfigError(problem, path=experiment.root, value=others[0], fix=fix)
    for scene in dataset.scenes:
        if scene.stage_cache(needs).stored_key is None and not but(scene):
            problem = f"the {needs} stage has not been run for this scene since its input was made"
            raise TableError(problem, path=scene.folder, fix=f"Run `wheretolook {needs}`.")
    return dataset


def open_scene(experiment: Experiment, dataset: Dataset, files: SceneFolder) -> SceneEnvironment:
    """A scene of the dataset as the experiment looks at it; nothing is read yet."""
    scenes = experiment.scenes
    assume_metric = experiment.map.photographs.assume_metric
    config = EnvironmentConfig(experiment.occlusion, scenes.free_space, scenes.mapped_space, assume_metric)
    return SceneEnvironment(files, config=config, device=experiment.device)


def refuse_release(root: Path) -> None:
    """Raise a ConfigError if a release lies there."""
    if (root / RELEASE_FILE).is_file():
        problem = "a release has no meshes and maps, and would be lost if they were made anew"
        fix = "Use it with train, evaluate and release alone, or give the experiment another name."
        raise ConfigError(problem, path=root, fix=fix)


@contextmanager
def naming_scene(path: Path) -> Iterator[None]:
    """Name a scene's file in errors of code that was given its content only."""
    try:
        yield
    except (SceneError, MapError) as error:
        if error.path is not None:
            raise
        raise type(error)(error.problem, path=path, value=error.value, fix=error.fix) from error


def extractor_of(scene: SceneFolder, given: ExtractorConfig | None = None) -> ExtractorConfig:
    """The keypoint extractor the map was made with: queries must use the same.

    Weights of a network are those that settings of the same method name, if they do: the map's may have moved. Raises
    MapError without the map's report, or if its landmarks have no descriptors to match queries with; WeightsError if
    the weights are not where they were.
    """
    from wheretolook.features.config import ExtractorConfig

    path = scene.map / "report.json"
    try:
        report = read_json_object(path)
        extractor = recorded(ExtractorConfig, report["config"]["extractor"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise MapError("the map's report is missing or damaged", path=path, fix="Run the map stage again.") from error
    if not report.get("has_descriptors", True):
        fix = "Run the map stage again with --database, or with --images to triangulate anew."
        raise MapError("the landmarks have no descriptors, so nothing can be localized", path=scene.map, fix=fix)
    if given is not None and given.weights and given.method == extractor.method:
        extractor = replace(extractor, weights=given.weights)
    if extractor.weights and not Path(extractor.weights).is_file():
        fix = f"Say where they are: --map.extractor.method {extractor.method} --map.extractor.weights FILE."
        raise WeightsError("the weights that this map was made with are not there", path=extractor.weights, fix=fix)
    return extractor


def existing(path: Path, error: type[SceneError] | type[MapError], stage: str) -> str:
    """Fingerprint of a file that an earlier stage makes; without it, the error given, naming the stage."""
    if not path.is_file():
        raise error("this file is missing", path=path, fix=f"Run the {stage} stage first.")
    return fingerprint(path)


def mesh_fingerprint(path: Path) -> str:
    """A mesh file changes when its size or date does; it may be gigabytes. Raises SceneError if there is none."""
    if not path.exists():
        raise SceneError("there is no such mesh", path=path, fix="Check the path.")
    files = [path]
    if path.is_dir() or path.suffix.lower() != ".glb":  # materials and textures lie beside it
        files = sorted(file for file in (path if path.is_dir() else path.parent).iterdir() if file.is_file())
    return " ".join(f"{file.resolve()}:{file.stat().st_size}:{file.stat().st_mtime_ns}" for file in files)
