"""Maps of learned features: from databases of COLMAP 4 and hloc's HDF5, on disk again, and localized against."""

from __future__ import annotations

import re
import shutil
import sqlite3
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapping.test_landmarks import hand_written_model
from mapping.test_own_models import written
from wheretolook.features.config import ExtractorConfig
from wheretolook.features.descriptors import unit_descriptors
from wheretolook.features.keypoints import Keypoints
from wheretolook.features.registry import all_kinds
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import poses_looking_along, transform
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.localization.localizer import Localizer
from wheretolook.mapping.colmap_model import model_arrays
from wheretolook.mapping.feature_files import read_features
from wheretolook.mapping.landmarks import Landmarks, features_of, load_colmap_landmarks
from wheretolook.mapping.triangulation import fill_database, match_pairs
from wheretolook.utils.errors import MapError, MapWarning, OutOfRangeWarning
from wheretolook.utils.processes import WorkerPool
from wheretolook.utils.shipped import shipped
from wheretolook.weights.resolve import load_scorer, resolve_weights

LEARNED = [kind for kind in all_kinds().values() if not kind.in_bytes]


def unit(n: int, dimension: int, seed: int = 0) -> np.ndarray:
    return unit_descriptors(np.random.default_rng(seed).normal(size=(n, dimension)))


def case(folder: Path, kind):
    """A model of three images, its folder, and descriptors of their keypoints as files hold them."""
    model, keypoints = hand_written_model()
    stored = [kind.store(unit(len(found), kind.dimension, seed)) for seed, found in enumerate(keypoints)]
    return model, written(model, folder / "model"), keypoints, stored


def database_of(path: Path, model, keypoints, stored, kind) -> Path:
    pixels = [np.asarray(found, dtype=np.float32) for found in keypoints]
    fill_database(path, model, list(zip(pixels, stored, strict=True)), kind)
    return path


def hdf5_of(path: Path, keypoints, stored, names=("0.png", "1.png", "2.png")) -> Path:
    h5py = pytest.importorskip("h5py", reason="hloc's features need h5py: pip install 'wheretolook[hloc]'")
    with h5py.File(path, "w") as file:
        for name, found, descriptors in zip(names, keypoints, stored, strict=False):
            group = file.create_group(name)
            group["keypoints"] = np.asarray(found) - 0.5  # hloc counts from the middle of the first pixel
            group["descriptors"] = descriptors.T
    return path


def expected_means(model, landmarks: Landmarks, stored) -> np.ndarray:
    arrays = model_arrays(model)
    means = []
    for number in landmarks.ids:
        row = arrays.point_ids.tolist().index(number)
        seen = range(arrays.observation_start[row], arrays.observation_start[row + 1])
        track = [stored[arrays.observation_image[k]][arrays.observation_keypoint[k]] for k in seen]
        means.append(unit_descriptors(np.array(track)).sum(0))
    return unit_descriptors(np.array(means))


@pytest.mark.parametrize("kind", LEARNED, ids=lambda kind: kind.name)
@pytest.mark.parametrize("source", ["database", "hdf5"])
def test_learned_descriptors_are_read_and_averaged(tmp_path, kind, source):
    model, folder, keypoints, stored = case(tmp_path, kind)
    if source == "database":
        path = database_of(tmp_path / "database.db", model, keypoints, stored, kind)
    else:
        path = hdf5_of(tmp_path / f"feats-{kind.name}-n4096-r1024.h5", keypoints, stored)
    landmarks = load_colmap_landmarks(folder, path)
    assert landmarks.features == kind.name and landmarks.descriptors.dtype == np.float16
    means = expected_means(model, landmarks, stored)
    np.testing.assert_allclose(landmarks.descriptors, means, atol=2e-3)
    cosine = means @ means.T
    np.fill_diagonal(cosine, -1)
    np.testing.assert_allclose(landmarks.ambiguity, cosine.max(1), atol=3e-3)
    for compact in (False, True):
        landmarks.save(tmp_path / "landmarks.npz", compact)
        again = Landmarks.load(tmp_path / "landmarks.npz")
        assert again.features == features_of(tmp_path / "landmarks.npz") == kind.name
        assert (again.descriptors is None) == compact
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        known, found = read_features(path, ["0.png"])
    assert known is kind
    np.testing.assert_allclose(found[0][0], keypoints[0], atol=1e-4)
    np.testing.assert_allclose(found[0][1], stored[0], atol=2e-3)


