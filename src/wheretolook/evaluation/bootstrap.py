"""Intervals of shares by resampling locations."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry import Float

PERCENTILES = (2.5, 97.5)
"""Ends of a 95 % interval."""


class LocationBootstrap:
    """Resamples of the locations, with replacement within each scene, drawn once for all methods.

    Views of a location stay together, since they share landmarks. Scenes stay as they are: an interval says how sure a
    value is for these scenes, not for scenes to come. As every method sees the same resamples, differences between
    methods are paired.

    Args:
        location_scene: (L,) scene of each location.
        resamples: number R of resamples.
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

    def ratio(self, numerator: Float, denominator: Float) -> tuple[Float, Float]:
        """95 % percentile interval of the ratio of two sums over locations.

        Args:
            numerator: (L, T).
            denominator: (L, T) or (L, 1).

        Returns:
            Lower and upper ends, (T,) each; NaN where no scene has two locations, or a denominator is always zero.
        """
        if self._sizes.max(initial=0) < 2:
            nothing = np.full(numerator.shape[1], np.nan)
            return nothing, nothing
        top, bottom = self._times @ numerator, self._times @ np.broadcast_to(denominator, numerator.shape)
        ratio = np.divide(top, bottom, out=np.full(top.shape, np.nan), where=bottom > 0)
        ends = np.full((2, ratio.shape[1]), np.nan)
        for column, values in enumerate(ratio.T):
            known = values[np.isfinite(values)]
            if len(known):
                ends[:, column] = np.percentile(known, PERCENTILES)
        return ends[0], ends[1]
