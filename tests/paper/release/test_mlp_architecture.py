"""The table of layers and the values in them are those of the network."""

import torch

from wheretolook.inputs.channels import PAPER_VARIANTS
from wheretolook.inputs.statistics import FeatureStatistics
from wheretolook.scorers.mlp.network import NetworkSpec, ViewpointNetwork
from wheretolook_paper.release.mlp_architecture import architecture_table


def make_network(variant, **options):
    torch.manual_seed(0)
    channels = PAPER_VARIANTS[variant]
    statistics = FeatureStatistics(channels, (1.0,) * len(channels), (2.0,) * len(channels))
    return ViewpointNetwork(NetworkSpec(statistics, **options)).eval()


def test_the_papers_networks_have_their_sizes():
    for variant, size in (("2d", 1800), ("2d+z", 2700), ("2d+3d", 4500)):
        network = make_network(variant)
        table = architecture_table(network)
        linear = table[table["layer"] == "fully connected"]
        assert linear[["in", "out"]].to_numpy().tolist() == [[size, 300], [300, 300], [300, 1]]
        assert linear["parameters"].tolist() == [size * 300 + 300, 300 * 300 + 300, 301]
        assert table["layer"].tolist()[-2:] == ["sigmoid", "all"]
        assert table["parameters"].iloc[-1] == sum(p.numel() for p in network.parameters())
        assert (table["in"].iloc[1:-1].to_numpy() == table["out"].iloc[:-2].to_numpy()).all()
