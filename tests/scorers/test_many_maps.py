"""Inputs of networks that are trained on many maps: means over the landmarks expected to be detected."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from learning_options import train_config
from synthetic_dataset import CAMERA, make_landmarks
from wheretolook.dataset.layout import Dataset
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.landmark_features import ATTRIBUTES, ViewLandmarks
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.inputs.statistics import FeatureStatistics
from wheretolook.scorers.set.config import SetConfig
from wheretolook.scorers.set.learn import learn_set
from wheretolook.scorers.set.network import ALL_STATISTICS, DEFAULT_STATISTICS, OF_MANY_MAPS, SetNetwork
from wheretolook.scorers.set.score import SetScorer
from wheretolook.training import landmark_views
from wheretolook.training.learner import TrainingJob
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.training.training_range import TrainingRange

SIZE = ATTRIBUTES.index("map_size")
AMBIGUITY = ATTRIBUTES.index("ambiguity")


def network_of_many_maps() -> SetNetwork:
    torch.manual_seed(0)
    mean = np.where(np.arange(len(ATTRIBUTES)) == SIZE, 6.0, 0.5)
    statistics = FeatureStatistics(ATTRIBUTES, tuple(mean.tolist()), (2.0,) * len(ATTRIBUTES))
    return SetNetwork(statistics, view_statistics=OF_MANY_MAPS).eval()


def test_means_are_weighted_by_the_probability_of_detection() -> None:
    network = network_of_many_maps()
    values = torch.rand(7, len(ATTRIBUTES))
    values[:, SIZE] = 9.0
    values[3, AMBIGUITY] = torch.nan  # unknown: the mean of the training views
    count = torch.tensor([7])
    sums, cells = network.sums_of(ViewLandmarks(torch.tensor([0, 7]), torch.arange(7), values), count)
    found = network.statistics_of(sums, count, torch.zeros(1), cells)[0]
    p_detect = network.matchability(values).sigmoid()
    ambiguity = ((values[:, AMBIGUITY] - 0.5) / 2).nan_to_num(nan=0.0)
    expected = float((p_detect * ambiguity).sum() / p_detect.sum())
    assert float(found[ALL_STATISTICS.index("mean_ambiguity")]) == pytest.approx(expected, abs=1e-5)
    assert float(found[ALL_STATISTICS.index("mean_map_size")]) == pytest.approx((9 - 6) / 2, abs=1e-4)


def test_all_directions_at_once_score_as_single_views() -> None:
    localization_map = LocalizationMap(make_landmarks(np.random.default_rng(0), 300), CAMERA)
    scorer = SetScorer(
        localization_map, TrainedNetwork("set", network_of_many_maps(), None, 1.0, 0.0, TrainingRange({}))
    )
    assert not scorer.local  # the size of the map changes with every landmark
    locations = np.array([[0.0, 0.0, 1.0], [0.5, -0.5, 1.2]])
    directions = fibonacci_sphere(40)
    together = scorer.score_directions(locations, directions)
    poses = poses_looking_along(np.repeat(locations, 40, axis=0), np.tile(directions, (2, 1)))
    single = scorer.score(poses).reshape(2, 40)
    assert np.ptp(single) > 0.01
    np.testing.assert_allclose(together, single, atol=1e-5)


@pytest.mark.parametrize("many", [True, False])
def test_few_training_maps_do_not_use_the_size_of_the_map(
    many: bool, dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(landmark_views, "MANY_MAPS", 1 if many else 20)
    task = TrainingJob(dataset, "set", train_config(), SetConfig(epochs=1, from_matchability=False))
    network = learn_set(task).model.network
    assert network.uses("map_size") == many
    assert network.view_statistics == (OF_MANY_MAPS if many else DEFAULT_STATISTICS)
