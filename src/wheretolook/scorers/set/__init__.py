"""Networks over landmarks: `set`, over the set of visible landmarks, and `matchability`, over single landmarks."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from wheretolook.inputs.channels import ATTRIBUTES, OF_SIZE
from wheretolook.scorers.registry import Learner, Method, imported, network_scorer
from wheretolook.training.config import FittingConfig
from wheretolook.utils.errors import ConfigError, check_range, check_share, no_option


@dataclass(frozen=True)
class MatchabilityConfig(FittingConfig):
    """Options of a network over single landmarks: the probability that a visible landmark is detected.

    Args:
        landmarks: maximum number of landmarks of a view in a training step, chosen at random.
        width: units of the layers for single landmarks.
        hidden: attributes (`inputs.channels.ATTRIBUTES`) that are no inputs; by default those that depend on the size
            of a scene, on which matching does not depend.
        enlarged: maximum factor by which scenes are scaled up or down in training; 1 does not scale them.
    """

    epochs: int = no_option(6)
    batch_size: int = no_option(256)
    landmarks: int = no_option(64)
    width: int = no_option(48)
    hidden: tuple[str, ...] = no_option(OF_SIZE)
    enlarged: float = no_option(3.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("landmarks", self.landmarks, 1)
        check_range("width", self.width, 1)
        if not 1 <= self.enlarged < inf:
            raise ConfigError("scenes can be enlarged by a factor of 1 or more", value=self.enlarged)
        if unknown := [name for name in self.hidden if name not in ATTRIBUTES]:
            known = f"There are {', '.join(ATTRIBUTES)}."
            raise ConfigError("hidden names an attribute that there is not", value=unknown[0], fix=known)


@dataclass(frozen=True)
class SetConfig(MatchabilityConfig):
    """Options of the network over the set of visible landmarks.

    With few training views, batches get smaller and epochs more (`wheretolook.scorers.set.learn.of_size`).

    Args:
        landmark_loss: weight of the loss of landmark detection, where matches are stored.
        head: units of the head's layers.
        dropout: share of the head's units dropped.
        from_matchability: start from `weights/matchability.safetensors` where the dataset has it.
    """

    epochs: int = 8
    batch_size: int = 1024
    learning_rate: float = 3e-3
    landmarks: int = no_option(192)
    landmark_loss: float = no_option(0.5)
    head: int = no_option(48)
    dropout: float = no_option(0.1)
    from_matchability: bool = no_option(True)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("head", self.head, 1)
        check_range("landmark_loss", self.landmark_loss, 0)
        check_share("dropout", self.dropout)

    @property
    def starts_from(self) -> str:
        """Name of the matchability model, or none."""
        return "matchability" if self.from_matchability else ""


METHODS = (
    Method(
        name="matchability",
        about="The probability that a visible landmark is detected.",
        learner=Learner(imported("wheretolook.scorers.set.learn:learn_matchability"), MatchabilityConfig),
    ),
    Method(
        name="set",
        about="Network over the set of visible landmarks: their probabilities of detection and their information on "
        "the pose.",
        build=network_scorer(
            "wheretolook.scorers.set.score:SetScorer", "wheretolook.scorers.set.network:SetNetwork", "set"
        ),
        weights="set",
        probability=True,
        learner=Learner(imported("wheretolook.scorers.set.learn:learn_set"), SetConfig),
    ),
)
