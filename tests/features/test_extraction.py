"""Keypoints at known places, unit descriptors, and the same answer every time."""

import numpy as np
import pycolmap
import pytest

from features.textures import color_texture
from wheretolook.features.extractor import ExtractorConfig, KeypointExtractor, quantize_descriptors, unit_descriptors
from wheretolook.utils.processes import WorkerPool

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
    np.testing.assert_array_equal(mine[np.lexsort(mine.T)], theirs[np.lexsort(theirs.T)])


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


def test_quantized_descriptors_survive_the_round_trip():
    descriptors = KeypointExtractor(ExtractorConfig()).extract(color_texture(0)).descriptors
    stored = quantize_descriptors(descriptors)
    assert stored.dtype == np.uint8
    np.testing.assert_array_equal(quantize_descriptors(unit_descriptors(stored)), stored)
    np.testing.assert_array_equal(unit_descriptors(np.zeros((2, 128), np.uint8)), 0)
    assert quantize_descriptors(np.eye(2)).max() == 255