def test_a_database_is_read_as_colmap_4_reads_it(tmp_path):
    import pycolmap

    kind = all_kinds()["aliked"]
    model, _, keypoints, stored = case(tmp_path, kind)
    with pycolmap.Database.open(str(database_of(tmp_path / "a.db", model, keypoints, stored, kind))) as database:
        read = database.read_descriptors(1)
        assert read.type == pycolmap.FeatureExtractorType.ALIKED_N16ROT
        np.testing.assert_array_equal(read.to_float().data, stored[0].astype(np.float32))


def test_what_hdf5_does_not_say_its_numbers_tell(tmp_path):
    for name in ("xfeat", "superpoint"):  # the only kinds of 64 and of 256 numbers
        (tmp_path / name).mkdir()
        _, folder, keypoints, stored = case(tmp_path / name, all_kinds()[name])
        assert load_colmap_landmarks(folder, hdf5_of(tmp_path / name / "f.h5", keypoints, stored)).features == name
    # or disk: who knows?
    with pytest.warns(MapWarning, match=r"no descriptors of a kind that is known.*say so in the file's name: feats-al"):
        _, folder, keypoints, stored = case(tmp_path, all_kinds()["disk"])
        assert load_colmap_landmarks(folder, hdf5_of(tmp_path / "f.h5", keypoints, stored)).features == ""


@pytest.mark.parametrize("times", [1.0, 2.5, 6.0])  # as large as 640 x 480
def test_hdf5_in_half_precision_is_of_the_model_that_hloc_makes_of_it(tmp_path, times):
    """hloc keeps pixels as halves, and adds half a pixel as halves when it writes them into COLMAP's database."""
    kind = all_kinds()["superpoint"]
    model, keypoints = hand_written_model()
    stored = [kind.store(unit(len(found), kind.dimension, seed)) for seed, found in enumerate(keypoints)]
    # the last keypoint of each image, of those that are compared, lies in its far corner
    spread = [found * times + [0, 0] for found in keypoints]
    for found in spread:
        found[-1] = np.array([639.3, 479.6]) * times
    halves = [(found - 0.5).astype(np.float16) for found in spread]
    for image_id, of_image in enumerate(halves, 1):
        for point, pixel in zip(model.images[image_id].points2D, of_image + np.float16(0.5), strict=True):
            point.xy = pixel.astype(np.float64)
    folder = written(model, tmp_path / "model")
    path = hdf5_of(tmp_path / "feats-superpoint-n4096-r1024.h5", [of + 0.5 for of in halves], stored)
    import h5py

    with h5py.File(path, "a") as file:
        for name, of_image in zip(("0.png", "1.png", "2.png"), halves, strict=True):
            _replaced(file[name], "keypoints", data=of_image)
    assert load_colmap_landmarks(folder, path).features == kind.name
    with h5py.File(path, "a") as file:  # those of other photographs are not
        moved = halves[0].copy()
        moved[-1] -= np.float16(8)
        _replaced(file["0.png"], "keypoints", data=moved)
    with pytest.raises(MapError, match="other keypoints than the model"):
        load_colmap_landmarks(folder, path)


