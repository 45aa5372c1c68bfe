"""Training scenes of a dataset and of further ones, without PyTorch."""

from __future__ import annotations

from collections.abc import Sequence

from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.utils.errors import ConfigError, TableError
from wheretolook.utils.files import fingerprint, safe_child


def with_also(dataset: Dataset, names: Sequence[str]) -> Dataset:
    """Return a dataset together with the train scenes of others in the same folder.

    Raises a TableError if there is no such dataset or it has no train scene; a ConfigError if it is named
    twice or is the dataset itself, or one of its scenes is one of the dataset's under another name.
    """
    if len({dataset.name, *names}) <= len(names):
        fix = "Name other datasets in the same folder, each once."
        raise ConfigError("a dataset is named twice", value=list(names), fix=fix)
    scenes = list(dataset.scenes)
    for name in names:
        other = Dataset.load(safe_child(dataset.root.parent, name, "a dataset's name"))
        scenes += training_scenes(Dataset(other.root, other.split("train")))
    if names:
        scene_of: dict[str, SceneFolder] = {}
        for scene in scenes:
            landmarks = fingerprint(scene.landmarks) if scene.landmarks.is_file() else str(scene.folder)
            if landmarks in scene_of:
                fix = "Leave the dataset out of train.also: scenes must not cross splits."
                raise ConfigError(f"this is the scene {scene_of[landmarks].folder} again", path=scene.folder, fix=fix)
            scene_of[landmarks] = scene
    return Dataset(dataset.root, tuple(scenes))


def training_scenes(dataset: Dataset) -> list[SceneFolder]:
    """Return train scenes, then val scenes; a TableError without train scenes."""
    if not dataset.split("train"):
        fix = "Make one, or train on another dataset."
        raise TableError("the dataset has no train scene", path=dataset.root, fix=fix)
    return [*dataset.split("train"), *dataset.split("val")]
