"""Metrics of a check, with intervals by resampling blocks.

Blocks overlap, as grown ones take photographs of others: intervals hold for this map and these photographs, and are
rather too narrow than too wide.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.stats import rankdata, t as student

from wheretolook.evaluation.statistics import BINS, ClusterBootstrap, bins_of, divide
from wheretolook.geometry.poses import Float

RESAMPLES = 2000


def resampled_auc(bootstrap: ClusterBootstrap, good: NDArray[np.bool_], score: Float, within: bool = False) -> Float:
    """Compute areas under the ROC curve (1 + R,) of scores (B,) of views that localize or not (B,), for each resample.

    The share of pairs of a view that localizes and one that does not in which the former has the higher score; equal
    scores count half. With `within`, only pairs of the same cluster count.
    """
    k = bootstrap.n_clusters
    wins = np.zeros((k, k))
    pairs = np.zeros((k, k))
    positives = [score[good & (bootstrap.cluster == cluster)] for cluster in range(k)]
    negatives = [np.sort(score[~good & (bootstrap.cluster == cluster)]) for cluster in range(k)]
    for i, better in enumerate(positives):
        for j, worse in enumerate(negatives):
            below = np.searchsorted(worse, better, "left") + np.searchsorted(worse, better, "right")
            wins[i, j] = below.sum() / 2
            pairs[i, j] = len(better) * len(worse)
    times = bootstrap.times
    if within:
        return divide(times @ np.diag(wins), times @ np.diag(pairs))
    return divide(((times @ wins) * times).sum(1), ((times @ pairs) * times).sum(1))


def resampled_calibration_error(bootstrap: ClusterBootstrap, probability: Float, good: NDArray[np.bool_]) -> Float:
    """Compute expected calibration errors (1 + R,) of probabilities (B,) of views that localize or not (B,), per resample."""
    gaps = np.zeros((len(good), BINS))
    gaps[np.arange(len(good)), bins_of(probability)] = probability - good
    n_views = bootstrap.times @ bootstrap.sums(np.ones(len(good)))
    return divide(np.abs(bootstrap.times @ bootstrap.sums(gaps)).sum(1), n_views)


def error_of_calibrated(probability: Float, n_draws: int = 200) -> float:
    """Return the 95 % quantile of the calibration error of probabilities (B,) if they were exact.

    Views are few, so it is not 0 (Bröcker and Smith, Increasing the Reliability of Reliability Diagrams, 2007).
    """
    drawn = np.random.default_rng(0).random((n_draws, len(probability))) < probability
    bins = bins_of(probability)
    errors = [np.abs(np.bincount(bins, probability - good)).sum() / len(good) for good in drawn]
    return float(np.quantile(errors, 0.95))


def places_of(centers: Float, blocks: NDArray[np.integer], radius: float) -> NDArray[np.int64]:
    """Group views of the same block into places (B,), numbered from 0, whose cameras (B, 3) are within a radius.

    By complete linkage: no two views of a place are farther apart.
    """
    place = np.zeros(len(centers), dtype=np.int64)
    count = 0
    for block in np.unique(blocks):
        rows = np.flatnonzero(blocks == block)
        groups = np.ones(1, dtype=np.int64)
        if len(rows) > 1:
            groups = fcluster(linkage(centers[rows], "complete"), radius, "distance")
        place[rows] = count + groups - 1
        count += int(groups.max())
    return place


def regret_of_places(
    place: NDArray[np.int64], good: NDArray[np.bool_], score: Float
) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return, for each place with several views, its first row, whether any view is good, and whether the best-scored is."""
    places = [np.flatnonzero(place == number) for number in np.flatnonzero(np.bincount(place) > 1)]
    firsts = np.array([rows[0] for rows in places], dtype=np.int64)
    possible = np.array([good[rows].any() for rows in places], dtype=bool)
    chosen = np.array([good[rows[np.argmax(score[rows])]] for rows in places], dtype=bool)
    return firsts, possible, chosen


