"""Adaptation of log-odds to a scene, against scikit-learn's Gaussian process; and adapted weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.special import expit
from sklearn.gaussian_process import GaussianProcessClassifier
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from synthetic_dataset import make_dataset
from wheretolook.evaluation.statistics import expected_calibration_error
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import camera_centers, poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.scorers.adapted.gp_correction import PRIOR, LocalizedViews, adapt, fit, log_losses, splits
from wheretolook.scorers.adapted.kernel import Correction, nearness
from wheretolook.scorers.adapted.network import AdaptedNetwork
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.scorers.weights import load_scorer
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.utils.errors import WeightsError
from wheretolook.utils.shipped import WEIGHTS, shipped

SET = shipped(WEIGHTS) / "set.safetensors"


def random_views(n_locations: int = 30, n_directions: int = 12, seed: int = 0, shift: float = 0.0) -> LocalizedViews:
    """Views of a 6 x 6 m room; in one half of it those that look along +x do not localize, whatever a scorer thinks."""
    rng = np.random.default_rng(seed)
    centers = np.repeat(rng.uniform((-3, -3, 0.5), (3, 3, 2), (n_locations, 3)), n_directions, axis=0)
    axes = np.tile(fibonacci_sphere(n_directions), (n_locations, 1))
    log_odds = rng.normal(0, 2, len(centers))
    wrong = (centers[:, 0] > 0) & (axes[:, 0] > 0)
    good = rng.random(len(centers)) < expit(np.where(wrong, -4, log_odds) + shift)
    return LocalizedViews.rendered(log_odds, good, centers, axes, np.repeat(np.arange(n_locations), n_directions))


def test_the_correction_is_scikit_learns_gaussian_process() -> None:
    views = random_views()
    flat = LocalizedViews.rendered(np.zeros(len(views)), views.good, views.centers, views.axes, views.group)
    # without log-odds, offset and correction are one process, of both kernels; its reach covers the room
    kernel = ConstantKernel(3.0) * RBF(2.0) + ConstantKernel(1 / PRIOR[1])
    theirs = GaussianProcessClassifier(kernel, optimizer=None, max_iter_predict=100).fit(views.centers, views.good)
    theirs = theirs.base_estimator_
    latent = theirs.kernel_(views.centers, theirs.X_train_) @ (theirs.y_train_ - theirs.pi_)
    ours = fit(flat, 2.0, 3.0, sharpness=0.0)
    np.testing.assert_allclose(ours.log_odds(flat), latent, atol=5e-3)


def test_calibration_alone_is_platts() -> None:
    from sklearn.linear_model import LogisticRegression

    views = random_views(300, shift=0.7)
    ours = fit(views, 1.0, 0.0)
    platt = LogisticRegression(C=np.inf).fit(views.log_odds[:, None], views.good)
    assert abs(ours.scale - platt.coef_[0, 0]) < 0.02 and abs(ours.offset - platt.intercept_[0]) < 0.02
    assert len(ours.weights) == 0


def test_adapting_corrects_the_scorer_where_it_is_wrong() -> None:
    views = random_views(60)
    other = random_views(60, seed=1)
    fitted = adapt(views)
    assert fitted.amplitude > 0
    before = log_losses(other.log_odds, other.good).mean()
    after = log_losses(fitted.adaptation.log_odds(other), other.good).mean()
    assert after < 0.7 * before
    assert abs(log_losses(fitted.held_out, views.good).mean() - after) < 0.1  # held-out loss is that of new views


def test_noise_is_not_fitted() -> None:
    views = random_views(60)
    good = np.random.default_rng(3).random(len(views)) < expit(views.log_odds)
    honest = LocalizedViews.rendered(views.log_odds, good, views.centers, views.axes, views.group)
    assert log_losses(adapt(honest).held_out, good).mean() < log_losses(views.log_odds, good).mean() + 0.01


def photographed(shift: float, seed: int = 0) -> LocalizedViews:
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


def test_photographs_calibrate() -> None:
    views = photographed(2.0)
    fitted = adapt(views)
    assert log_losses(fitted.held_out, views.good).mean() < log_losses(views.log_odds, views.good).mean() - 0.1
    before, after = (expected_calibration_error(expit(z), views.good) for z in (views.log_odds, fitted.held_out))
    assert after < before / 2
    assert fitted.adaptation.scale == pytest.approx(1, abs=0.4)
    assert fitted.adaptation.offset == pytest.approx(2, abs=0.8)


def test_photographs_are_judged_by_blocks_that_share_none_with_those_trained_on() -> None:
    views = photographed(0.0)
    judged = np.zeros(len(views), dtype=int)
    for out, trained_on in splits(views):
        judged += out
        assert len(np.unique(views.group[out])) == 1 and len(trained_on) > 0
        assert not np.isin(trained_on.photograph, views.photograph[out]).any()
    assert (judged == 1).all()


def test_corrections_one_by_one_and_on_a_grid_are_the_plain_sum() -> None:
    views = random_views(20)
    weights = np.random.default_rng(0).normal(size=len(views))
    correction = Correction(views.centers, views.axes, weights, 0.7, 4.0)
    locations = np.array([[0.0, 0, 1], [1, 2, 1], [50, 0, 0]])
    directions = fibonacci_sphere(9)
    at = np.repeat(locations, 9, axis=0)
    axes = np.tile(directions, (3, 1))
    plain = nearness(at, axes, views.centers, views.axes, 0.7, 4.0) @ weights
    np.testing.assert_allclose(correction.at(at, axes), plain, atol=1e-12)
    np.testing.assert_allclose(correction.grid(locations, directions).ravel(), plain, atol=1e-12)
    assert (plain[18:] == 0).all()  # far away nothing is known


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> tuple[LocalizationMap, Path]:
    """A map, and weights adapted to it by one view that does not localize."""
    scene = make_dataset(tmp_path_factory.mktemp("data") / "place", ("test",)).scenes[0]
    localization_map = LocalizationMap(scene.read_landmarks(), scene.camera)
    base = TrainedNetwork.load(SET, SetNetwork, "set")
    network = AdaptedNetwork(base.network, base.scale, base.offset, 1.0, 4.0, 1, 50)
    network.support_centers = torch.tensor([[0.0, 0, 1]], dtype=torch.float64)
    network.support_axes = torch.tensor([[1.0, 0, 0]], dtype=torch.float64)
    network.support_weights = torch.tensor([-3.0], dtype=torch.float64)
    network.place = torch.from_numpy(localization_map.landmarks.points[:50].copy())
    path = scene.folder / "adapted.safetensors"
    TrainedNetwork("adapted", network, base.camera, 0.9, 0.2, base.training_range).save(path, {"scene": "place"})
    return localization_map, path


def test_a_file_of_adapted_weights_scores_as_it_says(place: tuple[LocalizationMap, Path]) -> None:
    localization_map, path = place
    adapted = load_scorer(path, localization_map)
    base = load_scorer(SET, localization_map)
    locations = np.array([[0.0, 0, 1], [0.5, 0.5, 1]])
    directions = fibonacci_sphere(20)
    poses = poses_looking_along(np.repeat(locations, 20, axis=0), np.tile(directions, (2, 1)))
    p = base.score(poses)
    distance = np.linalg.norm(camera_centers(poses) - (0, 0, 1), axis=1)
    bad = -3 * np.exp(-(distance**2) / 2 + 4 * (poses[:, 2, 0] - 1))
    expected = expit(0.9 * np.log(p / (1 - p)) + 0.2 + bad)
    np.testing.assert_allclose(adapted.score(poses), expected, atol=1e-9)
    np.testing.assert_allclose(adapted.report(poses).score, expected, atol=1e-9)
    np.testing.assert_allclose(adapted.report(poses).expected_inliers, base.report(poses).expected_inliers)
    np.testing.assert_allclose(adapted.score_directions(locations, directions).ravel(), expected, atol=0.01)
    assert adapted.name == "adapted"


def test_they_are_refused_in_another_scene_unless_forced(place: tuple[LocalizationMap, Path]) -> None:
    localization_map, path = place
    landmarks = localization_map.landmarks
    moved = Landmarks(**{**landmarks.__dict__, "points": landmarks.points + np.array([0.5, 0, 0])})
    other = LocalizationMap(moved, localization_map.camera)
    with pytest.raises(WeightsError):
        load_scorer(path, other)
    assert load_scorer(path, other, anywhere=True).name == "adapted"
