"""`WarpSift` against OpenCV, its twin, and against itself: the same bits every time, whatever the batch."""

import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial import KDTree

from features.textures import texture
from wheretolook.features.extractor import ExtractorConfig, KeypointExtractor
from wheretolook.features.sift import grey_bitmap
from wheretolook.features.warp_sift import WarpSift, grey_images

EVERYTHING = ExtractorConfig(max_keypoints=100_000)


def opencv(grey, config):
    return KeypointExtractor(config).extract(np.repeat(grey[..., None], 3, axis=2))


def assert_same(first, second):
    assert len(first) == len(second)
    for a, b in zip(first, second, strict=True):
        assert a.pixels.tobytes() == b.pixels.tobytes()
        assert a.descriptors.tobytes() == b.descriptors.tobytes()


def best_match(a, b):
    """For each keypoint of a, the highest cosine to one of b at its place (0.1 px), or NaN."""
    best = np.full(len(a), np.nan)
    for row, near in enumerate(KDTree(b.pixels).query_ball_point(a.pixels, 0.1)):
        if near:
            best[row] = (b.descriptors[near] @ a.descriptors[row]).max()
    return best


def assert_agree(ours, theirs):
    for a, b in ((ours, theirs), (theirs, ours)):
        cosine = best_match(a, b)
        assert np.mean(np.isfinite(cosine)) >= 0.97
        cosine = cosine[np.isfinite(cosine)]
        assert np.median(cosine) > 0.999 and np.quantile(cosine, 0.01) > 0.98


@pytest.mark.parametrize("shape", [(240, 320), (171, 237), (30, 301), (12, 90)])
def test_agrees_with_opencv_on_textures_of_any_shape(shape, device):
    image = texture(0, *shape)
    theirs = opencv(image, EVERYTHING)
    (ours,) = WarpSift(EVERYTHING, device).extract_many(image[None])
    assert len(theirs) > 1
    assert_agree(ours, theirs)


@pytest.mark.parametrize(("name", "value"), [("first_octave", 0), ("peak_threshold", 0.04), ("edge_threshold", 2.0)])
def test_agrees_with_opencv_whatever_the_settings(name, value, device):
    config = ExtractorConfig(max_keypoints=100_000)
    image = texture(1, 160, 200)
    object.__setattr__(config, name, value)  # a constant too
    theirs = opencv(image, config)
    (ours,) = WarpSift(config, device).extract_many(image[None])
    assert 20 < len(theirs) < 0.8 * len(opencv(image, EVERYTHING))
    assert_agree(ours, theirs)


def test_an_image_gives_the_same_bits_in_any_batch_and_every_time(device):
    images = np.stack([texture(seed, 100, 120) for seed in range(8)])
    images[3] = 90
    sift = WarpSift(EVERYTHING, device)
    alone = [sift.extract_many(image[None])[0] for image in images]
    assert min(len(a) for a in np.delete(np.array(alone, object), 3)) > 50 and len(alone[3]) == 0
    assert_same(sift.extract_many(images), alone)
    assert_same(sift.extract_many(images[5:]), alone[5:])
    assert_same(WarpSift(EVERYTHING, device).extract_many(images), alone)
    small_blocks = WarpSift(EVERYTHING, device, block_bytes=3 * 100 * 120 * 4 * 6 * 6)
    assert_same(small_blocks.extract_many(images), alone)
    assert small_blocks._space.n_images < len(images)


def test_grey_images_are_those_of_colmap(device):
    images = np.random.default_rng(0).integers(0, 256, (3, 97, 101, 3), dtype=np.uint8)
    expected = [grey_bitmap(rgb).to_array() for rgb in images]
    for of_images in (images, list(images), list(torch.tensor(images, device=device))):
        np.testing.assert_array_equal(grey_images(of_images, device).cpu(), expected)


def test_more_extrema_than_the_list_holds(device):
    images = np.stack([texture(seed, 60, 80) for seed in range(2)])
    sift = WarpSift(EVERYTHING, device)
    first = sift.extract_many(images)
    sift._space.keys = wp.empty(7, dtype=wp.int64, device=sift.device)
    assert_same(sift.extract_many(images), first)
    assert len(sift._space.keys) > 7


@pytest.mark.parametrize("shape", [(1, 60, 80), (3, 5, 200), (2, 1, 1), (0, 60, 80)])
def test_nothing_to_see(shape, device):
    found = WarpSift(EVERYTHING, device).extract_many(np.full(shape, 90, np.uint8))
    assert [k.pixels.shape for k in found] == [(0, 2)] * shape[0]
    assert [k.descriptors.shape for k in found] == [(0, 128)] * shape[0]
