"""Trained weights on disk: one safetensors file that also holds what the input must look like."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from wheretolook.errors import ConfigError, WeightsError
from wheretolook.geometry import PinholeCamera
from wheretolook.learning.network import InputStatistics, NetworkSpec, ViewpointNetwork

FORMAT_VERSION = 1
"""Version of the layout of the metadata."""

MLP = "mlp"
"""Kind of weights without a kind in their header."""

METADATA_KEY = "wheretolook"
"""Key of the JSON text in the header of the file."""


def save_classifier(network: ViewpointNetwork, path: str | Path, training: Mapping[str, Any] | None = None) -> None:
    """Write weights, specification and input statistics as one safetensors file, atomically.

    The same network gives the same bytes.

    Args:
        network: what to write.
        path: file to write; its folder is made when needed.
        training: what else to keep about the training (JSON values), such as the dataset's fingerprint.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"format_version": FORMAT_VERSION, **asdict(network.spec), "training": dict(training or {})}
    partial = path.with_name(path.name + ".partial")
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in network.layers.state_dict().items()}
    # not by `save_file`, which makes a file that other users cannot read
    partial.write_bytes(save(tensors, metadata={METADATA_KEY: json.dumps(header)}))
    os.replace(partial, path)


def load_classifier(path: str | Path, device: str = "cpu") -> ViewpointNetwork:
    """Read what `save_classifier` wrote, ready to score (dropout off).

    Args:
        path: a safetensors file.
        device: torch device of the network.

    Raises:
        WeightsError: the file is missing, damaged, foreign, of another version, or does not fit its own description.
    """
    tensors, header = read_weights(Path(path))
    if header.get("kind", MLP) != MLP:
        fix = "Give weights of a network."
        raise WeightsError("these weights are no network's", path=path, value=header["kind"], fix=fix)
    network = ViewpointNetwork(_spec(Path(path), header))
    try:
        network.layers.load_state_dict(tensors)
    except RuntimeError as error:
        raise WeightsError(
            f"the weights do not fit the network they describe: {error}", path=path, fix="Train again."
        ) from error
    return network.to(device).eval().requires_grad_(False)


def read_training(path: str | Path) -> dict[str, Any]:
    """What `save_classifier` was told about the training.

    Raises:
        WeightsError: the file is missing, damaged or foreign.
    """
    return dict(read_weights(Path(path))[1].get("training", {}))


def weights_kind(path: str | Path) -> str:
    """The method that a weights file serves, such as "mlp" or "trees".

    Raises:
        WeightsError: the file is missing, damaged or foreign.
    """
    return str(read_weights(Path(path))[1].get("kind", MLP))


def read_weights(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Tensors of a weights file by name, and the description in its header.

    Raises:
        WeightsError: the file is missing, damaged, foreign or of another version.
    """
    if not path.is_file():
        raise WeightsError("there are no weights", path=path, fix="Run the train stage first, or correct the path.")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            names = file.keys()  # the file is no dict, whatever it looks like
            tensors = {name: file.get_tensor(name) for name in names}
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"not a readable safetensors file: {error}", path=path, fix="Train again.") from error
    if METADATA_KEY not in metadata:
        fix = "Give weights that the train stage wrote."
        raise WeightsError("these weights were not written by wheretolook", path=path, fix=fix)
    try:
        header = dict(json.loads(metadata[METADATA_KEY]))
    except ValueError as error:
        raise WeightsError(f"damaged description in the header: {error}", path=path, fix="Train again.") from error
    if header.get("format_version") != FORMAT_VERSION:
        raise WeightsError(
            f"this version of wheretolook reads weights of format {FORMAT_VERSION}",
            path=path,
            value=header.get("format_version"),
            fix="Train again, or install the version that wrote them.",
        )
    return tensors, header


def _spec(path: Path, header: dict[str, Any]) -> NetworkSpec:
    try:
        stored = header["statistics"]
        statistics = InputStatistics(tuple(stored["channels"]), tuple(stored["mean"]), tuple(stored["std"]))
        return NetworkSpec(
            variant=header["variant"],
            camera=PinholeCamera(**header["camera"]),
            statistics=statistics,
            bins=int(header["bins"]),
            layout=header["layout"],
            hidden=tuple(header["hidden"]),
            dropout=float(header["dropout"]),
            input_dropout=float(header["input_dropout"]),
        )
    except (KeyError, TypeError, ValueError, ConfigError) as error:
        raise WeightsError(f"damaged description in the header: {error}", path=path, fix="Train again.") from error
