"""Learners of single landmarks: which are detected, and the statistics expected of a view."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from learning_options import train_config
from synthetic_dataset import CAMERA
from wheretolook.dataset.viewpoint_table import LOCALIZED, is_good, poses
from wheretolook.geometry import pose_information as information
from wheretolook.inputs.landmark_features import ATTRIBUTES, LandmarkDescriber, ViewLandmarks
from wheretolook.inputs.statistics import FeatureStatistics
from wheretolook.scorers.set import SetConfig
from wheretolook.scorers.set.learn import of_size
from wheretolook.scorers.set.network import (
    VIEW_STATISTICS,
    MatchabilityNetwork,
    SetNetwork,
    ViewSums,
    expected_cells,
    expected_parts,
    mapped_deviations,
    mapped_precision,
)
from wheretolook.training.data import labelled_rows
from wheretolook.training.landmark_views import LandmarkBatches, load_landmark_views
from wheretolook.training.provenance import training_scenes

DISTANCE = ATTRIBUTES.index("distance")
NO_STATISTICS = FeatureStatistics(ATTRIBUTES, (0.0,) * len(ATTRIBUTES), (1.0,) * len(ATTRIBUTES))


def attributes_of(offsets):
    """Attributes of landmarks at offsets (N, 3) in the camera's axes; those of the map are 0."""
    values = np.zeros((len(offsets), len(ATTRIBUTES)))
    values[:, 0] = offsets[:, 0] / offsets[:, 2]
    values[:, 1] = offsets[:, 1] / offsets[:, 2]
    values[:, DISTANCE] = np.log(np.linalg.norm(offsets, axis=1))
    values[:, ATTRIBUTES.index("pixel_angle")] = -np.log(320)
    return torch.from_numpy(values)


@pytest.mark.parametrize("aside_deg", [0, 10, 60, 90])
def test_the_precision_of_a_track_is_that_of_its_covariance(aside_deg):
    rng = np.random.default_rng(aside_deg)
    focal_px, mapped_px, distance_m, mapped_m, n = 400.0, 900.0, 3.0, 5.0, 12
    # rays to the landmark within a few degrees of the mean direction z
    rays = np.column_stack([rng.normal(0, 0.06, n), rng.normal(0, 0.03, n), np.ones(n)])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    mean = rays.mean(0)
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    covariance = np.linalg.inv((mapped_px / mapped_m) ** 2 * across.sum(0))  # of a keypoint noise of one pixel
    angle = np.radians(aside_deg)
    bearing = np.array([np.sin(angle), 0, np.cos(angle)])
    plane = np.eye(3) - np.outer(bearing, bearing)
    variance = 1 / focal_px**2 + np.trace(plane @ covariance @ plane) / 2 / distance_m**2
    values = torch.zeros(1, len(ATTRIBUTES))
    for name, value in {
        "pixel_angle": -np.log(focal_px),
        "pixel_size_ratio": np.log(distance_m / focal_px) - np.log(mapped_m / mapped_px),
        "mapped_angle": bearing @ mean / np.linalg.norm(mean),
        "track_length": np.log(n),
        "direction_spread": 1 - np.linalg.norm(mean),
    }.items():
        values[:, ATTRIBUTES.index(name)] = value
    assert mapped_precision(values).item() == pytest.approx(1 / variance / 320**2, rel=0.05)


def test_landmarks_whose_rays_do_not_meet_have_finite_precision():
    values = torch.zeros(3, len(ATTRIBUTES))
    values[:, ATTRIBUTES.index("direction_spread")] = torch.tensor([0.0, 1e-12, 1.0])
    values[2, ATTRIBUTES.index("pixel_size_ratio")] = np.nan  # maps of released datasets have no focal length
    assert mapped_precision(values).isfinite().all() and (mapped_precision(values) > 0).all()


