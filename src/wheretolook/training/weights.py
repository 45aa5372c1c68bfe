"""Trained weights on disk: one safetensors file that also holds what the input must look like."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import SafetensorError, safe_open

from wheretolook.training.old_names import name_of_header, with_name
from wheretolook.utils.errors import WeightsError
from wheretolook.utils.files import write_bytes
from wheretolook.utils.reading import parse_json_object, read_json_object

if TYPE_CHECKING:
    from torch import Tensor

FORMAT_VERSION = 1  # version of the layout of the metadata
MOST = 1e12
"""What no finite weight exceeds in size. Places that adapted weights know have coordinates of a planet at most."""

METADATA_KEY = "wheretolook"  # key of the JSON text in the header of the file


def write_weights(path: str | Path, method: str, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Write tensors and a description (JSON values) as one safetensors file, atomically. The same give the same bytes.

    Of the description "camera" is that of the training views, "training" what is known of the training.
    """
    from safetensors.torch import save

    text = json.dumps({"format_version": FORMAT_VERSION, **header, "method": method})
    # not by `save_file`, which makes a file that other users cannot read
    content = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_bytes(Path(path), save(content, metadata={METADATA_KEY: text}))


def check_serves(path: str | Path, header: Mapping[str, Any], *methods: str) -> None:
    """Raise a WeightsError unless the description of weights says that they serve one of these methods."""
    found = name_of_header(header)
    if found not in methods:
        fix = f"Give weights of {methods[0]}, or train them."
        raise WeightsError(f"these weights are not of {' or '.join(methods)}", path=path, value=found, fix=fix)


def read_training(path: str | Path) -> dict[str, Any]:
    """What the train stage has written into the header of weights about their training; see `read_weights`."""
    return with_name(read_weights(Path(path))[1].get("training", {}))


def features_of_weights(path: str | Path) -> list[str]:
    """Names of the features of the maps that weights have learnt from; see `read_weights`."""
    return list(read_training(path).get("features", ["sift"]))


def read_record(path: str | Path) -> dict[str, Any]:
    """The record beside weights: "about", "weights_sha256", "run_id", "metrics". WeightsError if missing or damaged."""
    beside = Path(path).with_suffix(".json")
    try:
        record = read_json_object(beside)
        float(record["metrics"]["val_average_precision"])
        return record | {"about": with_name(record["about"])}
    except (OSError, ValueError, TypeError, KeyError) as error:
        problem = f"the record of training is missing or damaged: {error}"
        raise WeightsError(problem, path=beside, fix="Train again.") from error


def method_of_weights(path: str | Path) -> str:
    """The name of the method that weights serve, such as "mlp-2d+z" or "set"; see `read_header`."""
    return name_of_header(read_header(Path(path)))


def preference(path: str | Path) -> tuple[bool, float]:
    """What the best of several weights has most of: many cameras learnt with, then validation average precision.

    Those that have learnt with many cameras come before all that know one: their precision is that on harder views.
    Raises a WeightsError if the file or its record cannot be read.
    """
    many = read_header(Path(path)).get("camera", "") is None
    return many, float(read_record(path)["metrics"]["val_average_precision"])


def save_in_half(path: Path) -> None:
    """Store weights in half precision, atomically, with the same description. Done again, nothing changes."""
    tensors, header = read_weights(path)
    if any(tensor.is_floating_point() and tensor.element_size() > 2 for tensor in tensors.values()):
        halved = {name: tensor.half() if tensor.is_floating_point() else tensor for name, tensor in tensors.items()}
        header.pop("format_version")
        write_weights(path, name_of_header(header), halved, header)


def read_weights(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Tensors of a weights file by name, and the description in its header.

    Raises a WeightsError if the file is missing, damaged, foreign or of another version.
    """
    header = read_header(path)
    try:
        with safe_open(path, framework="pt") as file:
            names = file.keys()  # the file is no dict, whatever it looks like
            tensors = {name: file.get_tensor(name) for name in names}
    except (SafetensorError, OSError) as error:
        raise _unreadable(path, error) from error
    unknown = next((name for name, x in tensors.items() if x.is_floating_point() and bool(x.isnan().any())), None)
    if unknown is not None:
        raise WeightsError("these weights are not numbers (NaN)", path=path, value=unknown, fix="Train again.")
    finite = {name: x[x.isfinite()] for name, x in tensors.items() if x.is_floating_point()}
    large = next((name for name, x in finite.items() if bool((x.abs() > MOST).any())), None)
    if large is not None:
        raise WeightsError("these weights are too large: they are damaged", path=path, value=large, fix="Train again.")
    return tensors, header


def _unreadable(path: Path, error: Exception) -> WeightsError:
    return WeightsError(f"not a readable safetensors file: {error}", path=path, fix="Train again.")


def read_header(path: Path) -> dict[str, Any]:
    """The description in the header of a weights file. Its tensors are not read, nor torch loaded.

    Raises a WeightsError if the file is missing, damaged, foreign or of another version.
    """
    if not path.is_file():
        raise WeightsError("there are no weights", path=path, fix="Run the train stage first, or correct the path.")
    try:
        with safe_open(path, framework="np") as file:
            metadata = file.metadata() or {}
    except (SafetensorError, OSError) as error:
        raise _unreadable(path, error) from error
    if METADATA_KEY not in metadata:
        fix = "Give weights that the train stage wrote."
        raise WeightsError("these weights were not written by wheretolook", path=path, fix=fix)
    try:
        header = parse_json_object(metadata[METADATA_KEY])
    except ValueError as error:
        raise WeightsError(f"damaged description in the header: {error}", path=path, fix="Train again.") from error
    if (found := header.get("format_version")) != FORMAT_VERSION:
        problem = f"this version of wheretolook reads weights of format {FORMAT_VERSION}"
        fix = "Train again, or install the version that wrote them."
        raise WeightsError(problem, path=path, value=found, fix=fix)
    if not isinstance(header.get("training", {}), dict):
        problem = "damaged description in the header: what is known of the training is no JSON object"
        raise WeightsError(problem, path=path, value=header["training"], fix="Train again.")
    return header
