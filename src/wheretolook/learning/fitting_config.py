"""Options that all learned networks but the paper's share."""

from __future__ import annotations

from dataclasses import dataclass

from wheretolook.utils.errors import ConfigError


@dataclass(frozen=True)
class FittingConfig:
    """Options of every network but the paper's: Adam, its rate falling to zero by a cosine, all views as they are.

    The weights kept are those of the epoch with the best validation average precision; the probabilities are then
    calibrated on the validation views (Platt scaling).

    Args:
        epochs: passes over the training viewpoints.
        batch_size: viewpoints a step.
        learning_rate: Adam's initial rate.
        l2: factor of the sum of squared weights.
    """

    epochs: int = 20
    batch_size: int = 512
    learning_rate: float = 2e-3
    l2: float = 1e-5

    def __post_init__(self) -> None:
        if self.epochs < 1 or self.batch_size < 1:
            raise ConfigError("epochs and batch_size must be at least 1", value=(self.epochs, self.batch_size))
        if not self.learning_rate > 0 or not self.l2 >= 0:
            raise ConfigError("learning_rate must be positive and l2 not negative", value=(self.learning_rate, self.l2))