def test_deviations_of_a_pose_are_those_of_its_exact_covariance():
    offsets = some_offsets(60)
    values = attributes_of(offsets)
    rng = np.random.default_rng(2)
    for name, drawn in {
        "pixel_size_ratio": rng.normal(size=60),
        "mapped_angle": rng.uniform(0.5, 1, 60),
        "track_length": np.log(rng.integers(2, 20, 60)),
        "direction_spread": rng.uniform(1e-3, 0.1, 60),
    }.items():
        values[:, ATTRIBUTES.index(name)] = torch.from_numpy(drawn)
    odds = torch.from_numpy(rng.normal(size=60))
    views = ViewSums(expected_parts(values, odds).sum(0, keepdim=True), torch.tensor([60]), torch.tensor([12.0]))
    weights = odds.sigmoid().numpy() * mapped_precision(values).numpy() * 320**2
    matrix = information.information_matrices((weights[:, None] * information.bearing_numbers(offsets)).sum(0))
    covariance = np.linalg.inv(matrix)
    exact = [np.sqrt(np.trace(covariance[:3, :3])), np.degrees(np.sqrt(np.trace(covariance[3:, 3:])))]
    found = mapped_deviations(views, SetNetwork(NO_STATISTICS).statistics_of(views))
    assert found[0].exp().tolist() == pytest.approx(exact, rel=0.1)


def some_offsets(n, seed=0):
    return np.random.default_rng(seed).uniform((-1, -1, 1), (1, 1, 4), (n, 3))


def test_expectations_in_closed_form():
    offsets = some_offsets(50)
    values = attributes_of(offsets)
    rng = np.random.default_rng(1)
    odds = torch.from_numpy(rng.normal(size=50))
    focal_px = 500.0  # pixels on the landmark's surface, over those that mapped it
    ratio = rng.normal(size=50)
    values[:, ATTRIBUTES.index("pixel_angle")] = -np.log(focal_px)
    values[:, ATTRIBUTES.index("pixel_size_ratio")] = torch.from_numpy(ratio)
    sums = expected_parts(values, odds).sum(0, keepdim=True)
    views = ViewSums(sums, torch.tensor([50]), torch.tensor([12.0]))
    found = SetNetwork(NO_STATISTICS).statistics_of(views)[0].tolist()
    p = 1 / (1 + np.exp(-odds.numpy()))
    # a keypoint is off by a pixel of the camera, and the landmark by one of the images that mapped it
    weight = p * (focal_px / 320) ** 2 / (1 + np.exp(-2 * ratio))
    matrix = information.information_matrices((weight[:, None] * information.bearing_numbers(offsets)).sum(0))
    covariance = np.linalg.inv(matrix + 1e-3 * np.eye(6))
    expected = {
        "log_expected_inliers": np.log1p(p.sum()),
        "log_visible": np.log(51),
        "log_position_variance": np.log(np.trace(covariance[:3, :3])),
        "log_orientation_variance": np.log(np.trace(covariance[3:, 3:])),
        "log_expected_cells": np.log(13),
    }
    assert dict(zip(VIEW_STATISTICS, found, strict=True)) == pytest.approx(expected, rel=1e-5)


def test_expected_cells_in_closed_form():
    """Two landmarks share a cell, one lies elsewhere, one is 90 degrees off; another view has one, a third none."""
    degrees = np.array([[1.0, 1.0], [5.0, 3.0], [-40.0, 20.0], [89.99, 0.0], [0.5, 0.5]])
    values = torch.zeros(5, len(ATTRIBUTES), dtype=torch.float64)
    values[:, :2] = torch.from_numpy(np.tan(np.deg2rad(degrees)))
    odds = torch.logit(torch.tensor([0.3, 0.6, 0.25, 0.5, 0.9], dtype=torch.float64))
    views = torch.tensor([0, 0, 0, 0, 1])
    each = torch.tensor([1.0, 2.0, 1.0], dtype=torch.float64)
    found = expected_cells(values, odds, views, each)
    # the second view's landmark stands for two: it is missed only if both are
    assert_allclose(found, [1 - 0.7 * 0.4 + 0.25 + 0.5, 1 - 0.1**2, 0], rtol=1e-12)


