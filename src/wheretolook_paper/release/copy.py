"""A release: a compact copy of a labelled dataset, weights trained on it, and a card.

A release is a dataset folder without meshes, COLMAP models and descriptors: it cannot be labelled again, but it is
read, trained on and evaluated like any other.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wheretolook.dataset.config import RELEASE_FILE
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.viewpoint_files import write_table
from wheretolook.mapping.colmap_model import CAMERAS_FILE, save_mapping_poses
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.scorers.registry import Method, learned, scorers
from wheretolook.training.provenance import was_trained_on, weights_path
from wheretolook.training.weights import preference, read_record, read_training, read_weights, write_weights
from wheretolook.utils.errors import ConfigError, StorageError, WeightsError
from wheretolook.utils.files import read_json_object, safe_child, sha256, write_json
from wheretolook.utils.package import VERSION
from wheretolook.visibility.occlusion import StoredOcclusion
from wheretolook_paper.styles import PAPER_NETWORKS, may_ship

CARD = "README.md"

SHELF = "others"
"""Folder next to the shipped weights for those of other methods. Only their records ship."""

MAX_BYTES = 16_000_000  # a release is smaller than this


def is_release(dataset: Dataset) -> bool:
    """Return whether a dataset is a release."""
    return (dataset.root / RELEASE_FILE).is_file()


def copy_dataset(dataset: Dataset, root: Path, settings: Mapping[str, Any]) -> Dataset:
    """Write a compact copy of a labelled dataset; equal datasets give equal bytes.

    It holds compact tables without matches, landmarks in half precision without descriptors, the poses of mapping
    images if known, the manifests of labels without their shards, and the dataset's settings as JSON values. Weights
    and results at `root` are kept; if the data changed, the card and the scores of networks that do not ship are
    removed.

    Raises:
        ConfigError: the release's folder holds another dataset, or a release of another one.
        TableError, MapError: a scene's table, landmarks or occlusion are missing or damaged.
    """
    before = _release_of(root, dataset.name)
    fingerprint = None if before is None else before.fingerprint()
    for scene in before.scenes if before is not None else ():
        scene.stage_cache("label").clear()  # until all is copied, nothing may train on it
    copied = [
        (scene, SceneFolder(safe_child(root, scene.name, "a scene's name"), scene.split, scene.camera))
        for scene in dataset.scenes
    ]
    for scene, copy in copied:
        copy.map.mkdir(parents=True, exist_ok=True)
        write_table(scene.read_table(), copy.table, compact=True)
        Landmarks.load(scene.landmarks).save(copy.landmarks, compact=True)
        StoredOcclusion.load(scene.occlusion).save(copy.occlusion)
        if (mapping_poses := scene.mapping_poses()) is None:
            copy.mapping_cameras.unlink(missing_ok=True)
        else:
            save_mapping_poses(mapping_poses, copy.mapping_cameras)
        copy.label_manifest.unlink(missing_ok=True)
        if scene.label_manifest.is_file():
            manifest = read_json_object(scene.label_manifest)
            omitted = ("shards", "store_matches", "store_pixels")
            write_json(copy.label_manifest, {k: value for k, value in manifest.items() if k not in omitted})
    source = {"source": dataset.name, "source_fingerprint": dataset.fingerprint()}
    write_json(root / RELEASE_FILE, {**source, "code_version": VERSION, "settings": dict(settings)})
    release = Dataset(root, tuple(copy for _, copy in copied))
    release.save()
    for scene in before.scenes if before is not None else ():
        if scene.name not in {copy.name for copy in release.scenes}:
            shutil.rmtree(scene.folder, ignore_errors=True)
    if release.fingerprint() != fingerprint:
        for outdated in (CARD, "results/variants.csv"):
            (root / outdated).unlink(missing_ok=True)
    return release


@dataclass(frozen=True)
class Choice:
    """The weights in a release's folder that ship, chosen by validation average precision."""

    network: Path  # the best of the paper's networks
    best: Path  # the best of all, the default; may be the network
    shelved: tuple[Path, ...]  # the rest
    precision: dict[str, float]  # of all, by their file's name without its ending


def trained_weights(release: Dataset) -> dict[Path, Method]:
    """Return the weights in a release's folder that score views by themselves, and their methods."""
    paths = {weights_path(release, name): method for name, method in learned().items() if name in scorers()}
    return {path: method for path, method in paths.items() if path.is_file()}


