"""Maps of learned features: from databases of COLMAP 4 and hloc's HDF5, on disk again, and localized against."""

import warnings
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mapping.test_landmarks import hand_written_model
from mapping.test_own_models import written
from wheretolook.features.extractor import KINDS, unit_descriptors
from wheretolook.mapping.colmap_model import model_arrays
from wheretolook.mapping.feature_files import kind_in_name, read_features
from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks, read_feature_name
from wheretolook.mapping.triangulation import fill_database, match_pairs
from wheretolook.utils.errors import MapError, MapWarning
from wheretolook.utils.processes import WorkerPool

LEARNED = [kind for kind in KINDS.values() if not kind.in_bytes]


def unit(n, dimension, seed=0):
    return unit_descriptors(np.random.default_rng(seed).normal(size=(n, dimension)))


def case(folder, kind):
    """A model of three images, its folder, and descriptors of their keypoints as files hold them."""
    model, keypoints = hand_written_model()
    stored = [kind.store(unit(len(found), kind.dimension, seed)) for seed, found in enumerate(keypoints)]
    return model, written(model, folder / "model"), keypoints, stored


def database_of(path, model, keypoints, stored, kind):
    pixels = [np.asarray(found, dtype=np.float32) for found in keypoints]
    fill_database(path, model, list(zip(pixels, stored, strict=True)), kind)
    return path


def hdf5_of(path, keypoints, stored, names=("0.png", "1.png", "2.png"), dtype=None):
    h5py = pytest.importorskip("h5py", reason="hloc's features need h5py: pip install h5py")
    with h5py.File(path, "w") as file:
        for name, found, descriptors in zip(names, keypoints, stored, strict=False):
            group = file.create_group(name)
            group["keypoints"] = np.asarray(
                np.asarray(found) - 0.5, dtype
            )  # hloc counts from the middle of the first pixel
            group["descriptors"] = descriptors.T
    return path


def expected_means(model, landmarks, stored):
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
    assert_allclose(landmarks.descriptors, means, atol=2e-3)
    cosine = means @ means.T
    np.fill_diagonal(cosine, -1)
    assert_allclose(landmarks.ambiguity, cosine.max(1), atol=3e-3)
    for compact in (False, True):
        landmarks.save(tmp_path / "landmarks.npz", compact)
        again = Landmarks.load(tmp_path / "landmarks.npz")
        assert again.features == read_feature_name(tmp_path / "landmarks.npz") == kind.name
        assert (again.descriptors is None) == compact
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        known, found = read_features(path, ["0.png"])
    assert known is kind
    assert_allclose(found[0][0], keypoints[0], atol=1e-4)
    assert_allclose(found[0][1], stored[0], atol=2e-3)


def test_a_database_is_read_as_colmap_4_reads_it(tmp_path):
    import pycolmap

    kind = KINDS["aliked"]
    model, _, keypoints, stored = case(tmp_path, kind)
    with pycolmap.Database.open(str(database_of(tmp_path / "a.db", model, keypoints, stored, kind))) as database:
        read = database.read_descriptors(1)
        assert read.type == pycolmap.FeatureExtractorType.ALIKED_N16ROT
        assert_array_equal(read.to_float().data, stored[0].astype(np.float32))


def test_types_are_numbered_as_by_colmap():
    types = {"SIFT": "sift", "ALIKED_N16ROT": "aliked", "ALIKED_N32": "aliked-n32"}
    types |= {"LOMA_B": "loma-b", "LOMA_B128": "loma-b128"}
    for name, kind in types.items():
        if known := pycolmap.FeatureExtractorType.__members__.get(name):  # from 4.2 on
            assert KINDS[kind].colmap_type == int(known)
    for name, kind in (
        ("feats-aliked-n32", "aliked-n32"),
        ("feats-aliked-n16", "aliked"),
        ("x_loma_b128_n2", "loma-b128"),
    ):
        assert kind_in_name(Path(f"{name}.h5")) is KINDS[kind]


def test_the_number_of_columns_decides_the_kind_where_nothing_states_it(tmp_path):
    for name in ("xfeat", "superpoint"):  # the only kinds of 64 and of 256 numbers
        (tmp_path / name).mkdir()
        _, folder, keypoints, stored = case(tmp_path / name, KINDS[name])
        assert load_colmap_landmarks(folder, hdf5_of(tmp_path / name / "f.h5", keypoints, stored)).features == name
    _, folder, keypoints, stored = case(tmp_path, KINDS["disk"])  # or ALIKED
    with pytest.warns(MapWarning):
        assert load_colmap_landmarks(folder, hdf5_of(tmp_path / "f.h5", keypoints, stored)).features == ""


@pytest.mark.parametrize("factor", [1.0, 6.0])  # of 640 x 480 pixels
def test_hdf5_in_half_precision_fits_the_model_that_hloc_made_from_it(tmp_path, factor):
    """hloc keeps pixels as half_precision, and adds half a pixel as half_precision when it writes them into COLMAP's database."""
    kind = KINDS["superpoint"]
    model, keypoints = hand_written_model()
    stored = [kind.store(unit(len(found), kind.dimension, seed)) for seed, found in enumerate(keypoints)]
    half_precision = []
    for image_id, found in enumerate(keypoints, 1):
        found = found * factor
        found[-1] = np.array([639.3, 479.6]) * factor
        half_precision.append((found - 0.5).astype(np.float16))
        for point, pixel in zip(model.images[image_id].points2D, half_precision[-1] + np.float16(0.5), strict=True):
            point.xy = pixel.astype(np.float64)
    folder = written(model, tmp_path / "model")
    path = tmp_path / "feats-superpoint-n4096-r1024.h5"
    hdf5_of(path, [pixels + 0.5 for pixels in half_precision], stored, dtype=np.float16)
    assert load_colmap_landmarks(folder, path).features == kind.name
    half_precision[0][-1] -= np.float16(8)  # as of other photographs
    with pytest.raises(MapError):
        load_colmap_landmarks(
            folder, hdf5_of(path, [pixels + 0.5 for pixels in half_precision], stored, dtype=np.float16)
        )


def test_pairs_of_images_are_matched_by_similarity(tmp_path):
    kind = KINDS["xfeat"]
    shared = unit(40, 64)
    pixels = np.zeros((60, 2), np.float32)
    images = [(pixels, kind.store(np.concatenate([shared, unit(20, 64, seed)]))) for seed in (1, 2, 3)]
    with WorkerPool(1) as processes:
        found = list(match_pairs(images, np.array([[0, 1], [1, 2]]), tmp_path, processes, False, kind))
    for matches in found:
        assert_array_equal(matches, np.column_stack([np.arange(40)] * 2))
