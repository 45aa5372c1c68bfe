"""What a check measures, each with an interval by resampling blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.stats import rankdata

from wheretolook.evaluation.bootstrap import ClusterBootstrap, divide
from wheretolook.evaluation.calibration import BINS, bins_of
from wheretolook.geometry.poses import Float

RESAMPLES = 2000
PLACE_OF_DEPTH = 0.1
"""Views whose cameras are no farther apart than this share of the map's median depth share a place: half a metre in a
room of five. Within it what can be seen changes little, so that mostly the direction decides."""


@dataclass(frozen=True)
class Measured:
    """A value with its 95 % interval; NaN where it is not known."""

    value: float
    low: float
    high: float

    def record(self) -> dict[str, float | None]:
        """As values of JSON, None for what is not known."""
        named = {"value": self.value, "low": self.low, "high": self.high}
        return {name: float(value) if np.isfinite(value) else None for name, value in named.items()}


def measured(bootstrap: ClusterBootstrap, statistics: Float) -> Measured:
    """Value and interval from statistics (1 + R,) of the views and of each resample."""
    low, high = bootstrap.interval(statistics[:, None])
    return Measured(float(statistics[0]), float(low[0]), float(high[0]))


def resampled_auc(bootstrap: ClusterBootstrap, good: NDArray[np.bool_], score: Float, within: bool = False) -> Float:
    """Areas under the ROC curve (1 + R,) of scores (B,) of views that localize or not (B,), for each resample.

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


def resampled_calibration_error(
    bootstrap: ClusterBootstrap, probability: Float, good: NDArray[np.bool_], bins: int = BINS
) -> Float:
    """Expected calibration errors (1 + R,) of probabilities (B,) of views that localize or not (B,), per resample."""
    gaps = np.zeros((len(good), bins))
    gaps[np.arange(len(good)), bins_of(probability, bins)] = probability - good
    n_views = bootstrap.times @ bootstrap.sums(np.ones(len(good)))
    return divide(np.abs(bootstrap.times @ bootstrap.sums(gaps)).sum(1), n_views)


def places_of(centers: Float, blocks: NDArray[np.integer], radius: float) -> NDArray[np.int64]:
    """Places (B,) of views of the same block whose cameras (B, 3) are no farther apart than a radius; numbers from 0.

    By complete linkage: no two views of a place are farther apart.
    """
    place = np.zeros(len(centers), dtype=np.int64)
    count = 0
    for block in np.unique(blocks):
        rows = np.flatnonzero(blocks == block)
        found = np.ones(1, dtype=np.int64)
        if len(rows) > 1:
            found = fcluster(linkage(centers[rows], "complete"), radius, "distance")
        place[rows] = count + found - 1
        count += int(found.max())
    return place


def regret_of_places(
    place: NDArray[np.int64], good: NDArray[np.bool_], score: Float
) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_]]:
    """At each place with a choice, several views: a row of it, whether one is good, and whether the best-scored is."""
    firsts = []
    possible = []
    chosen = []
    for number in np.flatnonzero(np.bincount(place) > 1):
        rows = np.flatnonzero(place == number)
        firsts.append(rows[0])
        possible.append(good[rows].any())
        chosen.append(good[rows[np.argmax(score[rows])]])
    return np.array(firsts, dtype=np.int64), np.array(possible, dtype=bool), np.array(chosen, dtype=bool)


def measure(
    views: pd.DataFrame, methods: Sequence[str], columns: Sequence[str], centers: Float, radius: float,
    is_probability: bool,
) -> dict[str, object]:  # fmt: skip
    """All numbers of a check, by name; of methods by their columns of scores, the first the one that is checked.

    `centers` (B, 3) are the views' camera centres, `radius` the size of a place.
    """
    good = views["good"].to_numpy(dtype=bool)
    blocks = views["block"].to_numpy()
    bootstrap = ClusterBootstrap(blocks, RESAMPLES, seed=0)
    place = places_of(centers, blocks, radius)
    visible = resampled_auc(bootstrap, good, views[columns[-1]].to_numpy(np.float64))
    of_methods: dict[str, object] = {}
    n_places = n_choices = 0
    for method, column in zip(methods, columns, strict=True):
        score = views[column].to_numpy(np.float64)
        auc = resampled_auc(bootstrap, good, score)
        rows, possible, chosen = regret_of_places(place, good, score)
        lost = np.zeros(len(views))
        asked = np.zeros(len(views))
        lost[rows] = possible & ~chosen
        asked[rows] = 1
        n_places = len(rows)
        n_choices = int(sum(0 < good[place == place[row]].mean() < 1 for row in rows))
        of_methods[method] = {
            "auc": measured(bootstrap, auc).record(),
            "auc_above_visible": measured(bootstrap, auc - visible).record(),
            "auc_within_blocks": measured(bootstrap, resampled_auc(bootstrap, good, score, within=True)).record(),
            "regret": measured(bootstrap, bootstrap.ratios(100 * lost, asked)).record(),
            "rank_correlation_with_inliers": _correlation(score, views["n_inliers"].to_numpy(np.float64)),
        }
    found = views["n_inliers"].to_numpy(np.float64) * good
    expected = views["expected_inliers"].to_numpy(np.float64)
    told = np.isfinite(expected)
    ece = (
        measured(bootstrap, resampled_calibration_error(bootstrap, views["score"].to_numpy(), good))
        if is_probability
        else None
    )
    return {
        "n_views": len(views),
        "n_localized": int(good.sum()),
        "n_blocks": bootstrap.n_clusters,
        "n_places": n_places,
        "n_places_of_both_kinds": n_choices,
        "methods": of_methods,
        "ece": ece.record() if ece else None,
        "mean_probability": float(views["score"].mean()) if is_probability else None,
        "share_localized": float(good.mean()),
        "inliers_found_over_expected": (
            {
                "localized": measured(
                    bootstrap, bootstrap.ratios(np.where(good, found, 0), np.where(good, expected, 0))
                ).record(),
                "all": measured(bootstrap, bootstrap.ratios(found, expected)).record(),
            }
            if told.all()
            else None
        ),
        "share_in_range": float(views["in_range"].mean()),
    }


def _correlation(a: Float, b: Float) -> float | None:
    """Spearman's rank correlation; None where one of them is constant."""
    if len(a) < 2 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return None
    return float(np.corrcoef(rankdata(a), rankdata(b))[0, 1])
