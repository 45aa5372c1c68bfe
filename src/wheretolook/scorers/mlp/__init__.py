"""The paper's network: an MLP over binned landmarks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from wheretolook.inputs.channels import ALL_CHANNELS, PAPER_VARIANTS
from wheretolook.scorers.mlp.config import RELEASED_SETTINGS, MlpConfig
from wheretolook.scorers.registry import Method, MethodStyle, imported, network_scorer

if TYPE_CHECKING:
    from wheretolook.training.learner import TrainingJob, TrainingResult


def _network(inputs: str, style: MethodStyle, channels: tuple[str, ...], **fields: Any) -> Method:
    def learn(task: TrainingJob) -> TrainingResult:
        result: TrainingResult = imported("wheretolook.scorers.mlp.learn:learn_mlp")(task, channels)
        return result

    name = f"mlp-{inputs}"
    variant = style.label.partition(", ")[2]
    return Method(
        name=name,
        about=f"The paper's classifier, {variant}: the predicted probability that a view localizes.",
        style=style,
        group="learned",
        build=network_scorer(
            "wheretolook.scorers.mlp.network:BinnedNetworkScorer",
            "wheretolook.scorers.mlp.network:ViewpointNetwork",
            name,
        ),
        weights=name,
        family="mlp",
        probability=True,
        one_camera=True,
        position=60,
        of_the_few=True,
        learn=learn,
        config=MlpConfig,
        folder="mlp",
        **fields,
    )


def _of_paper(inputs: str, style: MethodStyle, reference: int = 0) -> Method:
    channels = PAPER_VARIANTS[inputs]
    return _network(inputs, style, channels, trained_unasked=True, ships="network", reference=reference)


_RELEASED = MethodStyle("MLP, trained as the released code", "#F0A070", "p", (0, (2, 2)))

METHODS = (
    _of_paper("2d", MethodStyle("MLP, 2d", "#56B4E9", "v", (0, (5, 1)))),
    _of_paper("2d+z", MethodStyle("MLP, 2d + z", "#0072B2", "^", (0, (3, 1, 1, 1)))),
    _of_paper("2d+3d", MethodStyle("MLP, 2d + 3d", "#D55E00", "o", "-"), reference=1),
    _network("2d+3d+landmark", MethodStyle("MLP, 2d + 3d + landmark", "#8C3A00", "H", (0, (6, 1, 1, 1))), ALL_CHANNELS),
    _network("released", _RELEASED, PAPER_VARIANTS["2d+3d"], settings=RELEASED_SETTINGS, ships="never"),
)