def test_detection_is_learned_from_known_matches_only():
    network = SetNetwork(NO_STATISTICS).eval()
    values = torch.randn(3, 5, len(ATTRIBUTES))
    counts = torch.tensor([5, 2, 0])
    detected = torch.full((3, 5), torch.nan)
    detected[0] = torch.tensor([1.0, 0, 0, 1, 0])
    detected[1, :2] = 1.0
    views = values, counts, counts
    logits, loss = network.learn_more(SetConfig(landmark_loss=0.5, landmarks=10), 4.0, *views, detected)
    torch.testing.assert_close(logits, network(*views))
    p = network.matchability(values).sigmoid()
    missed = -(detected * p.log() + (1 - detected) * (1 - p).log())
    assert float(loss) == pytest.approx(0.5 * float(missed.nansum()) / (4 * 10), rel=1e-5)
    assert float(network.learn_more(SetConfig(), 4.0, *views, torch.full_like(detected, torch.nan))[1]) == 0


def test_a_sample_of_all_landmarks_scores_as_all_of_them():
    torch.manual_seed(0)
    network = SetNetwork(NO_STATISTICS).eval()
    counts = torch.tensor([30, 1, 17])
    starts = torch.tensor([0, 30, 31, 48])
    values = attributes_of(some_offsets(48)).float()
    padded = torch.full((3, 30, len(ATTRIBUTES)), 7.0)
    for view in range(3):
        padded[view, : counts[view]] = values[starts[view] : starts[view + 1]]
    described = ViewLandmarks(starts, torch.zeros(48, dtype=torch.int64), values)
    whole = network.logits(network.sums_of(described, counts))
    torch.testing.assert_close(network(padded, counts, counts), whole, rtol=1e-4, atol=1e-5)


def test_unknown_attributes_become_the_mean_and_hidden_ones_are_ignored():
    values = torch.randn(100, len(ATTRIBUTES))
    values[:, -1] = torch.nan
    statistics = FeatureStatistics.of_attributes(values)
    assert statistics.mean[-1] == 0 and statistics.std[-1] == 1
    assert statistics.mean[0] == pytest.approx(float(values[:, 0].mean()), rel=1e-5)
    network = MatchabilityNetwork(statistics, hidden=("ambiguity",))
    known = values.clone()
    known[:, -1] = 0
    assert torch.equal(network(values), network(known))
    column = ATTRIBUTES.index("ambiguity")
    known[:, column] += 1
    assert torch.equal(network(values), network(known))
    known[:, 0] += 1
    assert not torch.equal(network(values), network(known))


