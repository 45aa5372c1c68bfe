"""The paper's network: an MLP over binned landmarks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from wheretolook.inputs.channels import ALL_CHANNELS, PAPER_VARIANTS
from wheretolook.scorers.mlp.config import RELEASED_SETTINGS, MlpConfig
from wheretolook.scorers.registry import Learner, Method, imported, network_scorer

if TYPE_CHECKING:
    from wheretolook.training.learner import TrainingJob, TrainingResult


def _network(name: str, variant: str, channels: tuple[str, ...], settings: Mapping[str, Any] = {}) -> Method:
    def learn(task: TrainingJob) -> TrainingResult:
        result: TrainingResult = imported("wheretolook.scorers.mlp.learn:learn_mlp")(task, channels)
        return result

    return Method(
        name=name,
        about=f"The paper's classifier, {variant}: the predicted probability that a view localizes.",
        build=network_scorer(
            "wheretolook.scorers.mlp.network:BinnedNetworkScorer",
            "wheretolook.scorers.mlp.network:ViewpointNetwork",
            name,
        ),
        weights=name,
        family="mlp",
        probability=True,
        one_camera=True,
        learner=Learner(learn, MlpConfig, settings),
    )


METHODS = (
    _network("mlp-2d", "2d", PAPER_VARIANTS["2d"]),
    _network("mlp-2d+z", "2d + z", PAPER_VARIANTS["2d+z"]),
    _network("mlp-2d+3d", "2d + 3d", PAPER_VARIANTS["2d+3d"]),
    _network("mlp-2d+3d+landmark", "2d + 3d + landmark", ALL_CHANNELS),
    _network("mlp-released", "trained as the released code", PAPER_VARIANTS["2d+3d"], RELEASED_SETTINGS),
)