def test_features_that_do_not_fit(tmp_path):
    kinds = all_kinds()
    model, folder, keypoints, stored = case(tmp_path, kinds["aliked"])
    path = hdf5_of(tmp_path / "feats-superpoint.h5", keypoints, stored)
    with pytest.raises(MapError, match=r"feats-superpoint\.h5: descriptors of superpoint have 256 numbers \(got 128\)"):
        load_colmap_landmarks(folder, path)
    path = hdf5_of(tmp_path / "feats-aliked.h5", keypoints, stored, names=("0.png", "other.png", "2.png"))
    with pytest.raises(MapError, match=r"lack an image of the model.*1\.png"):
        load_colmap_landmarks(folder, path)
    path = hdf5_of(tmp_path / "feats-sift.h5", keypoints, [descriptors[:, :64] for descriptors in stored])
    with pytest.raises(MapError, match=r"feats-sift\.h5: descriptors of sift have 128 numbers \(got 64\)"):
        load_colmap_landmarks(folder, path)
    path = database_of(tmp_path / "narrow.db", model, keypoints, stored, kinds["aliked"])
    with sqlite3.connect(path) as database:
        database.execute("UPDATE descriptors SET cols = 256, data = substr(data, 1, 256 * rows)")
    database.close()
    with pytest.raises(MapError, match=r"narrow\.db: descriptors of aliked take 512 bytes each \(got 256\)"):
        load_colmap_landmarks(folder, path)
    path = database_of(tmp_path / "mixed.db", model, keypoints, stored, kinds["aliked"])
    with sqlite3.connect(path) as database:
        zeros = np.zeros((len(keypoints[1]), 128), np.uint8)
        database.execute("UPDATE descriptors SET type = 0, cols = 128, data = ? WHERE image_id = 2", (zeros.tobytes(),))
    database.close()
    with pytest.raises(MapError, match=r"of another kind, .*aliked|of another kind, sift"):
        load_colmap_landmarks(folder, path)
    landmarks = load_colmap_landmarks(folder, database_of(tmp_path / "a.db", model, keypoints, stored, kinds["aliked"]))
    replace(landmarks, descriptors=landmarks.descriptors[:, :64]).save(tmp_path / "short.npz")
    with pytest.raises(MapError, match=r"descriptors of aliked have 128 numbers \(got 64\)"):
        Landmarks.load(tmp_path / "short.npz")
    replace(landmarks, described_by="orb").save(tmp_path / "orb.npz")
    with pytest.raises(MapError, match=r"unknown features.*orb"):
        Landmarks.load(tmp_path / "orb.npz")
    with pytest.raises(MapError, match=r"described by aliked.*opencv.*--map.extractor.method"):
        Localizer(landmarks, PinholeCamera(), extractor=ExtractorConfig())


def test_a_database_as_hloc_leaves_it_names_the_features_beside_it(tmp_path):
    kind = all_kinds()["aliked"]
    model, _, keypoints, stored = case(tmp_path, kind)
    (tmp_path / "sfm").mkdir()
    path = database_of(tmp_path / "sfm" / "database.db", model, keypoints, stored, kind)
    with sqlite3.connect(path) as database:
        database.execute("DELETE FROM descriptors")
    database.close()
    (tmp_path / "feats-aliked-n16_matches-lightglue.h5").touch()
    (tmp_path / "global-feats-netvlad.h5").touch()
    with pytest.raises(MapError, match=r"no descriptors of .*: --database feats-\*\.h5"):
        read_features(path, ["0.png"])
    theirs = hdf5_of(tmp_path / "feats-aliked-n16.h5", keypoints, stored)
    with pytest.raises(MapError, match=re.escape(f"--database {theirs}")):
        read_features(path, ["0.png"])


