"""Which weights score in the viewer: those given, or the place's own, or those that ship."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import wheretolook
from selection.room import WEIGHTS, write_room
from synthetic_dataset import make_dataset
from wheretolook.dataset.layout import Dataset
from wheretolook.scorers.adapted.network import AdaptedNetwork
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.training.provenance import training_fingerprint
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.utils.errors import WeightsError
from wheretolook.view.opened import find_opened, open_map


def save_adapted(path: Path, landmarks: np.ndarray) -> None:
    """Weights adapted to a place, known by some of its landmarks, that halve all log-odds."""
    base = TrainedNetwork.load(WEIGHTS / "set.safetensors", SetNetwork, "set")
    network = AdaptedNetwork(base.network, base.scale, base.offset, 1.0, 4.0, 1, 50)
    network.place[:] = torch.from_numpy(landmarks[:50])
    path.parent.mkdir(parents=True)
    TrainedNetwork("adapted", network, base.camera, 0.5, 0.0, base.training_range).save(path)


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return make_dataset(tmp_path / "rooms", ("train", "test"), n_locations=4, n_directions=5)


def test_weights_that_ship_score_where_there_are_no_others(dataset: Dataset, tmp_path: Path) -> None:
    opened = find_opened(tmp_path, "scene-1", "", None, None, "cpu")
    assert opened.methods[0] == "set" and {"visible", "mlp-2d+z", "expected-bins"} <= {*opened.methods}
    assert opened.weights.told("set") == "weights that ship: set.safetensors" and opened.weights.told("visible") == ""
    assert "adapted" not in opened.methods


def test_weights_adapted_to_a_scene_score_there_alone_unless_others_are_given(dataset: Dataset, tmp_path: Path) -> None:
    path = dataset.root / "adapted" / "scene-1.safetensors"
    save_adapted(path, dataset.scene("scene-1").read_landmarks().points)
    opened = find_opened(tmp_path, "scene-1", "", None, None, "cpu")
    assert opened.methods[0] == "adapted" and "set" in opened.methods
    assert opened.weights.told("adapted") == "weights adapted to this place: scene-1.safetensors"
    at = np.array([[0.0, 0.0, 1.2]])
    chances = [opened.look(name, "none", 30).scorer.score_around(at, np.eye(3)) for name in ("adapted", "set")]
    np.testing.assert_allclose(*(np.log(c / (1 - c)) * k for c, k in zip(chances, (2, 1), strict=True)), atol=1e-6)
    assert find_opened(tmp_path, "scene-0", "", None, None, "cpu").methods[0] == "set"
    assert find_opened(tmp_path, "scene-1", "", None, WEIGHTS / "set.safetensors", "cpu").methods[0] == "set"
    shutil.copy(path, path.with_name("scene-0.safetensors"))  # the scene was made anew since
    assert find_opened(tmp_path, "scene-0", "", None, None, "cpu").methods[0] == "set"
    path.write_bytes(b"damaged")
    assert find_opened(tmp_path, "scene-1", "", None, None, "cpu").methods[0] == "set"


def test_weights_that_a_dataset_has_trained_score_its_scenes(dataset: Dataset, tmp_path: Path) -> None:
    own = dataset.root / "weights"
    own.mkdir()
    base = TrainedNetwork.load(WEIGHTS / "set.safetensors", SetNetwork, "set")
    training = {"dataset": dataset.name, "dataset_fingerprint": training_fingerprint(dataset)}
    base.save(own / "set.safetensors", training)
    shutil.copy(WEIGHTS / "set.json", own)
    opened = find_opened(tmp_path, "scene-1", "", None, None, "cpu")
    assert opened.weights.files["set"] == own / "set.safetensors"
    assert opened.weights.told("set") == "weights trained with this dataset: set.safetensors"
    assert opened.weights.told("mlp-2d+z") == "weights that ship: mlp-2d+z.safetensors"
    base.save(own / "set.safetensors", training | {"dataset_fingerprint": "of what it was"})
    assert "that ship" in find_opened(tmp_path, "scene-1", "", None, None, "cpu").weights.told("set")


def test_weights_adapted_to_a_map_are_found_beside_its_check(tmp_path: Path) -> None:
    sparse = write_room(tmp_path / "house" / "sparse")
    assert open_map(sparse, data=tmp_path).methods[0] == "set"
    save_adapted(tmp_path / "checks" / "house" / "adapted.safetensors", open_map(sparse).landmarks.points)
    assert open_map(sparse, data=tmp_path).methods[0] == "adapted"


def test_weights_that_are_given_and_cannot_be_used_are_refused(tmp_path: Path) -> None:
    (tmp_path / "bad.safetensors").write_bytes(b"damaged")
    for given in (tmp_path / "bad.safetensors", tmp_path / "nowhere.safetensors"):
        with pytest.raises(WeightsError):
            open_map(write_room(tmp_path / f"{given.stem}"), weights=given)


def test_a_map_is_open_before_torch_and_warp_are_loaded(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from wheretolook.view.opened import open_map; "
        "from wheretolook.view.shared import Shared; from wheretolook.view.server import Viewer; "
        "import wheretolook.view.session, wheretolook.view.saving, wheretolook.view.player; "
        "shared = Shared(open_map(Path(sys.argv[1]))); print(shared.opened.methods[0]); "
        "print({'torch', 'warp', 'pandas', 'pyarrow'} & {*sys.modules} or 'none')"
    )
    command = [sys.executable, "-c", code, str(write_room(tmp_path / "sparse"))]
    here = {**os.environ, "PYTHONPATH": str(Path(wheretolook.__file__).parents[1])}
    told = subprocess.run(command, capture_output=True, text=True, check=True, env=here)
    assert told.stdout.split() == ["set", "none"], told.stdout