def measure(
    views: pd.DataFrame, columns: Mapping[str, str], centers: Float, radius: float, is_probability: bool
) -> dict[str, object]:
    """Compute all metrics of a check, by name; with an interval, as a dictionary of value, low and high.

    Args:
        views: results of all blocks, with the scores of the checked method in `score`.
        columns: of `views` with the scores of the methods, by their names; the last method is the baseline.
        centers: (B, 3) camera centres.
        radius: of a place.
        is_probability: whether `score` is a probability.
    """
    good = views["good"].to_numpy(dtype=bool)
    blocks = views["block"].to_numpy()
    n_inliers = views["n_inliers"].to_numpy(np.float64)
    bootstrap = ClusterBootstrap(blocks, RESAMPLES, seed=0)

    record = partial(_record, bootstrap)
    place = places_of(centers, blocks, radius)
    scores = {method: views[column].to_numpy(np.float64) for method, column in columns.items()}
    areas = {method: resampled_auc(bootstrap, good, score) for method, score in scores.items()}
    baseline_auc = areas[[*areas][-1]]
    rarer = good if good.sum() < len(good) / 2 else ~good
    decide = partial(record, blocks=len(np.unique(blocks[rarer])))
    of_methods: dict[str, object] = {}
    for method, score in scores.items():
        rows, possible, chosen = regret_of_places(place, good, score)
        missed = np.zeros(len(views))
        has_choice = np.zeros(len(views))
        missed[rows] = possible & ~chosen
        has_choice[rows] = 1
        of_methods[method] = {
            "auc": decide(areas[method]),
            "auc_above_visible": decide(areas[method] - baseline_auc, -1),
            "auc_within_blocks": decide(resampled_auc(bootstrap, good, score, within=True)),
            "regret": record(bootstrap.ratios(100 * missed, has_choice), most=100),
            "rank_correlation_with_inliers": _correlation(score, n_inliers),
        }
    right = views["right_place"].to_numpy(bool) & np.isfinite(views["expected_error_m"].to_numpy(np.float64))
    errors = {name: _compared(bootstrap, views, right, name) for name in ("m", "deg")} if right.any() else None
    sizes = np.bincount(place)
    n_good = np.bincount(place, weights=good)
    probability = views["score"].to_numpy()
    expected = views["expected_inliers"].to_numpy(np.float64)
    ratios = None
    if np.isfinite(expected).all():
        ratios = {
            "localized": record(bootstrap.ratios(n_inliers * good, expected * good), most=np.inf),
            "all": record(bootstrap.ratios(n_inliers * good, expected), most=np.inf),
        }
    return {
        "n_views": len(views),
        "n_localized": int(good.sum()),
        "n_blocks": bootstrap.n_clusters,
        "n_places": int((sizes > 1).sum()),
        "n_places_of_both_kinds": int(((n_good > 0) & (n_good < sizes)).sum()),
        "methods": of_methods,
        "ece": record(resampled_calibration_error(bootstrap, probability, good)) if is_probability else None,
        "ece_if_calibrated": error_of_calibrated(probability) if is_probability else None,
        "errors_at_right_place": errors,
        "mean_probability": float(probability.mean()) if is_probability else None,
        "share_localized": float(good.mean()),
        "inliers_found_over_expected": ratios,
        "share_in_range": float(views["in_range"].mean()),
    }


def _compared(
    bootstrap: ClusterBootstrap, views: pd.DataFrame, right: NDArray[np.bool_], unit: str
) -> dict[str, object]:
    """Compare observed errors of views at the right place (B,) with expected ones: medians, 90 % quantiles, mean ratio."""
    named = {"observed": views[f"error_{unit}"], "expected": views[f"expected_error_{unit}"]}
    quantiles = {
        f"{name}_{q:.0%}": float(errors[right].quantile(q)) for name, errors in named.items() for q in (0.5, 0.9)
    }
    logs = np.zeros(len(views))
    logs[right] = np.log(np.maximum(named["observed"][right], 1e-12) / named["expected"][right])
    ratios = np.exp(bootstrap.ratios(logs, right.astype(np.float64)))
    return {"n": int(right.sum()), **quantiles, "ratio": _record(bootstrap, ratios, most=np.inf)}


def _record(
    bootstrap: ClusterBootstrap, statistics: Float, least: float = 0, most: float = 1, blocks: int | None = None
) -> dict[str, float | None]:
    """Return value and 95 % interval of statistics (1 + R,) of the views and of each resample; None where unknown.

    Resampling few blocks makes intervals too narrow: they are widened as Student's quantile exceeds that of 11
    blocks, within `least` and `most`. `blocks` are those that decide the statistic, by default all; one decides nothing.
    """
    count = bootstrap.n_clusters if blocks is None else blocks
    value = statistics[0]
    low, high = bootstrap.interval(statistics)
    if count < 2:
        low, high = (np.where(np.isfinite(value), end, np.nan) for end in (least, most))
    else:
        quantiles = student.ppf(0.975, np.array([count, 11]) - 1)
        wider = max(1.0, quantiles[0] / quantiles[1])
        low, high = (np.clip(value + wider * (end - value), least, most) for end in (low, high))
    named = {"value": value, "low": low, "high": high}
    return {name: float(value) if np.isfinite(value) else None for name, value in named.items()}


def _correlation(a: Float, b: Float) -> float | None:
    """Compute Spearman's rank correlation; None where one of them is constant."""
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return None
    return float(np.corrcoef(rankdata(a), rankdata(b))[0, 1])
