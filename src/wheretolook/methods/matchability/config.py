"""Options of the probability that a landmark in view is found."""

from __future__ import annotations

import math
from dataclasses import dataclass

from wheretolook.learning.fitting_config import FittingConfig
from wheretolook.utils.errors import ConfigError


def _check_hidden(names: tuple[str, ...]) -> None:
    from wheretolook.inputs.landmarks_in_view import ATTRIBUTES  # PyTorch takes seconds to load

    if unknown := [name for name in names if name not in ATTRIBUTES]:
        known = f"There are {', '.join(ATTRIBUTES)}."
        raise ConfigError("hidden names an attribute that there is not", value=unknown[0], fix=known)


def _check_enlarged(factor: float) -> None:
    if not 1 <= factor < math.inf:
        raise ConfigError("scenes can be enlarged by a factor of 1 or more", value=factor)


@dataclass(frozen=True)
class MatchabilityConfig(FittingConfig):
    """Options of the probability that a landmark in view is found.

    Args:
        landmarks: landmarks of a view to learn from, at most, chosen at random.
        width: units of each of two hidden layers.
        hidden: attributes (`inputs.landmarks_in_view.ATTRIBUTES`) not to look at, to see what each is worth.
        enlarged: greatest factor by which scenes come larger or smaller in training; 1 leaves them as they are.
    """

    epochs: int = 6
    batch_size: int = 256
    landmarks: int = 64
    width: int = 48
    hidden: tuple[str, ...] = ()
    enlarged: float = 3.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_enlarged(self.enlarged)
        if self.landmarks < 1 or self.width < 1:
            raise ConfigError("landmarks and width must be at least 1", value=(self.landmarks, self.width))
        if self.hidden:
            _check_hidden(self.hidden)
