"""A room mapped from some of its photographs, and extended by the others."""

import json
import shutil

import cv2
import h5py
import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from all_options import AllOptions, run
from mapping.marker_rooms import CAMERA, hand_held_poses, marker_room, take_photographs
from wheretolook.commands.map import BuildMap
from wheretolook.geometry.poses import camera_centers
from wheretolook.mapping.colmap_model import colmap_poses, read_model
from wheretolook.mapping.config import PhotographsConfig
from wheretolook.mapping.extended_map import extend_map
from wheretolook.mapping.feature_files import read_features
from wheretolook.mapping.georeference import fit_similarity
from wheretolook.mapping.map import Map
from wheretolook.mapping.photograph_map import map_photographs
from wheretolook.utils.errors import ConfigError, MapError

TRUTH = hand_held_poses()
CENTERS = dict(zip([f"photo-{index:02d}.png" for index in range(len(TRUTH))], camera_centers(TRUTH), strict=True))
NEW = [3, 4, 8, 11]
ELSEWHERE = "photo-99.png"


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Photographs of the map, of the same room, and of another place."""
    folder = tmp_path_factory.mktemp("room")
    names = take_photographs(marker_room(), TRUTH, folder / "old")
    (folder / "new").mkdir()
    for index in NEW:
        (folder / "old" / names[index]).rename(folder / "new" / names[index])
    elsewhere = np.random.default_rng(0).integers(0, 255, (360, 480, 3), dtype=np.uint8)
    cv2.imwrite(str(folder / "new" / ELSEWHERE), elsewhere)
    camera = {"camera_model": "SIMPLE_PINHOLE", "camera_params": (CAMERA.focal_px, CAMERA.cx, CAMERA.cy)}
    config = PhotographsConfig(folder / "old", **camera)
    map_photographs(config, folder / "map", folder / "photographs", progress=False)
    return folder


@pytest.fixture(scope="module")
def extended(folders, tmp_path_factory):
    out = tmp_path_factory.mktemp("extended") / "model"
    return out, extend_map(folders, PhotographsConfig(folders / "new"), out, progress=False)


def images_of(model):
    return {image.name: image for image in model.images.values() if image.has_pose}


def test_new_photographs_are_placed_and_old_ones_stay(extended, folders):
    out, report = extended
    before, after = read_model(folders / "map"), read_model(out)
    old, new = images_of(before), images_of(after)
    for name, image in old.items():
        assert_array_equal(new[name].cam_from_world().matrix(), image.cam_from_world().matrix())
        assert new[name].camera_id == image.camera_id
    assert [*after.cameras] == [*before.cameras]
    for number, camera in before.cameras.items():
        assert_array_equal(after.cameras[number].params, camera.params)
    assert report.n_placed == len(NEW) == len(new) - len(old)
    to_truth = fit_similarity([image.projection_center() for image in old.values()], [CENTERS[name] for name in old])
    for name in new.keys() - old.keys():
        assert np.linalg.norm(to_truth.apply(new[name].projection_center()[None])[0] - CENTERS[name]) < 0.02


def test_landmarks_grow(extended, folders):
    out, report = extended
    before, after = (dict(read_model(path).points3D) for path in (folders / "map", out))
    assert report.n_new_landmarks == len(after.keys() - before.keys()) > 100
    longer = [after[n].track.length() > before[n].track.length() for n in before if n in after]
    assert report.n_extended_landmarks == sum(longer) > 100
    assert np.ptp([after[number].color for number in after.keys() - before.keys()]) > 100


def test_a_photograph_of_another_place_is_reported(extended):
    out, report = extended
    assert [*report.unplaced] == [ELSEWHERE] and ELSEWHERE not in images_of(read_model(out))
    assert json.loads((out / "report.json").read_text())["unplaced"] == report.unplaced


def test_the_result_has_features_of_all_photographs_and_the_frame_of_the_map(extended, folders):
    out, _ = extended
    names = [*images_of(read_model(out))]
    kind, stored = read_features(out / "database.db", names, read_model(out))
    assert kind.name == "sift" and len(stored) == len(names)
    with pycolmap.Database.open(str(out / "database.db")) as database:
        assert database.num_images() == len(names) + 1 and database.num_inlier_matches() > 1000
    opened, before = Map.open_described(out), Map.open_described(folders / "map")
    assert opened.frame.world_from_map.scale == before.frame.world_from_map.scale == 1
    assert not opened.frame.is_turned and not opened.frame.scale.is_metric


@pytest.mark.parametrize(
    ("map_files", "new", "error"),
    [
        (["map", "photographs", "old"], {"a.png": ELSEWHERE}, MapError),  # nothing is placed
        (["map", "photographs", "old"], {"photo-00.png": ELSEWHERE, "photo-03.png": "photo-03.png"}, MapError),
        (["map", "photographs", "old"], {}, MapError),
        (["photographs"], {"photo-03.png": "photo-03.png"}, MapError),
    ],
)
def test_invalid_inputs_write_nothing(folders, tmp_path, map_files, new, error):
    for name in map_files:
        shutil.copytree(folders / name, tmp_path / "room" / name)
    (tmp_path / "new").mkdir()
    for name, source in new.items():
        shutil.copy(folders / "new" / source, tmp_path / "new" / name)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(error):
        extend_map(tmp_path / "room", PhotographsConfig(tmp_path / "new"), tmp_path / "out", progress=False)
    assert sorted(tmp_path.rglob("*")) == before


def test_the_map_itself_is_not_replaced(folders):
    new = PhotographsConfig(folders / "new")
    for out in (folders / "map", folders):
        with pytest.raises(ConfigError, match="replace the map"):
            extend_map(folders / "map", new, out, progress=False)


def test_without_features_or_photographs_nothing_can_be_matched(folders, tmp_path):
    shutil.copytree(folders / "map", tmp_path / "room")
    (tmp_path / "room" / "report.json").unlink()
    with pytest.raises(MapError):
        extend_map(tmp_path / "room", PhotographsConfig(folders / "new"), tmp_path / "out", progress=False)
    with pytest.raises(ConfigError):
        extend_map(folders, PhotographsConfig(), tmp_path / "out", progress=False)


def test_a_model_of_colmap_without_features_is_extended_by_its_photographs(folders, tmp_path):
    model = read_model(folders / "map")
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    model.write_text(str(tmp_path / "sparse" / "0"))
    shutil.copytree(folders / "old", tmp_path / "images")
    shutil.copytree(folders / "new", tmp_path / "new")
    (tmp_path / "new" / ELSEWHERE).unlink()
    shutil.copy(folders / "old" / "photo-00.png", tmp_path / "new")
    report = extend_map(tmp_path / "sparse/0", PhotographsConfig(tmp_path / "new"), tmp_path / "out", progress=False)
    assert report.n_placed == len(NEW) and report.skipped == ["photo-00.png"] and report.scale is None
    poses = images_of(read_model(tmp_path / "out"))
    for name, image in images_of(model).items():
        assert np.abs(poses[name].cam_from_world().matrix() - image.cam_from_world().matrix()).max() < 1e-9


def test_features_of_hloc_beside_the_extended_model_are_not_taken_for_its(folders, tmp_path):
    model = read_model(folders / "map")
    names = [image.name for _, image in sorted(model.images.items())]
    kind, stored = read_features(folders / "photographs" / "database.db", names)
    with h5py.File(tmp_path / "feats-sift.h5", "w") as file:
        for name, (pixels, descriptors) in zip(names, stored, strict=True):
            file[f"{name}/keypoints"] = (pixels - 0.5).astype(np.float16)
            file[f"{name}/descriptors"] = kind.restore(descriptors).T.astype(np.float16)
    shutil.copytree(folders / "map", tmp_path / "sfm", ignore=shutil.ignore_patterns("landmarks.npz", "report.json"))
    report = extend_map(tmp_path / "sfm", PhotographsConfig(folders / "new"), tmp_path / "more", progress=False)
    assert report.n_placed == len(NEW)
    assert len(Map.open_described(tmp_path / "more").landmarks) > model.num_points3D()


def test_a_scene_is_made_of_the_extended_map(folders, tmp_path):
    photographs = PhotographsConfig(folders / "new")
    options = AllOptions(
        name="more", data=tmp_path, device="cpu", source={"extend": folders, "photographs": photographs}
    )
    said = []
    run(BuildMap, options, said.append)
    (scene,) = [path.parent for path in tmp_path.rglob("extended")]
    assert any(ELSEWHERE in line for line in said)
    assert_allclose(colmap_poses(scene / "map"), colmap_poses(scene / "extended"), atol=1e-12)
    said.clear()
    run(BuildMap, options, said.append)
    assert sum("reusing" in line for line in said) == 1
