"""Inputs of the network, and weights on disk."""

import numpy as np
import pytest
import torch

from twins.bins import compact as move_to_front_plain
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.inputs.channels import ALL_CHANNELS, LANDMARK_CHANNELS, PAPER_VARIANTS
from wheretolook.inputs.statistics import FeatureStatistics
from wheretolook.scorers.mlp.network import BinnedInput, NetworkSpec, ViewpointNetwork, move_to_front

BINS = 6
INPUTS = {**PAPER_VARIANTS, "2d+3d+landmark": ALL_CHANNELS}
CAMERA = PinholeCamera(64, 48, 32.0)


@pytest.fixture
def views():
    """Random binned views with all channels; view 0 sees nothing."""
    generator = torch.Generator().manual_seed(0)
    filled = torch.rand((50, BINS, BINS), generator=generator) < 0.4
    filled[0] = False
    scale = torch.tensor([100.0, 70.0, 1.0, 2.0, 5.0] + [0.3] * len(LANDMARK_CHANNELS))[:, None, None]
    values = torch.randn((50, len(ALL_CHANNELS), BINS, BINS), generator=generator)
    return (values + 3) * scale * filled[:, None], filled


def make_network(views, variant="2d+z", **options):
    statistics = FeatureStatistics.of_bins(*views, torch.arange(50), ALL_CHANNELS).select(INPUTS[variant])
    torch.manual_seed(1)
    spec = NetworkSpec(statistics, bins=BINS, hidden=(8, 8), **options)
    return ViewpointNetwork(spec).eval()


@pytest.mark.parametrize("variant", INPUTS)
def test_standardized_inputs_have_mean_0_and_deviation_1_where_filled_and_are_0_elsewhere(views, variant):
    means, filled = views
    statistics = FeatureStatistics.of_bins(means, filled, torch.arange(50), ALL_CHANNELS).select(INPUTS[variant])
    layer = BinnedInput(NetworkSpec(statistics, bins=BINS))
    chosen = [ALL_CHANNELS.index(name) for name in statistics.names]
    values = layer(means[:, chosen], filled).reshape(50, -1, BINS, BINS)
    assert values.shape[1] == len(INPUTS[variant])
    for channel in values.unbind(1):
        assert torch.all(channel[~filled] == 0)
        assert channel[filled].mean().item() == pytest.approx(0, abs=1e-5)
        assert channel[filled].std(correction=0).item() == pytest.approx(1, abs=1e-4)


def test_unknown_landmark_attributes_become_the_mean_of_known_ones(views):
    means, filled = views
    ambiguity, spread = (ALL_CHANNELS.index(name) for name in ("ambiguity", "distance_spread"))
    means[:20, ambiguity] = torch.where(filled[:20], torch.nan, 0.0)  # a map without descriptors
    means[:, spread] = torch.where(filled, torch.nan, 0.0)  # known of no map
    statistics = FeatureStatistics.of_bins(means, filled, torch.arange(50), ALL_CHANNELS)
    rest = FeatureStatistics.of_bins(means[20:], filled[20:], torch.arange(30), ALL_CHANNELS)
    assert statistics.mean[ambiguity] == pytest.approx(rest.mean[ambiguity], rel=1e-9)
    assert statistics.std[ambiguity] == pytest.approx(rest.std[ambiguity], rel=1e-6)
    values = BinnedInput(NetworkSpec(statistics, bins=BINS))(means, filled).reshape(means.shape)
    assert values.isfinite().all()
    assert torch.all(values[:20, ambiguity] == 0) and values[20:, ambiguity].std() > 0.1
    assert torch.all(values[:, spread] == 0)


def test_compact_layout_is_the_one_of_features(views):
    means, filled = views
    expected = move_to_front_plain(means.numpy(), filled.numpy())
    np.testing.assert_array_equal(move_to_front(means, filled).numpy(), expected)
    in_place = make_network(views)
    compact = make_network(views, layout="compact")
    compact.load_state_dict(in_place.state_dict())
    chosen = means[:, [ALL_CHANNELS.index(name) for name in in_place.spec.channels]]
    assert not torch.allclose(in_place(chosen, filled), compact(chosen, filled))
