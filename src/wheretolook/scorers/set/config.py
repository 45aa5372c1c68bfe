"""Options of the network over the set of visible landmarks."""

from __future__ import annotations

from dataclasses import dataclass

from wheretolook.scorers.matchability.config import LandmarksConfig
from wheretolook.training.config import check_range
from wheretolook.utils.errors import no_option


@dataclass(frozen=True)
class SetConfig(LandmarksConfig):
    """Options of the network over the set of visible landmarks.

    With few training views, batches get smaller and epochs more (`wheretolook.scorers.set.learn.of_size`).

    Args:
        landmark_loss: weight of the loss of landmark detection, where matches are stored.
        pooled: features that attention pools in addition to the expected information on the pose.
        head: units of the head's layers.
        dropout: share of the head's units dropped.
        from_matchability: start from `weights/matchability.safetensors` where the dataset has it.
    """

    epochs: int = 8
    batch_size: int = 1024
    learning_rate: float = 3e-3
    landmarks: int = no_option(192)
    landmark_loss: float = no_option(0.5)
    pooled: int = no_option(0)
    head: int = no_option(48)
    dropout: float = no_option(0.1)
    from_matchability: bool = no_option(True)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "head", at_least=1)
        check_range(self, "landmark_loss", "pooled", at_least=0)
        check_range(self, "dropout", at_least=0, below=1)

    @property
    def starts_from(self) -> str:
        """Name of the matchability model, or none."""
        return "matchability" if self.from_matchability else ""
