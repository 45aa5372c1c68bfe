"""Binned inputs against bins counted by hand and the plain twin."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from synthetic_dataset import make_landmarks
from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.inputs.bins import bin_views, bin_views_plain, count_bins
from wheretolook.inputs.channels import ALL_CHANNELS, CHANNELS, LANDMARK_CHANNELS
from wheretolook.inputs.landmark_features import ATTRIBUTES, LandmarkDescriber
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.map import Map
from wheretolook.visibility.frustum import LandmarkSets, PosedViews, landmarks_in_view

LOOKING_ALONG_Z = np.eye(3, 4)[None]
DISTORTED = ColmapCamera("RADIAL", 320, 240, (150.0, 165.0, 118.0, -0.15, 0.02))


def hand_counted(points):
    return LandmarkSets.from_mask(np.ones((1, len(points)), dtype=bool))


@pytest.mark.parametrize("bin_function", [bin_views, bin_views_plain])
def test_bins_counted_by_hand(bin_function):
    # 60 x 30 pixels, f = 30: bins of 2 x 1 pixels. The optical axis passes through (30, 15).
    camera = PinholeCamera(60, 30, 30.0)
    points = [
        [0.01, 0.01, 1.0],  # pixel (30.3, 15.3): row 15, column 15
        [0.09, 0.05, 3.0],  # pixel (30.9, 15.5): the same bin
        [-0.98, -0.48, 1.0],  # pixel (0.6, 0.6): row 0, column 0
        [0.98, 0.48, 1.0],  # pixel (59.4, 29.4): row 29, column 29
        [1.01, 0.0, 1.0],  # pixel (60.3, 15): outside
        [0.0, 0.0, -1.0],  # behind
    ]
    binned = bin_function(PosedViews(camera, LOOKING_ALONG_Z, np.array(points), hand_counted(points), np.zeros(1, int)))
    assert {tuple(cell): int(binned.counts[0][tuple(cell)]) for cell in np.argwhere(binned.counts[0])} == {
        (0, 0): 1, (15, 15): 2, (29, 29): 1,
    }  # fmt: skip
    assert_allclose(binned.means[0, :, 15, 15], [30.6, 15.4, 0.05, 0.03, 2.0], rtol=1e-5)
    assert_allclose(binned.means[0, :, 0, 0], [0.6, 0.6, -0.98, -0.48, 1.0], rtol=1e-5)
    assert binned.n_visible.tolist() == [4] and binned.n_filled.tolist() == [3]
    assert np.all(binned.means[:, :, binned.counts[0] == 0] == 0)


def test_counted_bins_are_those_that_the_plain_twin_fills(random_views, device, monkeypatch):
    arguments = posed_views(random_views)
    plain = bin_views_plain(arguments, bins=12)
    for block_bytes in (1 << 30, 3 * 12 * 12 * 4):  # all at once, and three views at a time
        monkeypatch.setattr("wheretolook.inputs.bins.BLOCK_BYTES", block_bytes)
        n_visible, n_filled = count_bins(arguments, bins=12, device=device)
        assert_array_equal(n_visible, plain.n_visible)
        assert_array_equal(n_filled, plain.n_filled)
    arguments = posed_views(random_views, DISTORTED)
    binned = bin_views(arguments, bins=6)
    assert_array_equal(count_bins(arguments, bins=6), (binned.n_visible, binned.n_filled))


def posed_views(views, camera=None):
    return PosedViews(camera or views.camera, views.cam_from_world, views.points, views.visible, views.location_rows)


def landmarks_of(views):
    return make_landmarks(np.random.default_rng(0), len(views.points), points=views.points)


@pytest.mark.parametrize("block_bytes", [1 << 30, 7 * 144 * 24])
def test_kernel_bins_what_landmarks_are_like_as_its_plain_twin(random_views, device, block_bytes, monkeypatch):
    monkeypatch.setattr("wheretolook.inputs.bins.BLOCK_BYTES", block_bytes)
    landmarks = landmarks_of(random_views)
    arguments = posed_views(random_views)
    kernel = bin_views(arguments, bins=12, device=device, landmarks=landmarks)
    plain = bin_views_plain(arguments, bins=12, landmarks=landmarks)
    assert kernel.channels == plain.channels == ALL_CHANNELS
    assert_array_equal(kernel.counts, plain.counts)
    assert_allclose(kernel.means, plain.means, rtol=1e-5, atol=2e-5)
    without = bin_views(arguments, bins=12, device=device)
    assert without.channels == CHANNELS
    assert_array_equal(kernel.means[:, : len(CHANNELS)], without.means)  # who does not ask pays nothing
    assert plain.means[:, len(CHANNELS) :].std((0, 2, 3)).min() > 0.01


@pytest.mark.parametrize("distorted", [False, True])
def test_channels_of_landmarks_are_means_of_their_attributes(random_views, distorted):
    landmarks = landmarks_of(random_views)
    arguments = posed_views(random_views, DISTORTED if distorted else None)
    binned = bin_views(arguments, bins=1, landmarks=landmarks)
    visible = landmarks_in_view(arguments)
    localization_map = LocalizationMap(Map(landmarks), arguments.camera)
    described = LandmarkDescriber(localization_map).describe(random_views.cam_from_world, visible)
    of_bins = [ATTRIBUTES.index(name) for name in LANDMARK_CHANNELS]
    for view in range(len(random_views.cam_from_world)):
        values = described.values[described.views == view].numpy()[:, of_bins]
        expected = values.mean(0) if len(values) else np.zeros(len(LANDMARK_CHANNELS))
        assert_allclose(binned.means[view, len(CHANNELS) :, 0, 0], expected, rtol=1e-4, atol=1e-5)


def test_a_mean_with_an_unknown_value_is_unknown_and_nothing_else_is(random_views, device):
    landmarks = landmarks_of(random_views)
    known = np.random.default_rng(1).random(len(landmarks)) < 0.9
    landmarks = replace(landmarks, ambiguity=np.where(known, landmarks.ambiguity, np.nan).astype(np.float32))
    arguments = posed_views(random_views)
    kernel = bin_views(arguments, bins=12, device=device, landmarks=landmarks)
    plain = bin_views_plain(arguments, bins=12, landmarks=landmarks)
    assert_array_equal(np.isnan(kernel.means), np.isnan(plain.means))
    unknown = np.isnan(kernel.means).sum((0, 2, 3))
    assert 0 < unknown[ALL_CHANNELS.index("ambiguity")] < (kernel.counts > 0).sum()
    assert unknown.sum() == unknown[ALL_CHANNELS.index("ambiguity")]
