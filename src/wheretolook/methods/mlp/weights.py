"""The paper's network on disk and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.learning.weights import MLP, check_kind, read_weights, stored_statistics, write_weights
from wheretolook.methods.mlp.network import NetworkSpec, ViewpointNetwork
from wheretolook.utils.errors import ConfigError, WeightsError


def save_classifier(network: ViewpointNetwork, path: str | Path, training: Mapping[str, Any] | None = None) -> None:
    """Write weights, specification and input statistics as one safetensors file, atomically.

    The same network gives the same bytes.

    Args:
        network: what to write.
        path: file to write; its folder is made when needed.
        training: what else to keep about the training (JSON values), such as the dataset's fingerprint.
    """
    header = {**asdict(network.spec), "training": dict(training or {})}
    write_weights(path, network.layers.state_dict(), header)


def load_classifier(path: str | Path, device: str = "cpu") -> ViewpointNetwork:
    """Read what `save_classifier` wrote, ready to score (dropout off).

    Args:
        path: a safetensors file.
        device: torch device of the network.

    Raises:
        WeightsError: the file is missing, damaged, foreign, of another version, or does not fit its own description.
    """
    tensors, header = read_weights(Path(path))
    check_kind(path, header, MLP)
    network = ViewpointNetwork(_spec(Path(path), header))
    try:
        network.layers.load_state_dict(tensors)
    except RuntimeError as error:
        raise WeightsError(
            f"the weights do not fit the network they describe: {error}", path=path, fix="Train again."
        ) from error
    return network.to(device).eval().requires_grad_(False)


def _spec(path: Path, header: dict[str, Any]) -> NetworkSpec:
    try:
        return NetworkSpec(
            variant=header["variant"],
            camera=PinholeCamera(**header["camera"]),
            statistics=stored_statistics(header["statistics"]),
            bins=int(header["bins"]),
            layout=header["layout"],
            hidden=tuple(header["hidden"]),
            dropout=float(header["dropout"]),
            input_dropout=float(header["input_dropout"]),
        )
    except (KeyError, TypeError, ValueError, ConfigError) as error:
        raise WeightsError(f"damaged description in the header: {error}", path=path, fix="Train again.") from error
