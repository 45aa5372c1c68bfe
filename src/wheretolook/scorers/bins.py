"""Reprojections with bins: prefers landmarks spread over the image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float
from wheretolook.scorers.base import CountingScorer
from wheretolook.scorers.registry import rule


class BinsScorer(CountingScorer):
    """Share of the image's bins that hold a landmark (paper, Sec. 4.1, "reprojection with bins").

    Views with equally many filled bins are ordered by their number of landmarks.
    """

    name = "bins"

    def score_counts(self, n_visible: NDArray[np.int32], n_filled: NDArray[np.int32]) -> Float:
        """(B,) in [0, 1)."""
        seen = n_visible.astype(np.float64)
        return (n_filled + seen / (1 + seen)) / (self.bins**2 + 1)


METHODS = (rule(BinsScorer),)
