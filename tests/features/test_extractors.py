"""Every extractor owns its descriptors; learned ones are found by kornia, where it is installed."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from features.textures import color_texture
from twins.features import mutual_matches
from wheretolook.features.extractor import (
    KINDS,
    ExtractorConfig,
    KeypointExtractor,
    kind_of,
    quantize_descriptors,
    unit_descriptors,
)
from wheretolook.features.learned import detect_and_describe
from wheretolook.features.matching import SimilarityMatcher
from wheretolook.localization.config import LocalizerConfig
from wheretolook.utils.errors import WeightsError
from wheretolook.utils.processes import WorkerPool

IMAGES = [color_texture(seed, 100, 140) for seed in range(4)]
LEARNED = ("aliked", "disk", "xfeat")


def unit(n, dimension, seed=0):
    return unit_descriptors(np.random.default_rng(seed).normal(size=(n, dimension)))


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
def test_stored_descriptors_come_back_as_they_were_stored(kind):
    values = unit(50, kind.dimension)
    stored = kind.store(np.abs(values) if kind.in_bytes else values)
    assert stored.dtype == kind.stored_as and kind.none().shape == (0, kind.dimension)
    assert_array_equal(kind.store(kind.restore(stored)), stored)
    assert_allclose(np.linalg.norm(kind.restore(stored), axis=1), 1, atol=0.02)
    assert kind.store(kind.restore(kind.none())).shape == (0, kind.dimension)


def test_the_records_of_older_maps_and_labels_stay_valid():
    """Stages are done again when a record changes: a new option may not change that of everybody's maps."""
    constants = {"first_octave": -1, "max_keypoints": 2048, "peak_threshold": 0.02 / 3, "edge_threshold": 10.0}
    assert ExtractorConfig().record() == {"method": "opencv", **constants}
    old = {"max_ratio": 0.85, "min_matches": 4, "max_error_px": 8.0, "min_inliers": 10, "seed": 0}
    old |= {"confidence": 0.9999, "min_trials": 100, "max_trials": 10_000}
    assert LocalizerConfig().record() == old
    assert LocalizerConfig(min_similarity=0.7).record() == {**old, "min_similarity": 0.7}