def test_views_by_their_landmarks(dataset):
    scenes = training_scenes(dataset)
    views = load_landmark_views(dataset, scenes, train_config(), 20, progress=False, matches=True)
    tables = pd.concat([scene.read_table(matches=True) for scene in scenes], ignore_index=True)
    assert len(views) == len(tables) and views.scene.tolist() == np.repeat([0, 1], len(tables) // 2).tolist()
    good = is_good(tables, 0.5, 5.0)
    described = [
        LandmarkDescriber(scene.localization_map(CAMERA)).describe(poses(scene.read_table())) for scene in scenes
    ]
    for at, (number, row) in enumerate(zip(views.scene.tolist(), tables.itertuples(), strict=True)):
        whole = described[number]
        view = at - number * len(tables) // 2
        all_of_view = slice(int(whole.starts[view]), int(whole.starts[view + 1]))
        values = whole.values[all_of_view].half()
        part = slice(int(views.starts[at]), int(views.starts[at + 1]))
        assert part.stop - part.start == min(20, len(values)) and views.n_visible[at] == len(values)
        same = (views.values[part][:, None] == values).all(2)
        assert (same.sum(1) == 1).all()
        if row.status == LOCALIZED:
            # inliers of a wrong pose are wrong matches
            inliers = row.inlier_rows if good[at] else []
            kept = whole.rows[all_of_view].numpy()[same.int().argmax(1).numpy()]
            assert_array_equal(views.detected[part].numpy() > 0, np.isin(kept, inliers))


def test_batches_hold_samples_of_each_view(dataset):
    views = load_landmark_views(dataset, training_scenes(dataset), train_config(), 40, progress=False)
    rows = torch.arange(5, len(views))
    loader = LandmarkBatches(views, rows, 8, 64, 3)
    first, second = (torch.cat([batch.inputs[2] for batch in loader]) for _ in range(2))
    assert not torch.equal(first, second)  # another order
    assert torch.equal(first.sort().values, views.n_visible[rows].sort().values)
    values, counts, n_visible, *_ = next(iter(LandmarkBatches(views, rows, 8, len(rows)))).inputs
    assert torch.equal(counts, n_visible.clamp(max=8)) and values.shape[1] == counts.max()
    assert torch.equal(values[0, : counts[0]].half(), views.values[views.starts[5] : views.starts[5] + counts[0]])


def test_enlarged_views_are_those_of_an_enlarged_scene(dataset):
    views = load_landmark_views(dataset, training_scenes(dataset), train_config(), 40, progress=False)
    views = replace(views, n_visible=torch.arange(len(views)))  # identifies the view
    rows = torch.arange(len(views))
    plain, large = (next(iter(LandmarkBatches(views, rows, 8, len(rows), 3, max_scale=by))) for by in (1.0, 4.0))
    changed = [DISTANCE, *(ATTRIBUTES.index(name) for name in ("mapped_distance", "mapped_pixel_size"))]
    same = [at for at in range(len(ATTRIBUTES)) if at not in changed]
    torch.testing.assert_close(large.inputs[0][..., same], plain.inputs[0][..., same], equal_nan=True)
    growth = (large.inputs[0] - plain.inputs[0])[..., changed]
    assert torch.allclose(growth, growth[:, :1, :1], atol=1e-5)  # one for all landmarks of a view
    growth = growth[:, 0, 0]
    assert growth.min() < -1.2 and growth.max() > 1.2 and growth.abs().max() <= np.log(4) + 1e-5
    table = pd.concat([labelled_rows(scene) for scene in training_scenes(dataset)], ignore_index=True)
    table = table.iloc[large.inputs[2].numpy()]
    error_m = table["error_m"].to_numpy() * growth.exp().numpy()
    good = (table["status"] == LOCALIZED) & (error_m < 0.05) & (table["error_deg"] < 0.4)
    assert np.array_equal(large.labels.numpy() > 0, good) and not torch.equal(large.labels, plain.labels)


def test_small_datasets_take_more_epochs():
    config = SetConfig()
    assert of_size(config, 200_000) is config and of_size(config, 16 * 1024) is config
    few = of_size(config, 1350)
    assert few.batch_size == 84 and few.epochs * 17 >= 600 > (few.epochs - 1) * 17
    assert of_size(config, 100).batch_size == 64 and of_size(config, 100).epochs == 300


@pytest.mark.parametrize(("world_size", "max_scale"), [(2, 1.0), (3, 3.0)])
def test_processes_share_every_batch(dataset, world_size, max_scale):
    views = load_landmark_views(dataset, training_scenes(dataset), train_config(), 40, progress=False)
    rows = torch.arange(101)  # the last batch has one view: some processes get none
    whole = list(LandmarkBatches(views, rows, 8, 20, 3, max_scale=max_scale))
    parts = [
        LandmarkBatches(views, rows, 8, 20, 3, (rank, world_size), max_scale=max_scale) for rank in range(world_size)
    ]
    for batch, shares in zip(whole, zip(*parts, strict=True), strict=True):
        assert {share.total for share in shares} == {len(batch.labels)}
        assert torch.equal(torch.cat([share.inputs[2] for share in shares]), batch.inputs[2])
        assert torch.equal(torch.cat([share.labels for share in shares]), batch.labels)
