"""How well one occlusion model's masks agree with another's, taken as the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class MaskAgreement:
    """Agreement of lines of sight found free with those that are free.

    Attributes:
        precision: share of the lines found free that are free; NaN if none was found free.
        recall: share of the free lines that were found free; NaN if none is free.
    """

    precision: float
    recall: float

    @classmethod
    def between(cls, mask: ArrayLike, truth: ArrayLike) -> MaskAgreement:
        """Compare masks (L, N), True where free."""
        found, free = np.asarray(mask, dtype=bool), np.asarray(truth, dtype=bool)
        if found.shape != free.shape:
            raise ValueError(f"masks of shapes {found.shape} and {free.shape}")
        both, n_found, n_free = (int(part.sum()) for part in (found & free, found, free))
        return cls(both / n_found if n_found else float("nan"), both / n_free if n_free else float("nan"))

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        total = self.precision + self.recall
        return 2 * self.precision * self.recall / total if total else 0.0
