"""Reprojections with bins: landmarks spread over much of the image win."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from wheretolook.features import BinnedViews
from wheretolook.geometry import Float
from wheretolook.scoring.base import BinnedScorer


class BinsScorer(BinnedScorer):
    """Share of the image's bins with a visible landmark in them (paper, Sec. 4.1, "reprojection with bins").

    Among views with as many filled bins, the one that sees more landmarks scores higher, by less than one bin is worth.
    """

    name: ClassVar[str] = "bins"
    local = True

    def score_bins(self, binned: BinnedViews) -> Float:
        """(B,) in [0, 1)."""
        visible = binned.n_visible.astype(np.float64)
        return (binned.n_filled + visible / (1 + visible)) / (self.bins**2 + 1)
