"""The most visible landmarks win."""

from __future__ import annotations

from typing import ClassVar

from wheretolook.features import BinnedViews
from wheretolook.geometry import Float
from wheretolook.scoring.base import BinnedScorer


class VisibleScorer(BinnedScorer):
    """Share of the map's landmarks that a view sees (paper, Sec. 3.2)."""

    name: ClassVar[str] = "visible"

    def score_bins(self, binned: BinnedViews) -> Float:
        """(B,) in [0, 1]."""
        return binned.n_visible / max(1, len(self.localization_map.landmarks.points))
