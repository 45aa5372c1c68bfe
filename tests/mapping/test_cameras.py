"""Poses of mapping images: stored, read back, and read from the COLMAP model where there is no file of them."""

import numpy as np
import pytest

from synthetic_dataset import CAMERA, make_mapping_poses, make_scene
from wheretolook.mapping.colmap_model import load_mapping_poses, save_mapping_poses
from wheretolook.utils.errors import MapError


@pytest.fixture
def scene(tmp_path):
    """A scene without a COLMAP model, as of a release."""
    return make_scene(tmp_path / "scene", "train", seed=0, n_locations=3, n_directions=4, n_landmarks=20)


def test_poses_come_back_from_disk_and_give_the_same_bytes(tmp_path):
    poses = make_mapping_poses(3)
    path = tmp_path / "cameras.npz"
    save_mapping_poses(poses, path)
    np.testing.assert_array_equal(load_mapping_poses(path), poses.astype(np.float32))
    content = path.read_bytes()
    save_mapping_poses(load_mapping_poses(path), path)
    assert path.read_bytes() == content and [file.name for file in tmp_path.iterdir()] == ["cameras.npz"]


def test_poses_are_unknown_without_a_file(scene):
    stored = scene.localization_map(CAMERA).mapping_poses
    np.testing.assert_array_equal(stored, load_mapping_poses(scene.mapping_cameras))
    scene.mapping_cameras.unlink()
    assert scene.localization_map(CAMERA).mapping_poses is None


def test_invalid_files_are_rejected(scene):
    path = scene.mapping_cameras
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(MapError):
        scene.localization_map(CAMERA)
    path.unlink()
    with pytest.raises(MapError):
        load_mapping_poses(path)
