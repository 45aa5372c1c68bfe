"""The scenes that are trained on, and the record of a training: parameters, metrics of the retained weights, history."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheretolook.dataset.config import RELEASE_FILE
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.features.extractor import SIFT
from wheretolook.mapping.landmarks import read_feature_name
from wheretolook.tracking import AUC
from wheretolook.training.config import DECIDING, SharedConfig
from wheretolook.utils.errors import ConfigError, TableError
from wheretolook.utils.files import fingerprint, read_json_object, safe_child, sha256
from wheretolook.utils.package import VERSION

if TYPE_CHECKING:
    import pandas as pd


HISTORY_CSV = "history.csv"
"""Artifact of a train run with a row for each epoch."""

NOT_LOGGED = "not_logged"
"""In the record of weights whose training is not logged yet: "params" and "history", the text of `HISTORY_CSV`."""


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


def params_of(about: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of a train run from the record of its weights."""
    return {name: about[name] for name in ("method", "dataset", "dataset_fingerprint")} | about["config"]


def kept_metrics(metrics: Mapping[str, float]) -> dict[str, float]:
    """Return the metrics of a train run from those of the epoch of the retained weights; the one to sort by is first."""
    first = {AUC: metrics["val_roc_auc"]} if "val_roc_auc" in metrics else {}
    return first | {f"kept_{name}": value for name, value in metrics.items()}


def history_not_logged(record: Mapping[str, Any]) -> pd.DataFrame | None:
    """Return the history in the record of a training that is not logged yet; None if there is none."""
    import pandas as pd

    kept = record.get(NOT_LOGGED)
    text = kept.get("history") if isinstance(kept, dict) else None
    return pd.read_csv(StringIO(text), float_precision="round_trip") if isinstance(text, str) and text else None


@dataclass(frozen=True)
class TrainedModel:
    """The weights that training one method wrote."""

    method: str
    path: Path  # of the weights
    run_id: str  # of its MLflow run; "" if it is not logged yet
    metrics: dict[str, float]  # of the epoch whose weights are stored, numbered from 0 as "epoch"
    reused: bool = False  # whether it was trained by an earlier run of the command


def weights_path(dataset: Dataset, method: str) -> Path:
    """Return the path of a method's weights in a dataset's folder; the record of training is the `.json` next to it."""
    return dataset.root / "weights" / f"{method}.safetensors"


def about_training(dataset: Dataset, method: str, config: SharedConfig, options: Any) -> dict[str, Any]:
    """Return all that decides which weights training gives, as JSON values.

    The dataset includes the scenes of `train.also`, see `with_also`; `options` are the method's own, a dataclass.
    """
    shared = {name: getattr(config, name) for name in DECIDING}
    scenes = [scene for scene in dataset.scenes if scene.split != "test"]
    cameras = dataset.cameras
    about: dict[str, Any] = {
        "dataset": dataset.name,
        "dataset_fingerprint": training_fingerprint(dataset),
        "landmarks": {_name(scene, dataset): fingerprint(scene.landmarks) for scene in scenes},
        "code_version": VERSION,
        "method": method,
        # there may be thousands: the dataset's fingerprint covers them
        "camera": cameras[0].record() if len(cameras) == 1 else f"{len(cameras)} cameras",
        "config": {**asdict(options), **shared},
    }
    features = sorted({read_feature_name(scene.landmarks) for scene in scenes if scene.landmarks.is_file()})
    if features not in ([], [SIFT.name]):  # SIFT is the default and not recorded
        about["features"] = features
    if config.also:
        about["also"] = list(config.also)
        own = tuple(scene for scene in dataset.scenes if scene.folder.parent == dataset.root)
        about["own_fingerprint"] = training_fingerprint(Dataset(dataset.root, own))
    if start := getattr(options, "starts_from", ""):
        path = weights_path(dataset, start)
        about[f"{start}_sha256"] = sha256(path) if path.is_file() else None
    return dict(json.loads(json.dumps(about)))


def _name(scene: SceneFolder, dataset: Dataset) -> str:
    """Return the name of a scene, preceded by its dataset's if that is another one."""
    folder = scene.folder.parent
    return scene.name if folder == dataset.root else f"{folder.name}/{scene.name}"


def trained_before(path: Path, about: Mapping[str, Any]) -> TrainedModel | None:
    """Return the model at `path` if its record equals `about` and its weights are unchanged; else None."""
    try:
        record = read_json_object(path.with_suffix(".json"))
        if record["about"] == about and record["weights_sha256"] == sha256(path):
            return TrainedModel(about["method"], path, record["run_id"], record["metrics"], reused=True)
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return None


def training_fingerprint(dataset: Dataset) -> str:
    """Return 16 hexadecimal digits that change with the train and val scenes."""
    return Dataset(dataset.root, (*dataset.split("train"), *dataset.split("val"))).fingerprint()


def was_trained_on(dataset: Dataset, training: Mapping[str, Any]) -> bool:
    """Return whether weights with a record of training were trained on what a dataset now holds.

    If a dataset of `train.also` is not available, only the dataset's own scenes are compared. A release may ship
    weights trained on other datasets alone, which count as trained on it.
    """
    if (dataset.root / RELEASE_FILE).is_file() and training.get("dataset", dataset.name) != dataset.name:
        return True
    also = training.get("also", ())
    if also and not all((dataset.root.parent / name / "dataset.json").is_file() for name in also):
        return bool(training.get("own_fingerprint") == training_fingerprint(dataset))
    try:
        complete = with_also(dataset, also)
    except (TableError, ConfigError):
        return False
    return bool(training.get("dataset_fingerprint") == training_fingerprint(complete))
