"""A network that scores all directions at a location at once, in the manner of ActLoc."""

from __future__ import annotations

from dataclasses import dataclass

from wheretolook.scorers.registry import Learner, Method, imported, network_scorer
from wheretolook.training.config import FittingConfig
from wheretolook.utils.errors import ConfigError, check_range, check_share, no_option


@dataclass(frozen=True)
class SphereConfig(FittingConfig):
    """Options of "sphere"; a batch holds whole locations with about `batch_size` viewpoints in all.

    Args:
        points: landmarks of a location at most, spread evenly over those in free sight.
        cameras: mapping cameras at most, spread evenly over all.
        width: of tokens and queries; a multiple of `heads`.
        heads: of attention.
        layers: blocks of attention among the tokens.
        dropout: share of values dropped in the blocks of attention.
    """

    epochs: int = no_option(30)
    batch_size: int = no_option(1024)
    learning_rate: float = no_option(5e-4)
    points: int = no_option(512)
    cameras: int = no_option(128)
    width: int = no_option(96)
    heads: int = no_option(4)
    layers: int = no_option(2)
    dropout: float = no_option(0.1)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("points", "cameras", "width", "heads", "layers"):
            check_range(name, getattr(self, name), 1)
        check_share("dropout", self.dropout)
        if self.width % self.heads:
            raise ConfigError("sphere needs a width that is a multiple of heads", value=(self.width, self.heads))


METHODS = (
    Method(
        name="sphere",
        about="Like ActLoc: one pass over a location's landmarks and the mapping cameras scores 6 x 18 directions.",
        build=network_scorer(
            "wheretolook_paper.scorers.sphere.score:SphereScorer",
            "wheretolook_paper.scorers.sphere.network:SphereNetwork",
            "sphere",
        ),
        weights="sphere",
        probability=True,
        one_camera=True,
        learner=Learner(imported("wheretolook_paper.scorers.sphere.network:learn_sphere"), SphereConfig),
    ),
)
