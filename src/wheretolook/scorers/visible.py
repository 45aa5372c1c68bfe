"""Prefers views with the most visible landmarks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float
from wheretolook.scorers.base import CountingScorer
from wheretolook.scorers.registry import rule


class VisibleScorer(CountingScorer):
    """Share of the map's landmarks that are visible (paper, Sec. 3.2)."""

    name = "visible"

    def score_counts(self, n_visible: NDArray[np.int32], n_filled: NDArray[np.int32]) -> Float:
        """(B,) in [0, 1]."""
        return n_visible / max(1, len(self.localization_map.landmarks.points))


METHODS = (rule(VisibleScorer),)
