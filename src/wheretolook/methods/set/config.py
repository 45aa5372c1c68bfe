"""Options of the network over the set of landmarks in view."""

from __future__ import annotations

from dataclasses import dataclass

from wheretolook.learning.fitting_config import FittingConfig
from wheretolook.methods.matchability.config import _check_enlarged, _check_hidden
from wheretolook.utils.errors import ConfigError


@dataclass(frozen=True)
class SetConfig(FittingConfig):
    """Options of the network over the set of landmarks in view.

    With few training views, batches get smaller and epochs more (`wheretolook.methods.set.learn.of_size`).

    Args:
        landmarks: landmarks of a view that a training step looks at, at most, chosen at random.
        width: units of the layers that look at single landmarks.
        pooled: numbers that attention pools beside what the landmarks are expected to tell of the pose.
        head: units of the layers that decide.
        dropout: share of the deciding layers' units dropped.
        from_matchability: start from `weights/matchability.safetensors` where the dataset has it.
        hidden: attributes (`inputs.landmarks_in_view.ATTRIBUTES`) not to look at, to see what each is worth.
        enlarged: greatest factor by which scenes come larger or smaller in training; 1 leaves them as they are.
    """

    epochs: int = 8
    batch_size: int = 1024
    learning_rate: float = 3e-3
    landmarks: int = 192
    width: int = 48
    pooled: int = 8
    head: int = 48
    dropout: float = 0.1
    from_matchability: bool = True
    hidden: tuple[str, ...] = ()
    enlarged: float = 3.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_enlarged(self.enlarged)
        if min(self.landmarks, self.width, self.head) < 1 or self.pooled < 0 or not 0 <= self.dropout < 1:
            raise ConfigError(
                "a set network needs landmarks, width and head >= 1, pooled >= 0 and a dropout below 1",
                value=(self.landmarks, self.width, self.head, self.pooled, self.dropout),
            )
        if self.hidden:
            _check_hidden(self.hidden)
