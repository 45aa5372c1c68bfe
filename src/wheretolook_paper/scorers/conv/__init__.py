"""A convolutional network over the bins."""

from __future__ import annotations

from dataclasses import dataclass

from wheretolook.scorers.registry import Learner, Method, imported, network_scorer
from wheretolook.training.config import FittingConfig
from wheretolook.utils.errors import ConfigError, check_range, check_share, no_option


@dataclass(frozen=True)
class ConvConfig(FittingConfig):
    """Options of the convolutional network over the bins.

    Args:
        widths: channels after each convolution; all but the first have stride 2.
        dropout: share of pooled values dropped in training.
        bins: bins along each side of the image.
    """

    widths: tuple[int, ...] = no_option((32, 64, 128, 128))
    dropout: float = no_option(0.2)
    bins: int = no_option(30)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.widths or min(self.widths) < 1:
            raise ConfigError("there must be a convolution, and each at least one channel wide", value=self.widths)
        check_range("bins", self.bins, 1)
        check_share("dropout", self.dropout)


METHODS = (
    Method(
        name="conv",
        about="Probability that a view localizes, by a convolutional network on binned landmarks and their attributes.",
        build=network_scorer(
            "wheretolook.scorers.mlp.network:BinnedNetworkScorer",
            "wheretolook_paper.scorers.conv.network:ConvNetwork",
            "conv",
        ),
        weights="conv",
        probability=True,
        one_camera=True,
        learner=Learner(imported("wheretolook_paper.scorers.conv.network:learn_conv"), ConvConfig),
    ),
)