def choose_weights_to_ship(release: Dataset) -> Choice:
    """Choose the paper's network by validation average precision, and the best of all by `preference`.

    Raises WeightsError if the paper's network has no weights, or if weights or their record do not fit the release.
    """
    folder = release.root / "weights"
    fix = f"Run `wheretolook train --config configs/{release.name}.yaml`."
    precision: dict[Path, float] = {}
    methods = trained_weights(release)
    for path in methods:
        record = read_record(path)
        training = read_training(path)
        if record["about"] != training or not was_trained_on(release, training):
            raise WeightsError("these weights were not trained on this release", path=path, fix=fix)
        precision[path] = float(record["metrics"]["val_average_precision"])
    networks = [path for path, method in methods.items() if method.name in PAPER_NETWORKS]
    if not networks:
        raise WeightsError("there are no weights to ship of the paper's network", path=folder, fix=fix)
    network = max(networks, key=lambda path: precision[path])
    able = [path for path, method in methods.items() if path == network or may_ship(method.name)]
    best = max(able, key=preference)
    shelved = tuple(path for path in precision if path not in (network, best))
    return Choice(network, best, shelved, {path.stem: value for path, value in precision.items()})


def ship_weights(choice: Choice) -> None:
    """Convert the paper's network to half precision and move the weights that do not ship to `weights/others/`.

    A matchability model stays, because methods that weight landmarks need it. Repeating this changes nothing.
    """
    for path in choice.shelved:
        shelf = path.parent / SHELF
        shelf.mkdir(exist_ok=True)
        for file in (path, path.with_suffix(".json")):
            os.replace(file, shelf / file.name)
    record = read_record(choice.network)
    convert_to_float16(choice.network)
    write_json(choice.network.with_suffix(".json"), {**record, "weights_sha256": sha256(choice.network)})


def convert_to_float16(path: Path) -> None:
    """Rewrite a weights file in half precision, with the same header; one in half precision stays as it is."""
    tensors, header = read_weights(path)
    if any(tensor.is_floating_point() and tensor.element_size() > 2 for tensor in tensors.values()):
        halved = {name: tensor.half() if tensor.is_floating_point() else tensor for name, tensor in tensors.items()}
        header.pop("format_version")
        write_weights(path, header["method"], halved, header)


def sizes(root: Path, weights: bool = True) -> dict[str, int]:
    """Return the bytes of the release at `root` by kind of file, without figures and weights of other methods.

    Without `weights`, no weights are counted. Raises StorageError if the release is not smaller than `MAX_BYTES`.
    """
    kinds = {"viewpoints.parquet": "tables", "landmarks.npz": "landmarks", CAMERAS_FILE: "cameras"}
    kinds["occlusion.npz"] = "occlusion"
    parts = dict.fromkeys((*kinds.values(), "weights", "text"), 0)
    for path in root.rglob("*"):
        shelved = path.suffix == ".safetensors" and (path.parent.name == SHELF or not weights)
        drawn = path.suffix in (".png", ".partial", ".lock") or path.parent == root / "results" / "figures"
        if path.is_file() and not shelved and not drawn:
            parts["weights" if path.suffix == ".safetensors" else kinds.get(path.name, "text")] += path.stat().st_size
    if sum(parts.values()) >= MAX_BYTES:
        problem = f"the release is not smaller than {MAX_BYTES / 1e6:.0f} MB: {size_text(parts)}"
        raise StorageError(problem, path=root, fix="Label fewer viewpoints or scenes, or map with fewer landmarks.")
    return parts


def size_text(parts: Mapping[str, int]) -> str:
    """Format sizes: "tables 4.81 MB, ..., in all 13.20 MB"."""
    return ", ".join(f"{name} {size / 1e6:.2f} MB" for name, size in {**parts, "in all": sum(parts.values())}.items())


def read_about(release: Dataset) -> dict[str, Any]:
    """Return source, source_fingerprint, code_version and settings of a release.

    Raises ConfigError if the file is missing or damaged.
    """
    path = release.root / RELEASE_FILE
    try:
        about = read_json_object(path)
        return {name: about[name] for name in ("source", "source_fingerprint", "code_version", "settings")}
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(f"this is no release made by `wheretolook release`: {error}", path=path) from error


def _release_of(root: Path, source: str) -> Dataset | None:
    """Return the existing release at `root`, which must have the same source; None without one."""
    if not (root / "dataset.json").is_file():
        return None
    release = Dataset.load(root)
    fix = "Move it elsewhere first."
    if not is_release(release):
        raise ConfigError("this dataset is no release and would be overwritten", path=root, fix=fix)
    if read_about(release)["source"] != source:
        raise ConfigError(f"this is the release of another dataset than {source}", path=root, fix=fix)
    return release
