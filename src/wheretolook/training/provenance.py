"""What weights were trained on, and whether that is still what a dataset holds."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.names import RELEASE_FILE
from wheretolook.features.sift import SIFT
from wheretolook.training.config import DECIDING, SharedConfig
from wheretolook.training.old_names import with_name
from wheretolook.training.scenes import with_also
from wheretolook.utils.errors import ConfigError, TableError
from wheretolook.utils.files import fingerprint, sha256
from wheretolook.utils.reading import read_json_object
from wheretolook.utils.version import VERSION


@dataclass(frozen=True)
class TrainedModel:
    """What training one method left."""

    method: str  # its name
    path: Path  # its weights
    run_id: str  # its MLflow run, at the time of training; "" if it is not logged yet
    # metrics of the epoch whose weights were kept, and that epoch's number (from 0) as "epoch"
    metrics: dict[str, float]
    reused: bool = False  # whether it was trained before and only found again


def weights_path(dataset: Dataset, method: str) -> Path:
    """Where the weights of a method lie in a dataset's folder; beside them `.json`, the record of their training."""
    return dataset.root / "weights" / f"{method}.safetensors"


def about_training(dataset: Dataset, method: str, config: SharedConfig, options: Any) -> dict[str, Any]:
    """What decides which weights come out, as JSON values.

    The dataset comes with the scenes of others that are learnt from, see `with_also`; the options are the method's own,
    a dataclass. What training starts from (`FittingConfig.starts_from`) decides, too.
    """
    shared = {name: value for name, value in asdict(config).items() if name in DECIDING}
    seen = [scene for scene in dataset.scenes if scene.split != "test"]
    cameras = dataset.cameras
    about: dict[str, Any] = {
        "dataset": dataset.name,
        "dataset_fingerprint": training_fingerprint(dataset),
        "landmarks": {_name(scene, dataset): fingerprint(scene.landmarks) for scene in seen},
        "code_version": VERSION,
        "method": method,
        # there may be thousands: the dataset's fingerprint tells which
        "camera": cameras[0].record() if len(cameras) == 1 else f"{len(cameras)} cameras",
        "config": {**asdict(options), **shared},
    }
    from wheretolook.mapping.landmarks import features_of

    features = sorted({features_of(scene.landmarks) for scene in seen if scene.landmarks.is_file()})
    if features not in ([], [SIFT.name]):  # weights that say nothing are for SIFT, as are all older ones
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
    """Name of a scene, with that of its dataset if it is of another one."""
    folder = scene.folder.parent
    return scene.name if folder == dataset.root else f"{folder.name}/{scene.name}"


def trained_before(path: Path, about: Mapping[str, Any]) -> TrainedModel | None:
    """The model at `path` if it was trained as `about` says and has not been changed since."""
    try:
        record = read_json_object(path.with_suffix(".json"))
        if with_name(record["about"]) == about and record["weights_sha256"] == sha256(path):
            return TrainedModel(about["method"], path, record["run_id"], record["metrics"], reused=True)
    except (OSError, ValueError, KeyError, TypeError):
        pass  # no record, or a damaged one: train
    return None


def training_fingerprint(dataset: Dataset) -> str:
    """16 hexadecimal digits that change with anything a network learns from: the train and val scenes."""
    return Dataset(dataset.root, (*dataset.split("train"), *dataset.split("val"))).fingerprint()


def was_trained_on(dataset: Dataset, training: Mapping[str, Any]) -> bool:
    """Whether weights with a record of training were trained on what a dataset, and others beside it, now hold.

    Where another dataset that they learnt from is not at hand, the dataset's own scenes tell. A release may also ship
    weights that have learnt from other datasets alone: of these there is nothing to compare.
    """
    if (dataset.root / RELEASE_FILE).is_file() and training.get("dataset", dataset.name) != dataset.name:
        return True
    also = training.get("also", ())
    if also and not all((dataset.root.parent / name / "dataset.json").is_file() for name in also):
        return bool(training.get("own_fingerprint") == training_fingerprint(dataset))
    try:
        together = with_also(dataset, also)
    except (TableError, ConfigError):
        return False  # what lies there now cannot have been learnt from
    return bool(training.get("dataset_fingerprint") == training_fingerprint(together))
