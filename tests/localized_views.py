"""Views of a room, some of which localize less often than a scorer predicts."""

import numpy as np
from scipy.special import expit

from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.scorers.adapted.calibration import LocalizedViews


def random_views(n_locations=30, n_directions=12, seed=0, shift=0.0):
    """Views of a 6 x 6 m room; in one half of it those that look along +x do not localize, whatever a scorer thinks."""
    rng = np.random.default_rng(seed)
    centers = np.repeat(rng.uniform((-3, -3, 0.5), (3, 3, 2), (n_locations, 3)), n_directions, axis=0)
    axes = np.tile(fibonacci_sphere(n_directions), (n_locations, 1))
    log_odds = rng.normal(0, 2, len(centers))
    wrong = (centers[:, 0] > 0) & (axes[:, 0] > 0)
    good = rng.random(len(centers)) < expit(np.where(wrong, -4, log_odds) + shift)
    return LocalizedViews.rendered(log_odds, good, centers, axes, np.repeat(np.arange(n_locations), n_directions))
