"""Folders exactly as hloc writes them (`hloc/README.md`)."""

import json
import shutil
import warnings
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from colmap_models import camera, model_of
from mapping.test_landmarks import hand_written_model
from wheretolook.cli import main
from wheretolook.mapping.colmap_model import model_arrays, read_model, write_model
from wheretolook.mapping.feature_files import read_descriptors
from wheretolook.mapping.map import Map, choose_features, find_features, find_mesh, find_photographs
from wheretolook.utils.errors import MapError, MapWarning
from wheretolook.utils.files import sha256
from wheretolook.utils.package import WEIGHTS, shipped

h5py = pytest.importorskip("h5py", reason="hloc's features need h5py: pip install h5py")

OUTPUTS = Path(__file__).parent / "hloc/outputs"
SFM = OUTPUTS / "sfm_aliked"
FEATURES = OUTPUTS / "feats-aliked-n16.h5"
N_LANDMARKS = 87  # as hloc's own summary of the model states


@pytest.fixture
def outputs(tmp_path):
    """A copy of hloc's folder that a test may change."""
    return Path(shutil.copytree(OUTPUTS, tmp_path / "outputs"))


def test_a_map_is_opened_with_the_features_that_hloc_wrote_beside_it():
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*(features|descriptors)", category=MapWarning)
        landmarks = Map.open(SFM).landmarks
    assert len(landmarks) == N_LANDMARKS and landmarks.features == "aliked"
    assert np.isfinite(landmarks.ambiguity).all()


def test_images_without_observations_need_no_features(outputs):
    model = read_model(SFM)
    unobserving = [image.name for image in model.images.values() if not image.num_points2D()]
    assert sorted(unobserving) == ["room/blurred-0.jpg", "room/blurred-1.jpg"]
    expected = read_descriptors(FEATURES, model, model_arrays(model))
    with h5py.File(outputs / FEATURES.name, "a") as file:
        for name in unobserving:
            del file[name]
    found = read_descriptors(outputs / FEATURES.name, model, model_arrays(model))
    assert found is not None
    np.testing.assert_array_equal(found[1], expected[1])


@pytest.mark.parametrize("missing", ["features", "database too"])
def test_features_that_are_not_found_are_reported(outputs, missing):
    (outputs / FEATURES.name).unlink()
    if missing == "database too":
        (outputs / "sfm_aliked/database.db").unlink()
    with pytest.warns(MapWarning, match="SIFT"):
        assert Map.open(outputs / "sfm_aliked").landmarks.features == ""


def test_of_several_files_the_one_of_the_model_is_found(outputs):
    shutil.copy(outputs / FEATURES.name, outputs / "feats-a-aliked-r512.h5")
    with h5py.File(outputs / "feats-a-aliked-r512.h5", "a") as file:
        for group in file["room"].values():
            group["keypoints"][:] += 3
    shutil.copy(FEATURES, outputs / "feats-aliked_matches-NN-mutual.h5")
    model = outputs / "sfm_aliked"
    assert find_features(model) == outputs / FEATURES.name
    (outputs / FEATURES.name).unlink()
    (model / "database.db").unlink()
    with pytest.warns(MapWarning, match="other keypoints"):
        assert choose_features(model, read_model(model)) is None


@pytest.mark.parametrize("model", ["sfm_aliked", "sfm_aliked/models/0"])
def test_images_and_features_are_found_above_the_model(outputs, model):
    folder = outputs / model
    shutil.copytree(SFM, folder, dirs_exist_ok=True)
    assert find_photographs(folder) is None
    image = outputs.parent / "images/room/00.jpg"
    image.parent.mkdir(parents=True)
    image.touch()
    assert find_photographs(folder) == outputs.parent / "images"
    assert find_features(folder) == outputs / FEATURES.name


def test_a_mesh_next_to_a_model_is_found_and_a_cloud_is_not(tmp_path):
    model = tmp_path / "dense" / "sparse"
    model.mkdir(parents=True)
    (tmp_path / "dense" / "fused.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nelement face 0\nend_header\n"
    )
    assert find_mesh(model) is None
    mesh = tmp_path / "dense" / "meshed.ply"
    mesh.write_text("ply\nformat ascii 1.0\nelement vertex 3\nelement face 1\nend_header\n")
    assert find_mesh(model) == mesh


def test_a_model_without_tracks_names_the_command_that_makes_them(tmp_path):
    model = model_of(
        [camera(1, "PINHOLE", 640, 480, 500, 500, 320, 240)], [("a.jpg", 1, np.eye(3, 4), np.zeros((1, 2)))]
    )
    model.add_point3D((0, 0, 3), pycolmap.Track(), (0, 0, 0))
    write_model(model, tmp_path)
    with pytest.raises(MapError, match=r"wheretolook map --model .* --images"):
        Map.open(tmp_path)


@pytest.mark.parametrize("as_text", [False, True])
@pytest.mark.parametrize("chosen, larger", [("sfm", "sfm/models/1"), ("sparse/0", "sparse/1")])
def test_a_larger_model_of_the_same_images_is_reported(tmp_path, chosen, larger, as_text):
    write_model(hand_written_model()[0], tmp_path / chosen)
    if as_text:
        (tmp_path / larger).mkdir(parents=True)
        read_model(SFM).write_text(str(tmp_path / larger))
    else:
        shutil.copytree(SFM, tmp_path / larger)
    with pytest.warns(MapWarning, match=larger):
        read_model(tmp_path / chosen)


def test_commands_report_and_use_the_features(tmp_path, capsys):
    out = tmp_path / "views.csv"
    assert main(["select", "--map", str(SFM), "--at", "0,0,1", "--out", str(out), "--directions", "20"]) == 0
    assert f"{FEATURES.name} (aliked)" in capsys.readouterr().out
    assert main(["export", "--map", str(SFM), "--out", str(tmp_path / "robot")]) == 0
    exported = json.loads((tmp_path / "robot/robot.json").read_text())["weights_sha256"]
    assert exported == sha256(shipped(WEIGHTS) / "aliked/set.safetensors")
    assert main(["map", "--name", "made", "--data", str(tmp_path), "--model", str(SFM)]) == 0
    assert f"{FEATURES.name} (aliked)" in capsys.readouterr().out
    from wheretolook.mapping.landmarks import Landmarks

    (path,) = tmp_path.glob("made/*/map/landmarks.npz")
    assert Landmarks.load(path).features == "aliked"
