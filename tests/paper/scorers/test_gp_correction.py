"""Adaptation of log-odds to a scene by a Gaussian process, against scikit-learn's."""

import numpy as np
from scipy.special import expit
from sklearn.gaussian_process import GaussianProcessClassifier
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.scorers.adapted.calibration import PRIOR, LocalizedViews, log_losses
from wheretolook_paper.scorers.gp_correction import Correction, adapt, fit, nearness


def random_views(n_locations=30, n_directions=12, seed=0, shift=0.0):
    """Views of a 6 x 6 m room; in one half of it those that look along +x do not localize, whatever a scorer thinks."""
    rng = np.random.default_rng(seed)
    centers = np.repeat(rng.uniform((-3, -3, 0.5), (3, 3, 2), (n_locations, 3)), n_directions, axis=0)
    axes = np.tile(fibonacci_sphere(n_directions), (n_locations, 1))
    log_odds = rng.normal(0, 2, len(centers))
    wrong = (centers[:, 0] > 0) & (axes[:, 0] > 0)
    good = rng.random(len(centers)) < expit(np.where(wrong, -4, log_odds) + shift)
    return LocalizedViews.rendered(log_odds, good, centers, axes, np.repeat(np.arange(n_locations), n_directions))


def test_the_correction_is_scikit_learns_gaussian_process():
    views = random_views()
    flat = LocalizedViews.rendered(np.zeros(len(views)), views.good, views.centers, views.axes, views.group)
    # without log-odds, offset and correction are one process, of both kernels; its reach covers the room
    kernel = ConstantKernel(3.0) * RBF(2.0) + ConstantKernel(1 / PRIOR[1])
    theirs = GaussianProcessClassifier(kernel, optimizer=None, max_iter_predict=100).fit(views.centers, views.good)
    theirs = theirs.base_estimator_
    latent = theirs.kernel_(views.centers, theirs.X_train_) @ (theirs.y_train_ - theirs.pi_)
    ours = fit(flat, 2.0, 3.0, sharpness=0.0)
    np.testing.assert_allclose(ours.log_odds(flat), latent, atol=5e-3)


def test_adapting_corrects_the_scorer_where_it_is_wrong():
    views = random_views(60)
    other = random_views(60, seed=1)
    fitted = adapt(views)
    assert fitted.amplitude > 0
    before = log_losses(other.log_odds, other.good).mean()
    after = log_losses(fitted.adaptation.log_odds(other), other.good).mean()
    assert after < 0.7 * before
    assert abs(log_losses(fitted.held_out, views.good).mean() - after) < 0.1  # held-out loss is that of new views


def test_noise_is_not_fitted():
    views = random_views(60)
    good = np.random.default_rng(3).random(len(views)) < expit(views.log_odds)
    honest = LocalizedViews.rendered(views.log_odds, good, views.centers, views.axes, views.group)
    assert log_losses(adapt(honest).held_out, good).mean() < log_losses(views.log_odds, good).mean() + 0.01


def test_corrections_are_the_plain_sum():
    views = random_views(20)
    weights = np.random.default_rng(0).normal(size=len(views))
    correction = Correction(views.centers, views.axes, weights, 0.7, 4.0)
    locations = np.array([[0.0, 0, 1], [1, 2, 1], [50, 0, 0]])
    at = np.repeat(locations, 9, axis=0)
    axes = np.tile(fibonacci_sphere(9), (3, 1))
    plain = nearness(at, axes, views.centers, views.axes, 0.7, 4.0) @ weights
    np.testing.assert_allclose(correction.at(at, axes), plain, atol=1e-12)
    assert (plain[18:] == 0).all()  # far away nothing is known
