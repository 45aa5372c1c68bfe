"""A convolutional network over the bins."""

from __future__ import annotations

from typing import TYPE_CHECKING

from wheretolook.methods.conv.config import ConvConfig
from wheretolook.methods.method import Method, MethodStyle, ScorerOptions

if TYPE_CHECKING:
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.learning.learner import Learnt, Task
    from wheretolook.methods.base import Scorer


def _build(localization_map: LocalizationMap, options: ScorerOptions) -> Scorer:
    from wheretolook.learning.trained_network import TrainedNetwork
    from wheretolook.methods.binned_network import BinnedNetworkScorer
    from wheretolook.methods.conv.network import ConvNetwork

    assert options.weights is not None
    return BinnedNetworkScorer(localization_map, TrainedNetwork.load(options.weights, ConvNetwork, "conv"))


def _learn(task: Task) -> Learnt:
    from wheretolook.methods.conv.learn import learn_conv

    return learn_conv(task)


METHODS = (
    Method(
        name="conv",
        about="A convolutional network on the binned landmarks and how they were mapped: the probability that a view "
        "localizes.",
        style=MethodStyle("convolutional, landmark attributes", "#AA4499", "8", (0, (3, 1))),
        group="learned",
        build=_build,
        weights="conv",
        probability=True,
        learn=_learn,
        config=ConvConfig,
        folder="conv",
    ),
)
