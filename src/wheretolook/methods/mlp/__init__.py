"""The paper's network: an MLP over binned landmarks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from wheretolook.inputs.channels import ALL_CHANNELS, PAPER_VARIANTS
from wheretolook.methods.method import Method, MethodStyle, ScorerOptions
from wheretolook.methods.mlp.config import RELEASED_SETTINGS, MlpConfig

if TYPE_CHECKING:
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.learning.learner import Learnt, Task
    from wheretolook.methods.base import Scorer


def _build(localization_map: LocalizationMap, options: ScorerOptions) -> Scorer:
    from wheretolook.learning.trained_network import TrainedNetwork
    from wheretolook.methods.binned_network import BinnedNetworkScorer
    from wheretolook.methods.mlp.network import ViewpointNetwork

    assert options.weights is not None
    names = tuple(method.name for method in METHODS)
    return BinnedNetworkScorer(localization_map, TrainedNetwork.load(options.weights, ViewpointNetwork, *names))


def _network(inputs: str, style: MethodStyle, channels: tuple[str, ...], **fields: Any) -> Method:
    def learn(task: Task) -> Learnt:
        from wheretolook.methods.mlp.learn import learn_mlp

        return learn_mlp(task, channels)

    return Method(
        name=f"mlp-{inputs}",
        about=f"The paper's classifier, {style.label.partition(', ')[2]}: the predicted probability that a view "
        "localizes.",
        style=style,
        group="learned",
        build=_build,
        weights=f"mlp-{inputs}",
        family="mlp",
        probability=True,
        of_the_few=True,
        learn=learn,
        config=MlpConfig,
        folder="mlp",
        **fields,
    )


_STYLES = {
    "2d": MethodStyle("MLP, 2d", "#56B4E9", "v", (0, (5, 1))),
    "2d+z": MethodStyle("MLP, 2d + z", "#0072B2", "^", (0, (3, 1, 1, 1))),
    "2d+3d": MethodStyle("MLP, 2d + 3d", "#D55E00", "o", "-"),
}

METHODS = (
    *(
        _network(
            inputs, style, PAPER_VARIANTS[inputs], trained_unasked=True, ships="network", reference=inputs == "2d+3d"
        )
        for inputs, style in _STYLES.items()
    ),
    _network("2d+3d+landmark", MethodStyle("MLP, 2d + 3d + landmark", "#8C3A00", "H", (0, (6, 1, 1, 1))), ALL_CHANNELS),
    _network(
        "released",
        MethodStyle("MLP, trained as the released code", "#F0A070", "p", (0, (2, 2))),
        PAPER_VARIANTS["2d+3d"],
        settings=RELEASED_SETTINGS,
        ships="never",
    ),
)