@pytest.mark.parametrize("n", [0, 1, 2, 700, 2000])
def test_mutual_nearest_neighbours_are_those_of_all_products(n, monkeypatch):
    monkeypatch.setattr("wheretolook.features.matching._PRODUCTS", {"cpu": 60_000})  # several blocks
    landmarks = unit(n, 64).astype(np.float16)
    noisy = unit_descriptors(
        np.concatenate([landmarks[: n // 2], landmarks[: n // 4]]) + 0.05 * unit(n // 2 + n // 4, 64, 1)
    )
    images = [np.concatenate([noisy, unit(30, 64, 2)]).astype(np.float16), np.zeros((0, 64), np.float16)]
    matcher = SimilarityMatcher(landmarks)
    for limit in (-1.0, 0.5, 0.9):
        (keypoints, rows, near, squared), nothing = matcher.match(images, limit, 16)
        assert len(nothing[0]) == len(nothing[1]) == 0
        if n:
            cosine = images[0].astype(float) @ landmarks.astype(float).T
            expected = -np.sort(-cosine, axis=1)[:, :16]
            assert_allclose(squared[:, : expected.shape[1]], 2 - 2 * expected, atol=1e-5)
            assert_allclose(np.take_along_axis(cosine, near[:, : expected.shape[1]], 1), expected, atol=1e-5)
            expected = mutual_matches(images[0], landmarks, limit)
            found, plain = ({*zip(a.tolist(), b.tolist(), strict=True)} for a, b in ((keypoints, rows), expected))
            assert len(found ^ plain) <= n // 1000  # sums that agree up to single precision
        assert len(set(rows.tolist())) == len(rows) and (np.diff(keypoints) > 0).all()
    if n > 2:
        assert n // 4 < len(rows) <= n // 2  # of twins, the nearer


def untrained(method, folder, seed=0):
    """A file of weights as the authors of a network give theirs, but with random numbers."""
    torch = pytest.importorskip("torch")
    kornia = pytest.importorskip("kornia.feature", reason="learned features need kornia: pip install kornia")
    torch.manual_seed(seed)
    if method == "aliked":
        state = {
            name: value for name, value in kornia.ALIKED("aliked-n16rot").state_dict().items() if "dkd" not in name
        }
    elif method == "disk":
        state = {"extractor": kornia.DISK().state_dict()}
    else:
        state = kornia.XFeat().net.state_dict()
        last = [name for name in state if name.startswith("keypoint_head") and name.endswith("weight")][-1]
        state[last] *= 100  # so that some score passes the least one
    path = folder / f"{method}.pth"
    torch.save(state, path)
    return path


@pytest.mark.parametrize("method", LEARNED)
def test_learned_extractors_give_unit_descriptors_within_the_image(method, tmp_path):
    weights = untrained(method, tmp_path)
    extractor = KeypointExtractor(ExtractorConfig(method, max_keypoints=50, weights=str(weights)))
    both = extractor.extract_batch(IMAGES[:2])
    for found, rgb in zip(both, IMAGES[:2], strict=True):
        alone = extractor.extract(rgb)
        assert_array_equal(found.pixels, alone.pixels)
        assert_array_equal(found.descriptors, alone.descriptors)
        assert 0 < len(found) <= 50
        assert found.descriptors.shape == (len(found), kind_of(method).dimension)
        assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=1e-4)
        assert (found.pixels > 0).all() and (found.pixels < (140, 100)).all()
    for height, width in ((0, 5), (1, 1), (15, 200)):
        nothing = extractor.extract(np.full((height, width, 3), 90, np.uint8))
        assert nothing.descriptors.shape == (0, kind_of(method).dimension)


@pytest.mark.parametrize("least", [0.0, 0.9, 0.9999])  # as a share of scores: of all maxima, of few, of some images
def test_aliked_finds_in_a_batch_what_kornia_finds_image_by_image(least, tmp_path):
    torch = pytest.importorskip("torch")
    kornia = pytest.importorskip("kornia.feature")
    weights = untrained("aliked", tmp_path)
    state = torch.load(weights)
    state["desc_head.offset_conv.2.weight"] *= 200  # so that descriptors are of places far away, some outside the image
    torch.save(state, weights)
    network = KeypointExtractor(ExtractorConfig("aliked", weights=str(weights)))._extraction._network
    reference = kornia.ALIKED("aliked-n16rot").eval()
    reference.load_state_dict(state, strict=False)
    whole = np.stack(IMAGES)
    whole[2] = 128  # two images with flat parts, one has nothing else
    whole[3, :50] = 40
    images = torch.from_numpy(whole).permute(0, 3, 1, 2) / 255
    with torch.inference_mode():
        scores = reference.extract_dense_map(images)[1]
        for each in (network, reference):
            each.dkd.scores_th = float(scores.quantile(least)) if least else float(scores.min()) - 1e-3
            each.dkd.n_limit = 100  # of which some images have more
        found = detect_and_describe(network, images)
        plain = [(each.keypoints, each.descriptors, each.keypoint_scores) for each in reference(images)]
    assert len(found) == 4 and any(0 < len(each[2]) < 100 for each in plain)
    for result, expected in zip(found, plain, strict=True):
        assert len(result[0]) == len(expected[0])
        orders = (np.lexsort(pixels.numpy().round(1).T) for pixels, _, _ in (result, expected))
        (pixels, descriptors, scored), expected = (
            [v[rows] for v in values] for values, rows in zip((result, expected), orders, strict=True)
        )
        assert_allclose(pixels, expected[0], atol=1e-3)
        assert_allclose(descriptors, expected[1], atol=2e-4)
        assert_allclose(scored, expected[2], atol=1e-5)


@pytest.mark.parametrize("method", LEARNED)
def test_invalid_weights(method, tmp_path):
    weights = untrained(method, tmp_path)
    other = untrained("xfeat" if method != "xfeat" else "disk", tmp_path)
    (tmp_path / "truncated.pth").write_bytes(weights.read_bytes()[:999])
    torch = pytest.importorskip("torch")
    torch.save({"a": Path()}, tmp_path / "object.pth")
    state = torch.load(weights, weights_only=True)
    tensors = state["extractor"] if method == "disk" else state
    next(value for value in tensors.values() if value.is_floating_point()).view(-1)[0] = torch.nan
    torch.save(state, tmp_path / "nan.pth")
    for name in (other.name, "truncated.pth", "missing.pth", "object.pth", "nan.pth"):
        with pytest.raises(WeightsError):
            KeypointExtractor(ExtractorConfig(method, weights=str(tmp_path / name)))


# Keypoints at known places, unit descriptors, and the same answer every time.

METHODS = ("colmap", "opencv")


def blob(x, y, sigma):
    """A Gaussian blob centred at (x, y), where (0.5, 0.5) is the centre of the top-left pixel."""
    rows, columns = np.mgrid[:120, :160] + 0.5
    grey = 60 + 150 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))
    return np.repeat(np.rint(grey).astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("place", [(80.5, 60.5), (80.3, 60.7), (51.9, 70.2)])
@pytest.mark.parametrize("sigma", [3.0, 6.0])
def test_blob_is_found_where_it_is(method, place, sigma):
    # A high threshold leaves out the faint ring that the blob's rounding to grey values makes.
    keypoints = KeypointExtractor(ExtractorConfig(method=method, peak_threshold=0.05)).extract(blob(*place, sigma))
    assert len(keypoints) >= 1
    assert np.abs(keypoints.pixels - place).max() < 0.1


def test_colmap_method_gives_the_keypoints_of_colmaps_own_feature_extraction(tmp_path):
    """Over an image file, through COLMAP's C++ pipeline, which does its own reading and conversion to grey."""
    from PIL import Image

    (tmp_path / "images").mkdir()
    image = color_texture(1)
    Image.fromarray(image).save(tmp_path / "images" / "a.png")
    options = pycolmap.FeatureExtractionOptions()
    options.sift.first_octave = 0
    pycolmap.extract_features(
        str(tmp_path / "database.db"), str(tmp_path / "images"), extraction_options=options, device=pycolmap.Device.cpu
    )
    with pycolmap.Database.open(str(tmp_path / "database.db")) as database:
        pixels = np.asarray(database.read_keypoints(1))[:, :2]
        descriptors = database.read_descriptors(1).data
    config = ExtractorConfig(method="colmap", first_octave=0, max_keypoints=100_000)
    ours = KeypointExtractor(config).extract(image)
    mine = np.column_stack([ours.pixels, quantize_descriptors(ours.descriptors)])
    theirs = np.column_stack([pixels.astype(np.float32), descriptors])
    assert len(mine) == len(theirs)
    assert_array_equal(mine[np.lexsort(mine.T)], theirs[np.lexsort(theirs.T)])


@pytest.mark.parametrize("method", ["opencv", pytest.param("colmap", marks=pytest.mark.slow)])
def test_same_image_same_keypoints_in_any_process(method):
    images = [color_texture(seed) for seed in range(5)]
    extractor = KeypointExtractor(ExtractorConfig(method=method))
    here = list(extractor.extract_many(images, WorkerPool(1)))
    with WorkerPool(2) as processes:
        there = list(extractor.extract_many(iter(images), processes))
    again = [KeypointExtractor(ExtractorConfig(method=method)).extract(image) for image in images]
    for a, b, c in zip(here, there, again, strict=True):
        assert a.pixels.tobytes() == b.pixels.tobytes() == c.pixels.tobytes()
        assert a.descriptors.tobytes() == b.descriptors.tobytes() == c.descriptors.tobytes()


@pytest.mark.parametrize("method", METHODS)
def test_plain_image_has_no_keypoints(method):
    keypoints = KeypointExtractor(ExtractorConfig(method=method)).extract(np.full((60, 80, 3), 90, np.uint8))
    assert keypoints.pixels.shape == (0, 2) and keypoints.descriptors.shape == (0, 128)
