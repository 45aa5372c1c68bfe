"""The table of layers and the values in them are those of the network."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from wheretolook.inputs.bins import BinnedViews, InputStatistics
from wheretolook.inputs.channels import CHANNELS, PAPER_VARIANTS
from wheretolook.scorers.mlp.network import NetworkSpec, ViewpointNetwork
from wheretolook_paper.release.mlp_architecture import activations, architecture_table


def make_network(variant: str, **options) -> ViewpointNetwork:  # type: ignore[no-untyped-def]
    torch.manual_seed(0)
    channels = PAPER_VARIANTS[variant]
    statistics = InputStatistics(channels, (1.0,) * len(channels), (2.0,) * len(channels))
    return ViewpointNetwork(NetworkSpec(statistics, **options)).eval()


def test_the_papers_networks_have_their_sizes() -> None:
    for variant, size in (("2d", 1800), ("2d+z", 2700), ("2d+3d", 4500)):
        network = make_network(variant)
        table = architecture_table(network)
        linear = table[table["layer"] == "fully connected"]
        assert linear[["in", "out"]].to_numpy().tolist() == [[size, 300], [300, 300], [300, 1]]
        assert linear["parameters"].tolist() == [size * 300 + 300, 300 * 300 + 300, 301]
        assert table["layer"].tolist()[-2:] == ["sigmoid", "all"]
        assert table["parameters"].iloc[-1] == sum(p.numel() for p in network.parameters())
        assert (table["in"].iloc[1:-1].to_numpy() == table["out"].iloc[:-2].to_numpy()).all()


@pytest.mark.parametrize("variant", ["2d", "2d+3d"])
def test_activations_end_in_the_networks_score(variant: str) -> None:
    network = make_network(variant, hidden=(30, 20))
    rng = np.random.default_rng(0)
    counts = rng.integers(0, 2, (1, 30, 30)).astype(np.int32)
    means = (rng.normal(size=(1, len(CHANNELS), 30, 30)) * (counts[:, None] > 0)).astype(np.float32)
    inputs, first, second, score = activations(network, BinnedViews(means, counts, CHANNELS))
    chosen = [CHANNELS.index(name) for name in network.spec.channels]
    with torch.inference_mode():
        logit = network(torch.from_numpy(means[:, chosen]), torch.from_numpy(counts > 0))
    assert score == pytest.approx(logit.double().sigmoid().numpy())
    assert (first.shape, second.shape) == ((30,), (20,)) and first.min() >= 0
    rows = [CHANNELS.index(name) for name in PAPER_VARIANTS[variant]]
    np.testing.assert_allclose(inputs, (means[0, rows] - 1) / 2 * (counts[0] > 0), atol=1e-6)
