"""Every method against hand-counted views, and the contract that all of them keep."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from learning_options import save_network
from synthetic_dataset import CAMERA, make_landmarks, make_mapping_poses
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.bins import BinnedViews
from wheretolook.inputs.channels import CHANNELS
from wheretolook.inputs.landmark_features import ATTRIBUTES
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.inputs.statistics import FeatureStatistics
from wheretolook.mapping.map import Map
from wheretolook.scorers.adapted.score import AdaptedNetwork
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.bins import BinsScorer
from wheretolook.scorers.mlp.network import NetworkSpec, ViewpointNetwork
from wheretolook.scorers.registry import make_scorer, scorers
from wheretolook.scorers.set.network import MatchabilityNetwork, SetNetwork
from wheretolook.scorers.visible import VisibleScorer
from wheretolook.scorers.weights import load_scorer
from wheretolook.utils.errors import CameraError, ConfigError, PoseError, WeightsError


@pytest.fixture
def localization_map():
    landmarks = make_landmarks(np.random.default_rng(0), 200)
    return LocalizationMap(Map(landmarks, mapping_poses=make_mapping_poses(0)), CAMERA)


@pytest.fixture
def views():
    rng = np.random.default_rng(1)
    return poses_looking_along(rng.uniform((-1, -1, 1), (1, 1, 2), (40, 3)), rng.normal(size=(40, 3)))


NO_STATISTICS = FeatureStatistics(ATTRIBUTES, (0.0,) * len(ATTRIBUTES), (1.0,) * len(ATTRIBUTES))


def weights_of(method, path, localization_map):
    """Write untrained weights of a method, whose scores differ from view to view."""
    torch.manual_seed(0)
    if method.startswith("mlp"):
        statistics = FeatureStatistics(CHANNELS, (80.0, 60.0, 0.0, 0.0, 2.0), (40.0, 30.0, 1.0, 1.0, 1.0))
        network = ViewpointNetwork(NetworkSpec(statistics, hidden=(16,)))
    elif method in ("conv", "sphere", "trees"):
        from paper.scorers.untrained import save_untrained

        return save_untrained(method, path, localization_map)
    elif method == "matchability":
        network = MatchabilityNetwork(NO_STATISTICS)
    else:
        network = SetNetwork(NO_STATISTICS)
        if method == "adapted":
            network = AdaptedNetwork(network, 1.0, 0.0, 0)
    return save_network(path, method, network)


@pytest.fixture
def weights(tmp_path, localization_map):
    return weights_of("mlp-2d+3d", tmp_path / "mlp.safetensors", localization_map)


@pytest.mark.parametrize("name", scorers())
def test_scorers_keep_their_contract(name, localization_map, views, weights, monkeypatch):
    needed = scorers()[name].weights
    if needed:
        weights = weights_of(needed, weights.with_name(f"{needed}.safetensors"), localization_map)
    scorer = make_scorer(name, localization_map, seed=3, weights=weights)
    assert isinstance(scorer, Scorer)
    assert scorer.name == name
    scores = scorer.score(views)
    assert scores.shape == (40,)
    assert scores.dtype == np.float64
    assert np.isfinite(scores).all()
    assert name.startswith("fisher") or np.all((scores >= 0) & (scores <= 1))
    assert len(np.unique(scores)) > 5
    order = np.random.default_rng(0).permutation(40)
    # networks compute in single precision, which a determinant or least eigenvalue of what they weigh magnifies
    rtol = 2e-5 if "expected" in name else 1e-6
    assert_allclose(scorer.score(views[order]), scores[order], rtol=rtol)  # a pose's score is its own
    assert_allclose(scorer.score(views[7:8]), scores[7:8], rtol=rtol)
    assert_array_equal(scorer.score_binned(views, localization_map.bin_views(views)), scores)
    monkeypatch.setattr("wheretolook.scorers.base.BLOCK", 7)
    assert_allclose(scorer.score(views), scores, rtol=rtol)
    assert scorer.score(views[:0]).shape == (0,)
    unknown = replace(localization_map.landmarks, ambiguity=np.full(200, np.nan, np.float32))
    without_ambiguity = replace(localization_map, map=replace(localization_map.map, landmarks=unknown))
    assert np.isfinite(make_scorer(name, without_ambiguity, seed=3, weights=weights).score(views)).all()
    invalid = views.copy()
    invalid[3, 1, 2] = np.nan
    for method in (scorer.score, scorer.in_range, scorer.report):
        with pytest.raises(PoseError):
            method(invalid)
    with pytest.raises(PoseError):
        scorer.score_directions(np.array([[0.0, np.inf, 1]]), np.array([[1.0, 0, 0]]))


def _binned(counts):
    """Views of 2 x 2 bins with so many landmarks each."""
    array = np.array(counts, dtype=np.int32).reshape(-1, 2, 2)
    return BinnedViews(np.zeros((len(array), len(CHANNELS), 2, 2), dtype=np.float32), array, CHANNELS)


def test_counting_scorers_on_hand_counted_bins(localization_map):
    binned = _binned([[0, 0, 0, 0], [9, 0, 0, 0], [1, 1, 0, 0], [1, 2, 0, 0], [1, 1, 1, 1], [50, 50, 50, 50]])
    assert_allclose(VisibleScorer(localization_map, bins=2).score_bins(binned) * 200, [0, 9, 2, 3, 4, 200], rtol=1e-12)
    by_bins = BinsScorer(localization_map, bins=2).score_bins(binned)
    # one bin with nine landmarks loses to two bins with one each; landmarks decide between equal bins
    assert_array_equal(np.argsort(by_bins), [0, 1, 2, 3, 4, 5])
    assert_array_equal(np.floor(by_bins * 5), [0, 1, 2, 2, 4, 4])
    assert by_bins.max() < 1


def test_random_scores_are_uniform_and_depend_on_the_seed(rng, localization_map):
    views = poses_looking_along(np.zeros((20000, 3)), rng.normal(size=(20000, 3)))
    a, b = (make_scorer("random", localization_map, seed=seed).score(views) for seed in (0, 1))
    assert np.abs(np.histogram(a, 20, (0, 1))[0] - 1000).max() < 6 * np.sqrt(1000)
    assert abs(np.corrcoef(a, b)[0, 1]) < 0.03


def test_learned_scores_equal_the_network_by_hand(localization_map, views, weights):
    scorer = load_scorer(localization_map, weights)
    assert scorer.name == "mlp-2d+3d"
    binned = localization_map.bin_views(views)
    network = scorer.network
    mean = np.array(network.spec.statistics.mean, dtype=np.float32)[:, None, None]
    std = np.array(network.spec.statistics.std, dtype=np.float32)[:, None, None]
    values = np.where(binned.counts[:, None] > 0, (binned.means - mean) / std, 0).reshape(40, -1)
    first = network.layers[0]
    last = network.layers[-1]
    hidden = np.maximum(values @ first.weight.numpy().T + first.bias.numpy(), 0)
    logits = hidden @ last.weight.numpy().T + last.bias.numpy()
    assert_allclose(scorer.score(views), 1 / (1 + np.exp(-logits[:, 0])), rtol=1e-5)


def test_another_resolution_of_the_same_field_of_view_scores_the_same(localization_map, views, weights):
    double = PinholeCamera(2 * CAMERA.width, 2 * CAMERA.height, 2 * CAMERA.focal_px)
    scores = load_scorer(LocalizationMap(Map(localization_map.landmarks), double), weights).score(views)
    assert_allclose(scores, load_scorer(localization_map, weights).score(views), rtol=1e-5)


@pytest.mark.parametrize(
    ("method", "focal_scale", "error"),
    [("oracle", 1, ConfigError), ("mlp", 1, ConfigError), ("set", 1, WeightsError), ("mlp-2d+3d", 2, CameraError)],
)
def test_invalid_requests(method, focal_scale, error, localization_map, weights):
    camera = PinholeCamera(CAMERA.width, CAMERA.height, focal_scale * CAMERA.focal_px)
    with pytest.raises(error):
        make_scorer(method, localization_map.of_camera(camera), weights=None if method == "mlp" else weights)
