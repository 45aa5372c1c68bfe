"""Intervals of shares by resampling neighbourhoods of locations, and paired tests by flipping their signs."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float

PERCENTILES = (2.5, 97.5)  # ends of a 95 % interval
_SIGNS = 1  # sets the random numbers of the sign flips apart from those of the resamples


class LocationBootstrap:
    """Resamples of blocks of locations, with replacement within each scene, drawn once for all methods.

    Views of a location share landmarks, and so do neighbouring locations: taken for independent, they would make
    intervals too narrow (on the release's test scenes by half, for voxels above one another). A block stays together.
    Scenes stay as they are: an interval says how sure a value is for these scenes, not for scenes to come. As every
    method sees the same resamples, differences between methods are paired.

    Of L locations `location_scene` and `location_block` (L,) tell scene and block, None for each by itself; blocks of
    different scenes are different whatever their numbers. The seed and the locations decide on the resamples, R in
    number, and as many sign flips.
    """

    def __init__(
        self,
        location_scene: NDArray[np.integer[Any]],
        resamples: int,
        seed: int,
        location_block: NDArray[np.integer[Any]] | None = None,
    ) -> None:
        if location_block is None:
            location_block = np.arange(len(location_scene))
        pairs = np.stack([location_scene, location_block], axis=1)
        blocks, self._block = np.unique(pairs, axis=0, return_inverse=True)
        self._block = self._block.reshape(-1)
        times = np.zeros((resamples, len(blocks)), dtype=np.float32)  # how often a block was drawn
        for scene in np.unique(location_scene):
            columns = np.flatnonzero(blocks[:, 0] == scene)
            draws = np.random.default_rng([seed, int(scene)]).integers(0, len(columns), (resamples, len(columns)))
            flat = draws + np.arange(resamples)[:, None] * len(columns)
            drawn = np.bincount(flat.reshape(-1), minlength=resamples * len(columns))
            times[:, columns] = drawn.reshape(resamples, -1)
        self._times = times
        self._sizes = np.bincount(blocks[:, 0])
        self._seed = seed

    def _by_block(self, values: Float) -> Float:
        """Sums (K, C) over the locations of each block of values (L, C)."""
        sums = np.zeros((self._times.shape[1], values.shape[1]))
        np.add.at(sums, self._block, values)
        return sums

    def ratio(self, numerator: Float, denominator: Float) -> tuple[Float, Float]:
        """95 % percentile interval of the ratio of two sums over locations, of (L, C) and (L, C) or (L, 1).

        Returns lower and upper ends, (C,) each; NaN where no scene has two blocks, or a denominator is always zero.
        """
        ends = np.full((2, numerator.shape[1]), np.nan)
        if self._sizes.max(initial=0) < 2:
            return ends[0], ends[1]
        top = self._times @ self._by_block(numerator)
        bottom = self._times @ self._by_block(denominator)
        ratio = np.divide(top, bottom, out=np.full(top.shape, np.nan), where=bottom > 0)
        known = np.isfinite(ratio)
        whole = known.all(0)
        ends[:, whole] = np.percentile(ratio[:, whole], PERCENTILES, axis=0)
        for column in np.flatnonzero(known.any(0) & ~whole):
            ends[:, column] = np.percentile(ratio[known[:, column], column], PERCENTILES)
        return ends[0], ends[1]

    def paired_p(self, differences: Float) -> Float:
        """Two-sided p-values (C,) of the paired permutation test that two methods are worth the same in every block.

        If they are, a block's difference (of `differences`, (L, C)) is as likely with either sign. The p-value is the
        share of random signs, those observed among them, that bring the sum over blocks as far from zero as it is, or
        farther; it is at least 1 / (R + 1), and NaN without locations. It does not hold for expectations, as those of
        random choice, which are no draws.
        """
        resamples, n_blocks = self._times.shape
        if n_blocks == 0:
            return np.full(differences.shape[1], np.nan)
        generator = np.random.default_rng([self._seed, 0, _SIGNS])
        signs = 1 - 2.0 * generator.integers(0, 2, self._times.shape, dtype=np.int8)
        # sums that are equal but for rounding count as equal
        differences = self._by_block(differences)
        observed = np.abs(differences.sum(0)) - 1e-9 * np.abs(differences).sum(0)
        as_far = (np.abs(signs @ differences) >= observed).sum(0)
        return np.asarray((1 + as_far) / (resamples + 1))
