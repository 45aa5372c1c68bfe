"""Every extractor owns its descriptors; learned ones are found by kornia, where it is installed."""

from pathlib import Path

import numpy as np
import pytest

from twins.features import mutual_matches
from wheretolook.features.extractor import KINDS, ExtractorConfig, KeypointExtractor, kind_of, unit_descriptors
from wheretolook.features.learned import detect_and_describe
from wheretolook.features.matching import SimilarityMatcher
from wheretolook.localization.config import LocalizerConfig
from wheretolook.utils.errors import WeightsError

LEARNED = ("aliked", "disk", "xfeat")


def unit(n, dimension, seed=0):
    return unit_descriptors(np.random.default_rng(seed).normal(size=(n, dimension)))


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
def test_stored_descriptors_come_back_as_they_were_stored(kind):
    values = unit(50, kind.dimension)
    stored = kind.store(np.abs(values) if kind.in_bytes else values)
    assert stored.dtype == kind.stored_as and kind.none().shape == (0, kind.dimension)
    np.testing.assert_array_equal(kind.store(kind.restore(stored)), stored)
    np.testing.assert_allclose(np.linalg.norm(kind.restore(stored), axis=1), 1, atol=0.02)
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
            np.testing.assert_allclose(squared[:, : expected.shape[1]], 2 - 2 * expected, atol=1e-5)
            np.testing.assert_allclose(np.take_along_axis(cosine, near[:, : expected.shape[1]], 1), expected, atol=1e-5)
            expected = mutual_matches(images[0], landmarks, limit)
            found, plain = ({*zip(a.tolist(), b.tolist(), strict=True)} for a, b in ((keypoints, rows), expected))
            assert len(found ^ plain) <= n // 1000  # sums that agree up to single precision
        assert len(set(rows.tolist())) == len(rows) and (np.diff(keypoints) > 0).all()
    if n > 2:
        assert n // 4 < len(rows) <= n // 2  # of twins, the nearer


def untrained(method, folder):
    """A file of weights as the authors of a network give theirs, but with random numbers."""
    torch = pytest.importorskip("torch")
    kornia = pytest.importorskip("kornia.feature", reason="learned features need kornia: pip install kornia")
    torch.manual_seed(0)
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


def image(seed=0):
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(seed)
    return np.clip(128 + 120 * gaussian_filter(rng.normal(size=(100, 140, 3)), (1.5, 1.5, 0)) * 3, 0, 255).astype(
        np.uint8
    )


@pytest.mark.parametrize("method", LEARNED)
def test_learned_extractors_give_unit_descriptors_within_the_image(method, tmp_path):
    weights = untrained(method, tmp_path)
    extractor = KeypointExtractor(ExtractorConfig(method, max_keypoints=50, weights=str(weights)))
    both = extractor.extract_batch([image(0), image(1)])
    for found, rgb in zip(both, (image(0), image(1)), strict=True):
        alone = extractor.extract(rgb)
        np.testing.assert_array_equal(found.pixels, alone.pixels)
        np.testing.assert_array_equal(found.descriptors, alone.descriptors)
        assert 0 < len(found) <= 50
        assert found.descriptors.shape == (len(found), kind_of(method).dimension)
        np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=1e-4)
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
    whole = np.stack([image(seed) for seed in range(4)])
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
        np.testing.assert_allclose(pixels, expected[0], atol=1e-3)
        np.testing.assert_allclose(descriptors, expected[1], atol=2e-4)
        np.testing.assert_allclose(scored, expected[2], atol=1e-5)


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
