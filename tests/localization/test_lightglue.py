"""Queries are matched by LightGlue with the mapping images that see most of what they show."""

import shutil

import numpy as np
import pytest

from holdout.corridor import write_corridor
from wheretolook.features.extractor import KINDS, Keypoints
from wheretolook.geometry.camera import cameras_by_id
from wheretolook.geometry.poses import pose_error
from wheretolook.holdout.holdout import choose_blocks, hold_out_blocks
from wheretolook.holdout.photo_map import open_map
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.localizer import Localizer
from wheretolook.mapping.colmap_model import colmap_poses, read_model
from wheretolook.mapping.config import FrameOptions
from wheretolook.mapping.feature_files import read_features
from wheretolook.mapping.landmarks import load_colmap_landmarks
from wheretolook.utils.errors import MapError, WeightsError

KIND = KINDS["aliked"]


def nearest_neighbour_weights(path):
    """Weights with which LightGlue's layers change nothing, and its assignment finds mutual nearest neighbours."""
    torch = pytest.importorskip("torch")
    kornia = pytest.importorskip("kornia.feature", reason="LightGlue needs kornia: pip install kornia")
    settings = {name: value for name, value in kornia.LightGlue.features["aliked"].items() if name != "weights"}
    state = kornia.LightGlue(features=None, **settings).state_dict()
    for name, value in state.items():
        if name.endswith(("ffn.3.weight", ".bias")):
            value.zero_()
        if name == "input_proj.weight":
            value.copy_(torch.eye(*value.shape))
        if name.endswith("final_proj.weight"):
            value.copy_(40 * torch.eye(len(value)))
        if name.endswith("matchability.weight"):
            value.zero_()
        if name.endswith("matchability.bias"):
            value.fill_(10.0)
    torch.save(state, path)
    return path


@pytest.fixture(scope="module")
def corridor(tmp_path_factory):
    """A map's folder with its database, of ALIKED's kind of descriptors."""
    sparse, database = write_corridor(tmp_path_factory.mktemp("aliked"), kind=KIND)
    shutil.copy(database, sparse / "database.db")
    return sparse


def test_a_query_is_localized_by_the_images_that_see_the_same(corridor, tmp_path):
    weights = nearest_neighbour_weights(tmp_path / "aliked_lightglue.pth")
    landmarks = load_colmap_landmarks(corridor, corridor / "database.db")
    model = read_model(corridor)
    camera = cameras_by_id(model.cameras, corridor)[1]
    _, ((pixels, descriptors),) = read_features(corridor / "database.db", ["010.jpg"])
    query = Keypoints(pixels, KIND.restore(descriptors))
    config = LocalizerConfig(lightglue=str(weights))
    localizer = Localizer(landmarks, camera, config, map_dir=corridor)
    (matches,) = localizer.match([query])
    keypoints, rows, *_ = matches
    assert (np.diff(keypoints) > 0).all() and len(set(rows.tolist())) == len(rows)
    of_image = model.images[11].points2D
    true = {k: point.point3D_id for k, point in enumerate(of_image) if point.has_point3D()}
    right = [true.get(k) == number for k, number in zip(keypoints.tolist(), landmarks.ids[rows].tolist(), strict=True)]
    assert len(rows) > 50 and np.mean(right) > 0.95
    found = localizer.estimate(query, matches)
    error_m, error_deg = pose_error(found.cam_from_world, colmap_poses(corridor)[10])
    assert found.status == "localized" and error_m < 0.02 and error_deg < 0.3
    nothing = Keypoints.none(KIND.dimension)
    assert [len(part) for part in localizer.match([nothing])[0]] == [0, 0, 0, 0]


def test_weights_for_other_features_are_an_error_though_their_tensors_fit(corridor, tmp_path):
    """DISK's file is known by the first weight of its positional encoding."""
    torch = pytest.importorskip("torch")
    weights = nearest_neighbour_weights(tmp_path / "disk_lightglue.pth")
    state = torch.load(weights)
    state["posenc.Wr.weight"][0, 0] = -0.6789149045944214
    torch.save(state, weights)
    landmarks = load_colmap_landmarks(corridor, corridor / "database.db")
    camera = cameras_by_id(read_model(corridor).cameras, corridor)[1]
    with pytest.raises(WeightsError, match=r"disk_lightglue\.pth: .* weights for disk, but the map has aliked"):
        Localizer(landmarks, camera, LocalizerConfig(lightglue=str(weights)), map_dir=corridor)


def test_held_out_photographs_of_a_map_of_learned_features_are_localized(corridor, tmp_path):
    """As `check` does, by what the database holds: nothing is extracted."""
    source = open_map(corridor, corridor / "database.db", frame=FrameOptions(scale=1))
    block = min(choose_blocks(source), key=lambda block: len(block.held_out))
    (found,) = hold_out_blocks(source, tmp_path, [block])
    assert found.landmarks.features == "aliked"
    assert found.views["good"].mean() > 0.5 and (found.views["n_matches"] > 20).any()


def test_the_features_of_mapping_images_may_be_in_another_file(corridor, tmp_path):
    """hloc keeps them in HDF5; a missing file is an error that names it."""
    weights = nearest_neighbour_weights(tmp_path / "aliked_lightglue.pth")
    landmarks = load_colmap_landmarks(corridor, corridor / "database.db")
    camera = cameras_by_id(read_model(corridor).cameras, corridor)[1]
    _, ((pixels, descriptors),) = read_features(corridor / "database.db", ["010.jpg"])
    query = Keypoints(pixels, KIND.restore(descriptors))
    config = LocalizerConfig(lightglue=str(weights))
    other = tmp_path / "features.db"
    shutil.copy(corridor / "database.db", other)
    by_database, by_file = (
        Localizer(landmarks, camera, config, map_dir=corridor, features=features).match([query])[0]
        for features in (None, other)
    )
    np.testing.assert_array_equal(by_file.landmarks, by_database.landmarks)
    localizer = Localizer(landmarks, camera, config, map_dir=corridor)
    among = localizer.match_among(query, np.arange(len(landmarks)))
    np.testing.assert_array_equal(among.landmarks, localizer.match_descriptors([query])[0].landmarks)
    with pytest.raises(MapError, match=r"missing\.h5"):
        Localizer(landmarks, camera, config, map_dir=corridor, features=tmp_path / "missing.h5")
