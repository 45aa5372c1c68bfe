"""Read and write trained weights: a safetensors file with a JSON header, and a JSON record of its training."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import SafetensorError, safe_open

from wheretolook.utils.errors import WeightsError
from wheretolook.utils.files import parse_json_object, read_json_object, write_bytes

if TYPE_CHECKING:
    from torch import Tensor

FORMAT_VERSION = 1  # of the header
METADATA_KEY = "wheretolook"  # of the header's JSON text in the safetensors metadata


def write_weights(path: str | Path, method: str, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Write tensors and a header of JSON values as one safetensors file, atomically; equal content, equal bytes."""
    from safetensors.torch import save

    text = json.dumps({"format_version": FORMAT_VERSION, **header, "method": method})
    # not by `save_file`, which makes a file that other users cannot read
    content = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_bytes(Path(path), save(content, metadata={METADATA_KEY: text}))


def read_weights(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the tensors of a weights file by name, and its header.

    Raises a WeightsError if the file is missing, damaged, of another program or of another version.
    """
    header = read_header(path)
    with _open_tensors(path, "pt") as file:
        names = file.keys()  # the file is no dict, whatever it looks like
        tensors = {name: file.get_tensor(name) for name in names}
    for name, tensor in tensors.items():
        # the coordinates in scene-adapted weights are far smaller
        if tensor.is_floating_point() and not (tensor.abs() <= 1e12).all():
            raise WeightsError("these weights are NaN or too large", path=path, value=name, fix="Train again.")
    return tensors, header


def read_header(path: Path) -> dict[str, Any]:
    """Return the header of a weights file, without loading its tensors or torch; raises as `read_weights`."""
    if not path.is_file():
        raise WeightsError("there are no weights", path=path, fix="Run the train command first, or correct the path.")
    with _open_tensors(path, "np") as file:
        metadata = file.metadata() or {}
    try:
        header = parse_json_object(metadata[METADATA_KEY])
        if header["format_version"] != FORMAT_VERSION:
            problem = f"this version of wheretolook reads weights of format {FORMAT_VERSION}"
            fix = "Install the version that wrote them."
            raise WeightsError(problem, path=path, value=header["format_version"], fix=fix)
        if not isinstance(header["method"], str) or not isinstance(header.get("training", {}), dict):
            raise ValueError("method is no text, or training is no object")
    except (KeyError, ValueError) as error:
        fix = "Give weights that the train command wrote."
        raise WeightsError(f"no header that wheretolook wrote: {error}", path=path, fix=fix) from error
    return header


@contextmanager
def _open_tensors(path: Path, framework: str) -> Iterator[Any]:
    try:
        with safe_open(path, framework=framework) as file:
            yield file
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"not a readable safetensors file: {error}", path=path, fix="Train again.") from error


def check_method_of_weights(path: str | Path, header: Mapping[str, Any], *methods: str) -> None:
    """Raise a WeightsError unless the header names one of these methods."""
    if header["method"] not in methods:
        problem = f"these weights are not of {' or '.join(methods)}"
        raise WeightsError(problem, path=path, value=header["method"], fix=f"Give weights of {methods[0]}.")


def method_of_weights(path: str | Path) -> str:
    """Return the name of the method that weights are of, such as "mlp-2d+z" or "set"."""
    return str(read_header(Path(path))["method"])


def read_training(path: str | Path) -> dict[str, Any]:
    """Return what the header of weights stores about their training."""
    return dict(read_header(Path(path)).get("training", {}))


def read_record(path: str | Path) -> dict[str, Any]:
    """Return the JSON record next to weights: "about", "weights_sha256", "run_id", "metrics".

    Raises a WeightsError if it is missing or damaged.
    """
    record_path = Path(path).with_suffix(".json")
    try:
        record = read_json_object(record_path)
        float(record["metrics"]["val_average_precision"])
        return record | {"about": dict(record["about"])}
    except (OSError, ValueError, TypeError, KeyError) as error:
        problem = f"the record of training is missing or damaged: {error}"
        raise WeightsError(problem, path=record_path, fix="Train again.") from error


def preference(path: str | Path) -> tuple[bool, float]:
    """Return a key that sorts weights: trained with many cameras first, then by validation average precision.

    The precision of those trained with many cameras is on harder views. Raises a WeightsError if the file or its record
    cannot be read.
    """
    many = read_header(Path(path)).get("camera", "") is None
    return many, float(read_record(path)["metrics"]["val_average_precision"])
