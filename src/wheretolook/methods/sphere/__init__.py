"""A network that scores all directions at a location at once, in the manner of ActLoc."""

from __future__ import annotations

from typing import TYPE_CHECKING

from wheretolook.methods.method import Method, MethodStyle, ScorerOptions
from wheretolook.methods.sphere.config import SphereConfig

if TYPE_CHECKING:
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.learning.learner import Learnt, Task
    from wheretolook.methods.base import Scorer


def _build(localization_map: LocalizationMap, options: ScorerOptions) -> Scorer:
    from wheretolook.learning.trained_network import TrainedNetwork
    from wheretolook.methods.sphere.network import SphereNetwork
    from wheretolook.methods.sphere.score import SphereScorer

    assert options.weights is not None
    return SphereScorer(localization_map, TrainedNetwork.load(options.weights, SphereNetwork, "sphere"))


def _learn(task: Task) -> Learnt:
    from wheretolook.methods.sphere.learn import learn_sphere

    return learn_sphere(task)


METHODS = (
    Method(
        name="sphere",
        about="In the manner of ActLoc: one pass over a location's landmarks and the mapping cameras scores 6 x 18 "
        "directions.",
        style=MethodStyle("whole sphere (manner of ActLoc)", "#6699CC", "H", (0, (3, 1))),
        group="learned",
        build=_build,
        weights="sphere",
        probability=True,
        learn=_learn,
        config=SphereConfig,
        folder="sphere",
    ),
)
