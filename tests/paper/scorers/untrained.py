"""Weights of the paper's learners whose scores differ from view to view."""

import numpy as np

from learning_options import save_network
from synthetic_dataset import CAMERA
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.channels import ALL_CHANNELS
from wheretolook.inputs.landmark_features import LandmarkDescriber
from wheretolook.inputs.statistics import FeatureStatistics
from wheretolook_paper.scorers.conv.network import ConvNetwork, ConvSpec
from wheretolook_paper.scorers.pooled_features import pool
from wheretolook_paper.scorers.sphere import SphereConfig
from wheretolook_paper.scorers.sphere.network import SphereNetwork
from wheretolook_paper.scorers.trees import TreesConfig
from wheretolook_paper.scorers.trees.learn import PooledViews, fit_trees


def some_trees(localization_map):
    """Trees whose scores differ from view to view."""
    rng = np.random.default_rng(2)
    directions = poses_looking_along(rng.uniform((-1, -1, 1), (1, 1, 2), (300, 3)), rng.normal(size=(300, 3)))
    values = pool(LandmarkDescriber(localization_map).describe(directions), directions, CAMERA).numpy()
    labels = np.nan_to_num(values[:, 0] + values[:, 10]) + rng.normal(size=300) > 3
    views = PooledViews(values, labels, np.zeros(300, int), np.arange(300), np.zeros((300, 6)))
    return fit_trees(views, views, CAMERA, TreesConfig(max_trees=10, max_leaves=15, min_leaf=3))[0]


def save_untrained(method, path, localization_map):
    """Write weights of conv, sphere or trees."""
    if method == "trees":
        some_trees(localization_map).save(path, {})
        return path
    if method == "sphere":
        return save_network(path, method, SphereNetwork(SphereConfig()))
    mean = (80.0, 60.0, 0.0, 0.0, 2.0, *[0.5] * (len(ALL_CHANNELS) - 5))
    std = (40.0, 30.0, *[1.0] * (len(ALL_CHANNELS) - 2))
    return save_network(
        path, method, ConvNetwork(ConvSpec(FeatureStatistics(ALL_CHANNELS, mean, std), 30, (8, 8), 0.0))
    )
