"""Damaged files of a dataset's own, each of valid JSON, NPZ or safetensors: the error is typed and names the file."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from wheretolook.mapping.colmap_model import load_mapping_poses
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.scorers.matchability.network import LandmarkNetwork
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.training.weights import METADATA_KEY, preference, read_training, read_weights, write_weights
from wheretolook.utils.errors import MapError, TableError, WeightsError
from wheretolook.visibility.occlusion import StoredOcclusion
from wheretolook_paper.scorers.sphere.network import SphereNetwork

N = 5  # landmarks


@pytest.mark.parametrize("header", ["5", "[1]", "null", '"a"', '{"format_version": 1, "training": 5}', "[" * 100_000])
def test_damaged_headers_of_weights(header: str, tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    save_file({"a": torch.zeros(3)}, path, metadata={METADATA_KEY: header})
    for read in (read_weights, read_training, preference):
        with pytest.raises(WeightsError):
            read(path)


@pytest.mark.parametrize("options", [None, 5, [1], "a"])
@pytest.mark.parametrize("network", [SetNetwork, SphereNetwork, LandmarkNetwork])
def test_damaged_options_of_weights(network: Any, options: object, tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    header = {"options": options, "camera": None, "features": [], "attributes": [], "statistics": {}}
    write_weights(path, "set", {"a": torch.zeros(3)}, header)
    with pytest.raises(WeightsError):
        TrainedNetwork.load(path, network, "set")


def test_weights_that_are_not_numbers(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    write_weights(path, "set", {"good": torch.zeros(3), "bad": torch.tensor([1, float("nan")]).half()}, {})
    with pytest.raises(WeightsError):
        read_weights(path)


OCCLUSION: dict[str, np.ndarray] = {
    "locations": np.zeros((2, 3)),
    "mask": np.zeros((2, 1), np.uint8),
    "n_landmarks": np.array(N),
    "model": np.array("mesh"),
}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("mask", np.zeros((2, 1))),
        ("mask", np.zeros((2, 1), bool)),
        ("mask", np.zeros((2, 2), np.uint8)),
        ("mask", np.zeros((3, 1), np.uint8)),
        ("mask", np.array(5, np.uint8)),
        ("mask", np.array("text")),
        ("locations", np.zeros(2)),
        ("locations", np.zeros((2, 2))),
        ("locations", np.full((2, 3), np.nan)),
        ("locations", np.array(["a", "b"])),
        ("locations", np.array(1.0)),
        ("n_landmarks", np.array(-1)),
        ("n_landmarks", np.array(5.5)),
        ("n_landmarks", np.array([5])),
        ("n_landmarks", np.array("5")),
    ],
)
def test_damaged_occlusion(name: str, value: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "occlusion.npz"
    np.savez(path, **OCCLUSION)
    assert StoredOcclusion.load(path).mask.shape == (2, N)
    np.savez(path, **{**OCCLUSION, name: value})
    with pytest.raises(TableError):
        StoredOcclusion.load(path)


def landmark_arrays() -> dict[str, np.ndarray]:
    floats = ("reprojection_error_px", "triangulation_angle_deg", "mapping_direction_spread", "mapping_distance_m")
    floats += ("mapping_distance_spread", "ambiguity", "mapping_focal_px")
    return {
        "ids": np.arange(N),
        "points": np.zeros((N, 3)),
        "track_length": np.ones(N, np.int32),
        "mapping_direction": np.ones((N, 3), np.float32),
        "descriptors": np.zeros((N, 128), np.uint8),
        **{name: np.ones(N, np.float32) for name in floats},
    }


@pytest.mark.parametrize("name", sorted(landmark_arrays()))
@pytest.mark.parametrize(
    "change",
    [
        lambda value: value.astype(str),
        lambda value: np.array(value.flat[0]),
        lambda value: value[..., None],
        lambda value: value[:-1],
    ],
    ids=["text", "scalar", "shape", "length"],
)
def test_damaged_landmarks(name: str, change: Callable[[np.ndarray], np.ndarray], tmp_path: Path) -> None:
    path = tmp_path / "landmarks.npz"
    arrays = landmark_arrays()
    np.savez(path, **arrays)
    assert len(Landmarks.load(path)) == N
    np.savez(path, **{**arrays, name: change(arrays[name])})
    with pytest.raises(MapError):
        Landmarks.load(path)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_landmarks_at_no_place(value: float, tmp_path: Path) -> None:
    path = tmp_path / "landmarks.npz"
    arrays = landmark_arrays()
    arrays["points"][2, 1] = value
    np.savez(path, **arrays)
    with pytest.raises(MapError):
        Landmarks.load(path)


@pytest.mark.parametrize("poses", [np.array("a"), np.array(5.0), np.full((1, 3, 4), "a"), np.full((1, 3, 4), np.nan)])
def test_damaged_poses_of_the_map(poses: np.ndarray, tmp_path: Path) -> None:
    np.savez(tmp_path / "cameras.npz", cam_from_world=poses)
    with pytest.raises(MapError):
        load_mapping_poses(tmp_path / "cameras.npz")


def test_good_weights_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    write_weights(path, "set", {"a": torch.full((3,), torch.inf)}, {"training": {"method": "set"}})
    tensors, header = read_weights(path)
    assert tensors["a"].isinf().all() and json.loads(json.dumps(header))["training"] == {"method": "set"}


@pytest.mark.parametrize("value", [1e20, -1e38])
def test_weights_that_are_too_large(value: float, tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    write_weights(path, "set", {"good": torch.full((3,), 500.0), "bad": torch.tensor([1, value])}, {})
    with pytest.raises(WeightsError):
        read_weights(path)
