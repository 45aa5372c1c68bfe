"""Warn once when scored views are outside the training range."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from wheretolook.geometry.poses import Float
from wheretolook.training.training_range import TrainingRange
from wheretolook.utils.errors import OutOfRangeWarning

TOLERATED = 0.05
"""Share of the views scored at once that may be out of range without a warning."""


class RangeWatch:
    """Checks scored views until it has warned; `watching` is whether there is anything left to check."""

    def __init__(self, training_range: TrainingRange, watching: bool = True) -> None:
        self.training_range = training_range
        self.watching = watching and bool(training_range.bounds)

    def check(self, name: str, quantities: Sequence[Float]) -> None:
        """Warn once, with an `OutOfRangeWarning`, if too many views of `quantities`, parts (B, 6), are out of range.

        The warning points to the caller of the calling function.
        """
        if not self.watching or not quantities:
            return
        if complaint := self.training_range.complaint(np.concatenate(quantities), TOLERATED):
            self.watching = False
            text = f"{name}: {complaint}. Their scores are less reliable; Scorer.in_range returns which."
            warnings.warn(text, OutOfRangeWarning, stacklevel=3)
