"""A convolutional network over the bins."""

from __future__ import annotations

from wheretolook.scorers.method import Method, MethodStyle, imported, network_scorer
from wheretolook_paper.scorers.conv.config import ConvConfig

METHODS = (
    Method(
        position=90,
        name="conv",
        about="Probability that a view localizes, by a convolutional network on binned landmarks and their attributes.",
        style=MethodStyle("convolutional, landmark attributes", "#AA4499", "8", (0, (3, 1))),
        group="learned",
        build=network_scorer(
            "wheretolook.scorers.binned_network:BinnedNetworkScorer",
            "wheretolook_paper.scorers.conv.network:ConvNetwork",
            "conv",
        ),
        weights="conv",
        probability=True,
        one_camera=True,
        learn=imported("wheretolook_paper.scorers.conv.learn:learn_conv"),
        config=ConvConfig,
        folder="conv",
    ),
)
