"""Which weights score in the viewer: given, the scene's own, or bundled."""

import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch

from selection.room import WEIGHTS, write_room
from synthetic_dataset import make_dataset
from wheretolook.scorers.adapted.score import AdaptedNetwork
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.training.provenance import training_fingerprint
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.utils.errors import WeightsError
from wheretolook.view.viewed_map import open_map, open_scene

BASE = WEIGHTS / "set.safetensors"


def save_adapted(path, landmarks):
    """Save weights adapted to the scene of these landmarks that halve all log-odds."""
    base = TrainedNetwork.load(BASE, SetNetwork, "set")
    network = AdaptedNetwork(base.network, base.scale, base.offset, 50)
    network.place[:] = torch.from_numpy(landmarks[:50])
    path.parent.mkdir(parents=True)
    TrainedNetwork("adapted", network, base.camera, 0.5, 0.0, base.training_range).save(path)


@pytest.fixture
def dataset(tmp_path):
    return make_dataset(tmp_path / "rooms", ("train", "test"), n_locations=4, n_directions=5)


def viewed(dataset, scene, weights=None):
    return open_scene(dataset.root.parent, scene, "", None, weights, "cpu")


def test_adapted_weights_score_in_their_scene_only(dataset):
    path = dataset.root / "adapted" / "scene-1.safetensors"
    save_adapted(path, dataset.scene("scene-1").read_landmarks().points)
    shutil.copy(path, path.with_name("scene-0.safetensors"))  # of another scene
    scene = viewed(dataset, "scene-1")
    assert "adapted" in scene.weights.describe(scene.weights.methods[0])
    scorers = [scene.selector(name, "none", 30).scorer for name in ("adapted", "set")]
    adapted, base = (scorer.score_directions(np.array([[0.0, 0.0, 1.2]]), np.eye(3)) for scorer in scorers)
    np.testing.assert_allclose(2 * np.log(adapted / (1 - adapted)), np.log(base / (1 - base)), atol=1e-6)
    assert viewed(dataset, "scene-0").weights.methods[0] == "set"
    assert viewed(dataset, "scene-1", BASE).weights.methods[0] == "set"
    path.write_bytes(b"damaged")
    assert viewed(dataset, "scene-1").weights.methods[0] == "set"


def test_weights_trained_with_a_dataset_score_its_scenes(dataset):
    own = dataset.root / "weights" / "set.safetensors"
    own.parent.mkdir()
    base = TrainedNetwork.load(BASE, SetNetwork, "set")
    training = {"dataset": dataset.name, "dataset_fingerprint": training_fingerprint(dataset)}
    base.save(own, training)
    shutil.copy(WEIGHTS / "set.json", own.parent)
    assert viewed(dataset, "scene-1").weights.files["set"] == own
    base.save(own, training | {"dataset_fingerprint": "of other data"})
    assert viewed(dataset, "scene-1").weights.files["set"] != own


def test_weights_adapted_to_a_map(tmp_path):
    sparse = write_room(tmp_path / "house" / "sparse")
    save_adapted(tmp_path / "checks" / "house" / "adapted.safetensors", open_map(sparse).landmarks.points)
    assert open_map(sparse, data=tmp_path).weights.methods[0] == "adapted"
    with pytest.raises(WeightsError):
        open_map(sparse, weights=tmp_path / "nowhere.safetensors")


def test_a_map_opens_before_torch_and_warp_are_loaded(tmp_path):
    code = (
        "import sys; from pathlib import Path; from wheretolook.view.viewed_map import open_map; "
        "import wheretolook.view.server, wheretolook.view.page; open_map(Path(sys.argv[1])); "
        "assert not {'torch', 'warp', 'pandas', 'pyarrow'} & {*sys.modules}"
    )
    subprocess.run([sys.executable, "-c", code, str(write_room(tmp_path / "sparse"))], check=True)
