"""How well the masks of one occlusion model agree with those of another, which are taken as the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class MaskAgreement:
    """Precision and recall of the lines of sight that were found free."""

    precision: float  # share of the lines found free that are free; NaN if none was found free
    recall: float  # share of the free lines that were found free; NaN if none is free

    @classmethod
    def between(cls, mask, truth):
        """Compare masks (L, N), True where free."""
        found = np.asarray(mask, dtype=bool)
        free = np.asarray(truth, dtype=bool)
        if found.shape != free.shape:
            raise ValueError(f"masks of shapes {found.shape} and {free.shape}")
        both, n_found, n_free = (int(part.sum()) for part in (found & free, found, free))
        return cls(both / n_found if n_found else float("nan"), both / n_free if n_free else float("nan"))

    @property
    def f1(self):
        """Harmonic mean of precision and recall."""
        total = self.precision + self.recall
        return 2 * self.precision * self.recall / total if total else 0.0
