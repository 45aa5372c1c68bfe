"""Tells whoever asks for scores, once, that views are unlike those a scorer has learnt from."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from wheretolook.geometry.poses import Float
from wheretolook.training.training_range import TrainingRange
from wheretolook.utils.errors import OutOfRangeWarning

TOLERATED = 0.05
"""Share of the views scored at once that may be out of range without a warning: in any scene some views are odd."""


class RangeWatch:
    """Looks at what is scored until it has warned; `watching` is whether there is anything to look at."""

    def __init__(self, training_range: TrainingRange, watching: bool = True) -> None:
        self.training_range = training_range
        self.watching = watching and bool(training_range.bounds)

    def check(self, name: str, quantities: Sequence[Float]) -> None:
        """Warn once, with an `OutOfRangeWarning`, of a scorer of this name.

        `quantities` are parts of the `QUANTITIES` (B, 6) of views scored at once. The warning points to whoever called
        the function that calls this one.
        """
        if not self.watching or not quantities:
            return
        if complaint := self.training_range.complaint(np.concatenate(quantities), TOLERATED):
            self.watching = False
            text = f"{name}: {complaint}. Their scores are less sure; Scorer.in_range tells which views."
            warnings.warn(text, OutOfRangeWarning, stacklevel=3)
