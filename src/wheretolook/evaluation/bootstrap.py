"""Bootstrap intervals and paired permutation tests over clusters of dependent observations."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float

_PERCENTILES = (2.5, 97.5)  # ends of a 95 % interval


class ClusterBootstrap:
    """Draws clusters with replacement within each stratum; the draws serve all methods, so differences are paired.

    Views at neighbouring locations share landmarks. Treated as independent they would make intervals too narrow (by half
    for stacked voxels of the release's test scenes), so a cluster is drawn as a whole. Strata, such as scenes, keep
    their sizes: an interval covers these scenes, not unseen ones.

    Args:
        clusters: (L,) cluster of each observation. Clusters of different strata are different, whatever their numbers.
        resamples: number R of resamples, and of sign flips.
        seed: with the clusters and strata, it determines the resamples.
        strata: (L,) stratum of each observation, a number of at least 0; None for one stratum.

    Attributes:
        times: (1 + R, K) how often each of K clusters counts: once in the first row, as often as drawn in the others.
        cluster: (L,) column in `times` of each observation.
    """

    def __init__(
        self,
        clusters: NDArray[np.integer[Any]],
        resamples: int,
        seed: int,
        strata: NDArray[np.integer[Any]] | None = None,
    ) -> None:
        strata = np.zeros_like(clusters) if strata is None else strata
        pairs, cluster = np.unique(np.stack([strata, clusters], axis=1), axis=0, return_inverse=True)
        self.cluster = cluster.reshape(-1)
        self.times = np.ones((1 + resamples, len(pairs)))
        for stratum in np.unique(strata):
            columns = np.flatnonzero(pairs[:, 0] == stratum)
            n = len(columns)
            draws = np.random.default_rng([seed, int(stratum)]).integers(0, n, (resamples, n))
            flat = draws + np.arange(resamples)[:, None] * n
            self.times[1:, columns] = np.bincount(flat.reshape(-1), minlength=resamples * n).reshape(resamples, n)
        self._has_intervals = np.bincount(pairs[:, 0]).max(initial=0) > 1
        self._seed = seed

    @property
    def n_clusters(self) -> int:
        """K."""
        return self.times.shape[1]

    def sums(self, values: Float) -> Float:
        """Sum values (L, ...) over the observations of each cluster; (K, ...)."""
        sums = np.zeros((self.n_clusters, *values.shape[1:]))
        np.add.at(sums, self.cluster, values)
        return sums

    def ratios(self, numerator: Float, denominator: Float) -> Float:
        """Ratios (1 + R, ...) of sums over all observations of (L, ...): of the data first, then of each resample.

        NaN where the denominator's sum is not positive.
        """
        top, bottom = (np.tensordot(self.times, self.sums(values), axes=1) for values in (numerator, denominator))
        return divide(top, bottom)

    def interval(self, values: Float) -> tuple[Float, Float]:
        """95 % percentile interval of statistics (1 + R, ...), of the data and of the resamples, without NaN.

        Returns lower and upper ends, (...) each; NaN where all are NaN, or where no stratum has two clusters.
        """
        if not self._has_intervals:
            values = np.full_like(values, np.nan)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of columns that are all NaN
            low, high = np.nanpercentile(values[1:], _PERCENTILES, axis=0)
        return low, high

    def ratio_interval(self, numerator: Float, denominator: Float) -> tuple[Float, Float]:
        """95 % interval of the ratio of sums over observations of values (L, ...) that broadcast; see `interval`."""
        return self.interval(self.ratios(numerator, denominator))

    def paired_p(self, differences: Float) -> Float:
        """Two-sided p-values (...) of paired permutation tests that two methods are equally good in every cluster.

        Under that hypothesis the difference of a cluster (sum of `differences`, (L, ...)) has a random sign. The p-value
        is the share of sign flips, the observed signs included, whose sum over clusters is at least as far from zero as
        the observed one: at least 1 / (R + 1); NaN without observations. The test does not apply to expectations, such
        as those of random choice.
        """
        if self.n_clusters == 0:
            return np.full(differences.shape[1:], np.nan)
        rng = np.random.default_rng([self._seed, 0, 1])  # other numbers than those of the resamples
        signs = 1 - 2.0 * rng.integers(0, 2, self.times[1:].shape, dtype=np.int8)
        by_cluster = self.sums(differences)
        # sums that are equal up to rounding count as equal
        observed = np.abs(by_cluster.sum(0)) - 1e-9 * np.abs(by_cluster).sum(0)
        as_far = (np.abs(np.tensordot(signs, by_cluster, axes=1)) >= observed).sum(0)
        return np.asarray((1 + as_far) / (len(signs) + 1))


def divide(numerator: Float, denominator: Float | float) -> Float:
    """Divide arrays that broadcast; NaN where the denominator is not positive."""
    denominator = np.asarray(denominator)
    shape = np.broadcast_shapes(np.shape(numerator), denominator.shape)
    return np.asarray(np.divide(numerator, denominator, out=np.full(shape, np.nan), where=denominator > 0))
