"""A network over the set of landmarks in view."""

from __future__ import annotations

from typing import TYPE_CHECKING

from wheretolook.methods.method import Method, MethodStyle, ScorerOptions
from wheretolook.methods.set.config import SetConfig

if TYPE_CHECKING:
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.learning.learner import Learnt, Task
    from wheretolook.methods.base import Scorer


def _build(localization_map: LocalizationMap, options: ScorerOptions) -> Scorer:
    from wheretolook.learning.trained_network import TrainedNetwork
    from wheretolook.methods.set.network import SetNetwork
    from wheretolook.methods.set.score import SetScorer

    assert options.weights is not None
    trained = TrainedNetwork.load(options.weights, SetNetwork, "set", device=localization_map.device)
    return SetScorer(localization_map, trained)


def _learn(task: Task) -> Learnt:
    from wheretolook.methods.set.learn import learn_set

    return learn_set(task)


METHODS = (
    Method(
        name="set",
        about="Network over the set of landmarks in view: each by its chance of being found, all by what they tell of "
        "the pose.",
        style=MethodStyle("set of landmarks", "#CC3311", "o", "-"),
        group="learned",
        build=_build,
        weights="set",
        probability=True,
        reference=2,
        of_the_few=True,
        learn=_learn,
        config=SetConfig,
        folder="set",
        trained_unasked=True,
    ),
)
