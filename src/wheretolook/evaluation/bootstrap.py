"""Intervals of shares by resampling locations, and paired tests by flipping signs."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry import Float

PERCENTILES = (2.5, 97.5)
"""Ends of a 95 % interval."""

_SIGNS = 1  # sets the random numbers of the sign flips apart from those of the resamples


class LocationBootstrap:
    """Resamples of the locations, with replacement within each scene, drawn once for all methods.

    Views of a location stay together, since they share landmarks. Scenes stay as they are: an interval says how sure a
    value is for these scenes, not for scenes to come. As every method sees the same resamples, differences between
    methods are paired.

    Args:
        location_scene: (L,) scene of each location.
        resamples: number R of resamples, and of sign flips.
        seed: the same seed and locations give the same resamples.
    """

    def __init__(self, location_scene: NDArray[np.integer[Any]], resamples: int, seed: int) -> None:
        self._times = np.zeros((resamples, len(location_scene)), dtype=np.float32)  # how often a location was drawn
        for scene in np.unique(location_scene):
            columns = np.flatnonzero(location_scene == scene)
            draws = np.random.default_rng([seed, int(scene)]).integers(0, len(columns), (resamples, len(columns)))
            flat = draws + np.arange(resamples)[:, None] * len(columns)
            times = np.bincount(flat.reshape(-1), minlength=resamples * len(columns))
            self._times[:, columns] = times.reshape(resamples, -1)
        self._sizes = np.bincount(location_scene)
        self._seed = seed

    def ratio(self, numerator: Float, denominator: Float) -> tuple[Float, Float]:
        """95 % percentile interval of the ratio of two sums over locations.

        Args:
            numerator: (L, C).
            denominator: (L, C) or (L, 1).

        Returns:
            Lower and upper ends, (C,) each; NaN where no scene has two locations, or a denominator is always zero.
        """
        ends = np.full((2, numerator.shape[1]), np.nan)
        if self._sizes.max(initial=0) < 2:
            return ends[0], ends[1]
        top, bottom = self._times @ numerator, self._times @ denominator
        ratio = np.divide(top, bottom, out=np.full(top.shape, np.nan), where=bottom > 0)
        known = np.isfinite(ratio)
        whole = known.all(0)
        ends[:, whole] = np.percentile(ratio[:, whole], PERCENTILES, axis=0)
        for column in np.flatnonzero(known.any(0) & ~whole):
            ends[:, column] = np.percentile(ratio[known[:, column], column], PERCENTILES)
        return ends[0], ends[1]

    def paired_p(self, differences: Float) -> Float:
        """Two-sided p-values of the paired permutation test that two methods are worth the same at every location.

        If they are, a location's difference is as likely with either sign. The p-value is the share of random signs,
        those observed among them, that bring the sum over locations as far from zero as it is, or farther; it is at
        least 1 / (R + 1).

        Args:
            differences: (L, C), one method's less the other's.

        Returns:
            (C,) in (0, 1]; NaN without locations.
        """
        resamples, n_locations = self._times.shape
        if n_locations == 0:
            return np.full(differences.shape[1], np.nan)
        generator = np.random.default_rng([self._seed, 0, _SIGNS])
        signs = 1 - 2.0 * generator.integers(0, 2, self._times.shape, dtype=np.int8)
        # sums that are equal but for rounding count as equal
        observed = np.abs(differences.sum(0)) - 1e-9 * np.abs(differences).sum(0)
        as_far = (np.abs(signs @ differences) >= observed).sum(0)
        return np.asarray((1 + as_far) / (resamples + 1))