def _replaced(group, name, **made):
    del group[name]
    group.create_dataset(name, **made)


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        # a few bytes that say they are terabytes of zeros, as keypoints and as descriptors
        (lambda g: _replaced(g, "keypoints", shape=(2**37, 2), dtype="f4", chunks=(2**16, 2)), "would unfold"),
        (lambda g: _replaced(g, "descriptors", shape=(128, 2**37), dtype="f4", chunks=(128, 64)), "would unfold"),
        (lambda g: _replaced(g, "keypoints", shape=(1, 2), maxshape=(None, None), dtype="f4", chunks=(2**14, 2**15)),
         "would unfold"),
        (lambda g: _replaced(g, "descriptors", data=g["descriptors"][()].T), "aliked have 128 numbers"),
        (lambda g: _replaced(g, "descriptors", data=g["descriptors"][0]), "no finite numbers"),
        (lambda g: _replaced(g, "keypoints", data=np.zeros(4)), "no finite numbers"),
        (lambda g: g["keypoints"].write_direct(np.full(g["keypoints"].shape, np.nan)), "no finite numbers"),
        (lambda g: g["descriptors"].write_direct(np.full(g["descriptors"].shape, np.nan, "f2")), "no finite numbers"),
        (lambda g: _replaced(g, "descriptors", data=np.full(g["descriptors"].shape, b"x")), "cannot read"),
        (lambda g: g.pop("descriptors"), "1.png has no descriptors"),
    ],
)  # fmt: skip
def test_hdf5_that_was_made_to_hurt(tmp_path, spoil, told):
    h5py = pytest.importorskip("h5py", reason="hloc's features need h5py: pip install 'wheretolook[hloc]'")
    _, folder, keypoints, stored = case(tmp_path, all_kinds()["aliked"])
    path = hdf5_of(tmp_path / "feats-aliked.h5", keypoints, stored)
    with h5py.File(path, "a") as file:
        spoil(file["1.png"])
    with pytest.raises(MapError, match=rf"feats-aliked\.h5: .*{told}"):
        load_colmap_landmarks(folder, path)


