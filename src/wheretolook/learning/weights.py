"""Trained weights on disk: one safetensors file that also holds what the input must look like."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from wheretolook.inputs.bins import InputStatistics
from wheretolook.learning.config import MATCHABILITY
from wheretolook.utils.errors import WeightsError

FORMAT_VERSION = 1
"""Version of the layout of the metadata."""

MLP = "mlp"
"""Kind of weights without a kind in their header."""

METADATA_KEY = "wheretolook"
"""Key of the JSON text in the header of the file."""


def write_weights(path: str | Path, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Write tensors and a description (JSON values) as one safetensors file, atomically. The same give the same bytes.

    Args:
        path: file to write; its folder is made when needed.
        tensors: by name, on any device.
        header: the description; "kind" names the method that the weights serve.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"format_version": FORMAT_VERSION, **header})
    partial = path.with_name(path.name + ".partial")
    # not by `save_file`, which makes a file that other users cannot read
    content = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    partial.write_bytes(save(content, metadata={METADATA_KEY: text}))
    os.replace(partial, path)


def check_kind(path: str | Path, header: Mapping[str, Any], kind: str) -> None:
    """Raise a WeightsError unless the description of weights says that they serve this method."""
    if header.get("kind", MLP) != kind:
        raise WeightsError(
            f"these weights are not of {kind}", path=path, value=header.get("kind", MLP),
            fix=f"Give weights of {kind}, or train them.",
        )  # fmt: skip


def read_training(path: str | Path) -> dict[str, Any]:
    """What `save_classifier` was told about the training.

    Raises:
        WeightsError: the file is missing, damaged or foreign.
    """
    return dict(read_weights(Path(path))[1].get("training", {}))


def read_record(path: str | Path) -> dict[str, Any]:
    """What the train stage wrote beside weights: "about", "weights_sha256", "run_id" and "metrics".

    Raises:
        WeightsError: it is missing or damaged.
    """
    beside = Path(path).with_suffix(".json")
    try:
        record = dict(json.loads(beside.read_text()))
        float(record["metrics"]["val_average_precision"]), record["about"]
        return record
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise WeightsError(
            f"the record of training is missing or damaged: {error}", path=beside, fix="Train again."
        ) from error


def best_weights(folder: str | Path) -> Path:
    """The weights of a folder with the best validation average precision; of matchability none, which scores no views.

    Raises:
        WeightsError: there are none, or a record of training is missing or damaged.
    """
    scorers = [path for path in sorted(Path(folder).glob("*.safetensors")) if path.stem != MATCHABILITY]
    if not scorers:
        raise WeightsError("there are no weights of a scorer", path=folder, fix="Run the train stage first.")
    return max(scorers, key=lambda path: float(read_record(path)["metrics"]["val_average_precision"]))


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


def stored_statistics(stored: Mapping[str, Any]) -> InputStatistics:
    """Input statistics from a header."""
    return InputStatistics(tuple(stored["channels"]), tuple(stored["mean"]), tuple(stored["std"]))
