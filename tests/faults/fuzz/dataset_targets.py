"""Files of a dataset and of a release: descriptions, tables, occlusion, weights."""

from __future__ import annotations

import json
import warnings
from functools import cache
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save, save_file

from faults.fuzz.execution import Target
from synthetic_dataset import CAMERA, make_landmarks, make_scene
from wheretolook.dataset.layout import STAGES, Dataset, SceneFolder
from wheretolook.dataset.viewpoint_table import has_matches, read_table, write_table
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.stages.preconditions import extractor_of
from wheretolook.training.provenance import trained_before
from wheretolook.training.weights import METADATA_KEY, preference, read_training, read_weights
from wheretolook.visibility.occlusion import NoOcclusion, StoredOcclusion
from wheretolook.weights.resolve import load_scorer
from wheretolook_paper.release.copy import _manifest, read_about
from wheretolook_paper.scorers.pooled_features import POOLED
from wheretolook_paper.scorers.trees.learn import BoostedTrees

_WEIGHTS = Path(__file__).parents[3] / "data" / "release" / "weights"


def _descriptions(folder: Path) -> None:
    scenes = [{"name": "a", "split": "train"}, {"name": "b", "split": "test", "own_camera": True}]
    camera = {"width": 64, "height": 48, "focal_px": 32.0}
    write = {
        "dataset.json": {"camera": camera, "scenes": scenes},
        "own/dataset.json": {"scenes": [{"name": "a", "split": "val", "camera": {
            "model": "OPENCV", "width": 64, "height": 48, "params": [32, 32, 32, 24, 0, 0, 0, 0]}}]},
        "release.json": {"source": "a", "source_fingerprint": "0", "code_version": "1", "settings": {"a": [1]}},
        "stages.json": dict.fromkeys(STAGES, "0123456789abcdef"),
        "labels.json": {"shards": [], "config": {"a": 1}},
        "scene.json": {"mapped_floor": [[0, 0, 1, 1.5]]},
        "map/report.json": {"config": {"extractor": {"max_keypoints": 100}}, "has_descriptors": True},
        "set.json": {"about": {"method": "set"}, "weights_sha256": "0", "run_id": "0",
                     "metrics": {"val_average_precision": 0.5}},
    }  # fmt: skip
    for name, content in write.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(json.dumps(content))


def _read_description(path: Path) -> None:
    scene = SceneFolder(path.parent, "train")
    if path.name == "dataset.json":
        found = Dataset.load(path.parent)
        found.fingerprint()
        assert all(scene.folder.parent == found.root for scene in found.scenes)
    elif path.name == "release.json":
        read_about(Dataset(path.parent, ()))
    elif path.name == "stages.json":
        scene.stage_cache("map").clear()
        scene.stage_cache("label", "0").store()
    elif path.name == "labels.json":
        _manifest(path)
    elif path.name == "scene.json":
        scene.mapped_floor()
    elif path.name == "report.json":
        extractor_of(SceneFolder(path.parent.parent, "train"))
    else:
        from wheretolook.training.weights import read_record

        trained_before(path.with_suffix(".safetensors"), {})
        read_record(path)


def _tables(folder: Path) -> None:
    scene = make_scene(folder / "scene", "train", 0, n_locations=2, n_directions=3, n_landmarks=10)
    table = read_table(scene.table)
    write_table(table, folder / "a.parquet")
    write_table(table, folder / "compact.parquet", compact=True)
    rows = [np.arange(3, dtype=np.int32)] * len(table)
    write_table(table.assign(camera_id=1, matched_rows=rows, inlier_rows=rows), folder / "matches.parquet")
    StoredOcclusion.load(scene.occlusion).save(folder / "occlusion.npz")


def _read_any_table(path: Path) -> None:
    if path.suffix == ".npz":
        occlusion = StoredOcclusion.load(path)
        if len(occlusion.locations):
            occlusion.unoccluded(occlusion.locations[:1], np.zeros((occlusion.n_landmarks, 3)))
        return
    read_table(path, has_matches(path))


def _weights(folder: Path) -> None:
    header = {"format_version": 1, "method": "set", "camera": None, "training": {"method": "set"}}
    tensors = {"a": torch.arange(3.0), "b": torch.zeros((2, 2), dtype=torch.float16)}
    save_file(tensors, folder / "a.safetensors", metadata={METADATA_KEY: json.dumps(header)})
    (folder / "a.json").write_text(json.dumps({"about": {"method": "set"}, "metrics": {"val_average_precision": 0.5}}))


def _read_weights(path: Path) -> None:
    read_weights(path)
    read_training(path)
    preference(path)


@cache
def _tensors(name: str):
    return read_weights(_WEIGHTS / f"{name}.safetensors")


@cache
def _map() -> LocalizationMap:
    return LocalizationMap(make_landmarks(np.random.default_rng(0), 30), CAMERA, NoOcclusion())


def _trees(folder: Path) -> None:
    nodes = {"roots": [0], "feature": [0, 0, 0], "left": [1, 1, 2], "right": [2, 1, 2]}
    arrays = {name: torch.tensor(values) for name, values in nodes.items()}
    arrays |= {"threshold": torch.zeros(3), "value": torch.tensor([0.0, -1, 1]), "missing_left": torch.ones(3).bool()}
    numbers = {"depth": 1, "baseline": 0.0, "scale": 1.0, "offset": 0.0}
    BoostedTrees(None, **arrays, **numbers).save(folder / "a.safetensors")


def _read_trees(path: Path) -> None:
    assert BoostedTrees.load(path).logits(torch.ones((2, len(POOLED)))).shape == (2,)


def _headers(folder: Path) -> None:
    torch.set_num_threads(1)
    for name in ("set", "mlp-2d+z"):
        (folder / f"{name}.json").write_text(json.dumps(_tensors(name)[1]))


def _read_header(path: Path) -> None:
    weights = path.with_suffix(".safetensors")
    text = path.read_bytes().decode(errors="replace")
    weights.write_bytes(save(_tensors(path.stem)[0], metadata={METADATA_KEY: text}))
    with warnings.catch_warnings():
        scorer = load_scorer(weights, _map())
        scores = scorer.score(poses_looking_along(np.zeros((2, 3)), np.eye(3)[:2]))
    assert scores.shape == (2,)


_DESCRIPTIONS = ("dataset.json", "own/dataset.json", "release.json", "stages.json", "labels.json", "scene.json")

TARGETS = (
    Target("descriptions", _descriptions, (*_DESCRIPTIONS, "map/report.json", "set.json"), _read_description),
    Target("tables", _tables, ("a.parquet", "compact.parquet", "matches.parquet"), _read_any_table),
    Target("occlusion", _tables, ("occlusion.npz",), _read_any_table),
    Target("weights", _weights, ("a.safetensors",), _read_weights),
    Target("trees", _trees, ("a.safetensors",), _read_trees),
    Target("weights-header", _headers, ("set.json", "mlp-2d+z.json"), _read_header),
)