def room(kind, n: int = 300) -> tuple[Landmarks, np.ndarray]:
    """Landmarks on a wall at y = 4 with descriptors of a kind, and a pose that sees them."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-2, 2, n), rng.uniform(3.5, 4.5, n), rng.uniform(0, 3, n)])
    ones = np.ones(n, np.float32)
    zeros = np.zeros((n, 3), np.float32)
    landmarks = Landmarks(
        np.arange(n), points, np.full(n, 3, np.int32), ones, 5 * ones, zeros, 0 * ones, 3 * ones, 0.1 * ones,
        kind.store(unit(n, kind.dimension)), 0.5 * ones, 320 * ones, kind.name,
    )  # fmt: skip
    return landmarks, poses_looking_along([[0.1, 0.0, 1.5]], [[0.0, 1.0, 0.05]])[0]


@pytest.mark.parametrize("kind", LEARNED, ids=lambda kind: kind.name)
def test_a_view_of_a_map_of_learned_features_is_localized(kind):
    landmarks, pose = room(kind)
    camera = PinholeCamera()
    pixels = camera.project(transform(pose, landmarks.points))
    inside = np.flatnonzero(camera.in_image(pixels))
    noisy = unit_descriptors(kind.restore(landmarks.descriptors[inside]) + 0.3 * unit(len(inside), kind.dimension, 1))
    clutter = unit(200, kind.dimension, 2)
    pixels = np.concatenate([pixels[inside], np.random.default_rng(3).uniform(0, 480, (200, 2))]).astype(np.float32)
    queries = Keypoints(pixels, np.concatenate([noisy, clutter]), np.ones(len(pixels), np.float32))
    localizer = Localizer(landmarks, camera)
    ((keypoints, rows),) = localizer.match([queries])
    assert (inside[keypoints] == rows).all() and len(rows) > 0.95 * len(inside)
    found = localizer.estimate(queries, keypoints, rows)
    assert found.status == "localized"
    np.testing.assert_allclose(found.cam_from_world, pose, atol=1e-4)


def test_pairs_of_images_are_matched_by_similarity(tmp_path):
    kind = all_kinds()["xfeat"]
    shared = unit(40, 64)
    pixels = np.zeros((60, 2), np.float32)
    images = [(pixels, kind.store(np.concatenate([shared, unit(20, 64, seed)]))) for seed in (1, 2, 3)]
    with WorkerPool(1) as processes:
        found = list(match_pairs(images, np.array([[0, 1], [1, 2]]), tmp_path, processes, False, kind))
    for matches in found:
        np.testing.assert_array_equal(matches, np.column_stack([np.arange(40)] * 2))


def test_weights_that_have_learnt_by_the_features_of_the_map_score_it():
    """Unless others are named: and then one warning says what that costs."""
    landmarks, pose = room(all_kinds()["aliked"])
    looked = LocalizationMap(landmarks, PinholeCamera())
    theirs = "data/release/weights/aliked/set.safetensors"
    with warnings.catch_warnings():
        warnings.simplefilter("error", OutOfRangeWarning)
        own = load_scorer(looked)
        by_folder = load_scorer("data/release/weights", looked)
        expected = load_scorer(theirs, looked).score(pose[None])
    assert own.name == "set" and np.isfinite(expected).all()
    np.testing.assert_array_equal(own.score(pose[None]), expected)
    np.testing.assert_array_equal(by_folder.score(pose[None]), expected)
    assert resolve_weights("", None, "aliked") == resolve_weights("set", None, "aliked") == shipped(theirs)
    assert (
        resolve_weights("", None, "sift")
        == resolve_weights("", None)
        == shipped("data/release/weights/set.safetensors")
    )
    assert resolve_weights("mlp-2d+z", None, "aliked") == shipped("data/release/weights/mlp-2d+z.safetensors")

    with pytest.warns(OutOfRangeWarning, match=r"learnt from maps by sift, and this one is by aliked") as said:
        other = load_scorer("data/release/weights/set.safetensors", looked)
    assert len(said) == 1 and "data/release/weights/aliked: they are taken" in str(said[0].message)
    assert (other.score(pose[None]) != expected).all()


@pytest.mark.parametrize("name", ["xfeat", "disk", "superpoint"])
def test_weights_by_aliked_score_maps_by_other_learned_features_and_say_what_that_costs(name):
    landmarks, pose = room(all_kinds()[name])
    looked = LocalizationMap(landmarks, PinholeCamera())
    named = "data/release/weights"
    with pytest.warns(OutOfRangeWarning, match=f"learnt from maps by aliked, and this one is by {name}") as said:
        scorer = load_scorer(looked)
    assert len(said) == 1 and said[0].filename == __file__
    assert ("best views" if name != "superpoint" else "not known") in str(said[0].message)
    assert "suit it better" not in str(said[0].message)
    with pytest.warns(OutOfRangeWarning):
        np.testing.assert_array_equal(
            scorer.score(pose[None]), load_scorer(f"{named}/aliked/set.safetensors", looked).score(pose[None])
        )
    with pytest.warns(OutOfRangeWarning, match=r"by sift.*Weights that suit it better ship, .*weights/aliked"):
        load_scorer(f"{named}/set.safetensors", looked)


def test_without_weights_by_aliked_a_folder_s_own_score_learned_features(tmp_path):
    for name in ("", "disk"):
        folder_of = tmp_path / "some" / name
        folder_of.mkdir(parents=True, exist_ok=True)
        shutil.copy(shipped("data/release/weights/set.safetensors"), folder_of)
    assert resolve_weights(path=tmp_path / "some", features="xfeat").parent == tmp_path / "some"
    assert resolve_weights(path=tmp_path / "some", features="disk").parent == tmp_path / "some" / "disk"


@pytest.mark.parametrize(("name", "told"), [("disk", "they lose 14"), ("xfeat", "they lose 18"), ("superpoint", "not")])
def test_weights_by_aliked_on_maps_by_others_say_what_was_measured(name, told):
    landmarks, _ = room(all_kinds()[name])
    with pytest.warns(OutOfRangeWarning, match=f"learnt from maps by aliked, and this one is by {name}.*{told}"):
        load_scorer("data/release/weights/aliked/set.safetensors", LocalizationMap(landmarks, PinholeCamera()))
