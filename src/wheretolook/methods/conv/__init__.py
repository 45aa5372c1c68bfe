"""A convolutional network over the bins."""

from __future__ import annotations

from wheretolook.methods.conv.config import ConvConfig
from wheretolook.methods.method import Method, MethodStyle, imported, network_scorer

METHODS = (
    Method(
        name="conv",
        about="A convolutional network on the binned landmarks and how they were mapped: the probability that a view "
        "localizes.",
        style=MethodStyle("convolutional, landmark attributes", "#AA4499", "8", (0, (3, 1))),
        group="learned",
        build=network_scorer("binned_network:BinnedNetworkScorer", "conv.network:ConvNetwork", "conv"),
        weights="conv",
        probability=True,
        one_camera=True,
        learn=imported("conv.learn:learn_conv"),
        config=ConvConfig,
        folder="conv",
    ),
)
