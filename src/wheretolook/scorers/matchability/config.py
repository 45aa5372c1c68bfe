"""Options of the networks over single landmarks."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from wheretolook.inputs.channels import ATTRIBUTES, OF_SIZE
from wheretolook.training.config import FittingConfig, check_range
from wheretolook.utils.errors import ConfigError, no_option


@dataclass(frozen=True)
class LandmarksConfig(FittingConfig):
    """Options of a network over single landmarks.

    Args:
        landmarks: maximum number of landmarks of a view in a training step, chosen at random.
        width: units of the layers for single landmarks.
        hidden: attributes (`inputs.channels.ATTRIBUTES`) that are no inputs; by default those that depend on the size
            of a scene, on which matching does not depend.
        enlarged: maximum factor by which scenes are scaled up or down in training; 1 does not scale them.
    """

    landmarks: int = no_option(64)
    width: int = no_option(48)
    hidden: tuple[str, ...] = no_option(OF_SIZE)
    enlarged: float = no_option(3.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "landmarks", "width", at_least=1)
        if not 1 <= self.enlarged < inf:
            raise ConfigError("scenes can be enlarged by a factor of 1 or more", value=self.enlarged)
        if unknown := [name for name in self.hidden if name not in ATTRIBUTES]:
            known = f"There are {', '.join(ATTRIBUTES)}."
            raise ConfigError("hidden names an attribute that there is not", value=unknown[0], fix=known)


@dataclass(frozen=True)
class MatchabilityConfig(LandmarksConfig):
    """Options of the probability that a visible landmark is detected."""

    epochs: int = no_option(6)
    batch_size: int = no_option(256)
