"""Intervals by resampling clusters, calibration errors, and precision over coverage."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import expit

from wheretolook.geometry.poses import Float
from wheretolook.scorers.base import finite_log_odds


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
            low, high = np.nanpercentile(values[1:], (2.5, 97.5), axis=0)
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


Labels = NDArray[np.bool_]  # (B,) whether each view localizes
BINS = 15  # bins of equal width
MARGIN = 1e-15  # probabilities are clipped to this distance from 0 and 1


def bins_of(probability: Float, bins: int = BINS) -> NDArray[np.int64]:
    """Return the number (B,) of the bin of equal width that holds each probability (B,)."""
    edges = np.linspace(0, 1, bins + 1)
    return np.clip(np.searchsorted(edges, probability, side="right") - 1, 0, bins - 1)


def reliability(probability: Float, good: Labels, bins: int = BINS) -> pd.DataFrame:
    """Compute the reliability curve: the share of views (B,) that localize, by predicted probability (B,).

    One row for each bin of equal width, lower end included, of the last bin also the upper: bin_low, bin_high,
    mean_predicted, share_good (both NaN where the bin is empty) and n (views).
    """
    edges = np.linspace(0, 1, bins + 1)
    rows = bins_of(probability, bins)
    n = np.bincount(rows, minlength=bins)
    curve = pd.DataFrame({"bin_low": edges[:-1], "bin_high": edges[1:]})
    for name, values in (("mean_predicted", probability), ("share_good", good)):
        sums = np.bincount(rows, weights=values, minlength=bins)
        curve[name] = np.divide(sums, n, out=np.full(bins, np.nan), where=n > 0)
    return curve.assign(n=n)


def expected_calibration_error(probability: Float, good: Labels, bins: int = BINS) -> float:
    """Compute the expected calibration error in [0, 1] (Naeini et al., AAAI 2015); NaN without views.

    The mean over the views of the distance between predicted and observed share of their bin in the `reliability` curve.
    """
    if not len(probability):
        return float("nan")
    curve = reliability(probability, good, bins)
    return float((curve["n"] * (curve["mean_predicted"] - curve["share_good"]).abs()).sum() / curve["n"].sum())


def negative_log_likelihood(probability: Float, good: Labels) -> float:
    """Compute the mean negative log-likelihood of labels (B,) under probabilities (B,), in nats."""
    return _mean_loss(finite_log_odds(probability, MARGIN), good)


def fit_temperature(probability: Float, good: Labels) -> float:
    """Fit the temperature of 0.01 to 100 that maximizes the likelihood of labels (B,) (Guo et al., ICML 2017).

    It is above 1 for an overconfident network, below 1 for an underconfident one; NaN where all labels are of one class.
    """
    if not len(good) or good.all() or not good.any():
        return float("nan")
    logits = finite_log_odds(probability, MARGIN)

    def loss(log_t: float) -> float:
        return _mean_loss(logits / np.exp(log_t), good)

    best = minimize_scalar(loss, bounds=np.log((0.01, 100.0)), method="bounded", options={"xatol": 1e-6})
    return float(np.exp(best.x))


def scale_probability(probability: Float, temperature: float) -> Float:
    """Divide the logits of probabilities (B,) by a temperature; their order stays."""
    return np.asarray(expit(finite_log_odds(probability, MARGIN) / temperature))


def calibration_rows(probability: Float, good: Labels, temperature: float) -> pd.DataFrame:
    """Compute the reliability curve before and, if the temperature is known (not NaN), after scaling.

    Columns: n_views (B), when ("before" or "after"), those of `reliability`, and ece and nll of the whole curve.
    """
    curves = {"before": probability}
    if np.isfinite(temperature):
        curves["after"] = scale_probability(probability, temperature)
    parts = []
    for when, values in curves.items():
        curve = reliability(values, good)
        curve.insert(0, "n_views", len(good))
        curve.insert(1, "when", when)
        ece = expected_calibration_error(values, good)
        parts.append(curve.assign(ece=ece, nll=negative_log_likelihood(values, good)))
    return pd.concat(parts, ignore_index=True)


def _mean_loss(logits: Float, good: Labels) -> float:
    return float(np.mean(np.logaddexp(0, logits) - np.where(good, logits, 0.0)))


def read_calibration(path: Path) -> pd.DataFrame:
    """Read the reliability curves that the evaluate command writes as a CSV file."""
    return pd.read_csv(path, keep_default_na=False, na_values=[""])
