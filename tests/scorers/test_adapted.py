"""Calibration of log-odds to a scene, and adapted weights."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from scipy.special import expit

from synthetic_dataset import make_dataset
from wheretolook.evaluation.statistics import expected_calibration_error
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.map import Map
from wheretolook.scorers.adapted.calibration import LocalizedViews, adapt, calibrate, log_losses, splits
from wheretolook.scorers.adapted.score import AdaptedNetwork
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.scorers.weights import load_scorer
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.training.weights import read_weights, write_weights
from wheretolook.utils.errors import WeightsError
from wheretolook.utils.package import WEIGHTS, shipped

SET = shipped(WEIGHTS) / "set.safetensors"


def test_calibration_alone_is_platts(rng):
    from sklearn.linear_model import LogisticRegression

    log_odds = rng.normal(0, 2, 3600)
    good = rng.random(3600) < expit(0.8 * log_odds + 0.7)
    views = LocalizedViews.rendered(log_odds, good, np.zeros((3600, 3)), np.zeros((3600, 3)), np.arange(3600))
    scale, offset = calibrate(views)
    platt = LogisticRegression(C=np.inf).fit(views.log_odds[:, None], views.good)
    assert abs(scale - platt.coef_[0, 0]) < 0.02 and abs(offset - platt.intercept_[0]) < 0.02


def photographed(shift, seed=0):
    """Return 120 photographs held out in six groups and again in two large ones; log-odds are too low by a shift."""
    rng = np.random.default_rng(seed)
    n = 120
    photograph = np.concatenate([np.arange(n), np.arange(n)])
    group = np.concatenate([np.repeat(np.arange(6), n // 6), np.repeat([6, 7], n // 2)])
    centers = rng.uniform((-3, -3, 0.5), (3, 3, 2), (n, 3))[photograph]
    axes = fibonacci_sphere(n)[rng.permutation(n)][photograph]
    log_odds = rng.normal(0, 2, 2 * n)
    good = rng.random(2 * n) < expit(log_odds + shift)
    return LocalizedViews(log_odds, good, centers, axes, group, photograph, photograph // 4)


def test_photographs_calibrate():
    views = photographed(2.0)
    fitted = adapt(views)
    assert log_losses(fitted.held_out, views.good).mean() < log_losses(views.log_odds, views.good).mean() - 0.1
    before, after = (expected_calibration_error(expit(z), views.good) for z in (views.log_odds, fitted.held_out))
    assert after < before / 2
    assert fitted.scale == pytest.approx(1, abs=0.4)
    assert fitted.offset == pytest.approx(2, abs=0.8)


def test_photographs_are_judged_by_blocks_that_share_none_with_those_trained_on():
    views = photographed(0.0)
    judged = np.zeros(len(views), dtype=int)
    for out, trained_on in splits(views):
        judged += out
        assert len(np.unique(views.group[out])) == 1 and len(trained_on) > 0
        assert not np.isin(trained_on.photograph, views.photograph[out]).any()
    assert (judged == 1).all()


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A map, and weights adapted to it."""
    scene = make_dataset(tmp_path_factory.mktemp("data") / "place", ("test",)).scenes[0]
    localization_map = LocalizationMap(Map(scene.read_landmarks()), scene.camera)
    base = TrainedNetwork.load(SET, SetNetwork, "set")
    network = AdaptedNetwork(base.network, base.scale, base.offset, 50)
    network.place = torch.from_numpy(localization_map.landmarks.points[:50].copy())
    path = scene.folder / "adapted.safetensors"
    TrainedNetwork("adapted", network, base.camera, 0.9, 0.2, base.training_range).save(path, {"scene": "place"})
    return localization_map, path


def test_a_file_of_adapted_weights_scores_as_it_says(place):
    localization_map, path = place
    adapted = load_scorer(localization_map, path)
    base = load_scorer(localization_map, SET)
    locations = np.array([[0.0, 0, 1], [0.5, 0.5, 1]])
    directions = fibonacci_sphere(20)
    poses = poses_looking_along(np.repeat(locations, 20, axis=0), np.tile(directions, (2, 1)))
    p = base.score(poses)
    expected = expit(0.9 * np.log(p / (1 - p)) + 0.2)
    assert_allclose(adapted.score(poses), expected, atol=1e-9)
    assert_allclose(adapted.report(poses).score, expected, atol=1e-9)
    assert_allclose(adapted.report(poses).expected_inliers, base.report(poses).expected_inliers)
    assert_allclose(adapted.score_directions(locations, directions).ravel(), expected, atol=0.01)
    assert adapted.name == "adapted"


def test_they_are_refused_in_another_scene_unless_forced(place):
    localization_map, path = place
    landmarks = localization_map.landmarks
    moved = Landmarks(**{**landmarks.__dict__, "points": landmarks.points + np.array([0.5, 0, 0])})
    other = LocalizationMap(Map(moved), localization_map.camera)
    with pytest.raises(WeightsError):
        load_scorer(other, path)
    assert load_scorer(other, path, anywhere=True).name == "adapted"


def test_weights_with_a_gaussian_process_are_refused_by_name(place):
    localization_map, path = place
    tensors, header = read_weights(path)
    older = path.with_name("older.safetensors")
    process = {"kernel": {"length_m": 1.0, "sharpness": 4.0}, "support": 0}
    write_weights(older, "adapted", tensors, {**header, **process})
    with pytest.raises(WeightsError, match="adapt") as raised:
        load_scorer(localization_map, older)
    assert raised.value.path == older
