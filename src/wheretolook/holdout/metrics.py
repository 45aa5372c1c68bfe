"""What a check measures, each with an interval by resampling blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.stats import rankdata

from wheretolook.evaluation.bootstrap import PERCENTILES
from wheretolook.evaluation.calibration import BINS
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


class BlockResamples:
    """Resamples of K blocks with replacement, drawn once for all numbers.

    Photographs of a block are neighbours and were localized against the same map: a block stays together. The blocks
    overlap, as those that are grown take photographs that lie in others, too: intervals say how sure a number is for
    this map and these photographs, and are rather too narrow than too wide.
    """

    def __init__(self, blocks: NDArray[np.integer], resamples: int = RESAMPLES, seed: int = 0) -> None:
        self.numbers, self.row = np.unique(blocks, return_inverse=True)
        k = len(self.numbers)
        draws = np.random.default_rng(seed).integers(0, k, (resamples, k))
        drawn = np.bincount((draws + np.arange(resamples)[:, None] * k).ravel(), minlength=resamples * k)
        # how often each block counts: in the first row as it is, in the others as it was drawn, (1 + R, K)
        self.times = np.concatenate([np.ones((1, k)), drawn.reshape(resamples, k)]).astype(np.float64)

    def sums(self, values: Float) -> Float:
        """Sums over each block, (K,) or (K, C), of values of views (B,) or (B, C)."""
        found = np.zeros((len(self.numbers), *values.shape[1:]))
        np.add.at(found, self.row, values)
        return found

    def measured(self, values: Float) -> Measured:
        """The first of (1 + R,) values and the interval of the others, as far as they are known."""
        known = values[1:][np.isfinite(values[1:])]
        if not len(known) or len(self.numbers) < 2:
            return Measured(float(values[0]), np.nan, np.nan)
        low, high = np.percentile(known, PERCENTILES)
        return Measured(float(values[0]), float(low), float(high))

    def ratio(self, top: Float, bottom: Float) -> Measured:
        """Of two sums over views, (B,) each."""
        return self.measured(_divided(self.times @ self.sums(top), self.times @ self.sums(bottom)))

    def auc(self, good: NDArray[np.bool_], score: Float, within: bool = False) -> Float:
        """Area under the ROC curve (1 + R,): of all pairs of a view that is good and one that is not, the share in
        which the good one has the higher score; equal scores count half. `within` takes pairs of one block only."""
        k = len(self.numbers)
        wins = np.zeros((k, k))
        pairs = np.zeros((k, k))
        good_of = [score[good & (self.row == block)] for block in range(k)]
        bad_of = [np.sort(score[~good & (self.row == block)]) for block in range(k)]
        for i, better in enumerate(good_of):
            for j, worse in enumerate(bad_of):
                below = np.searchsorted(worse, better, "left") + np.searchsorted(worse, better, "right")
                wins[i, j] = below.sum() / 2
                pairs[i, j] = len(better) * len(worse)
        times = self.times
        if within:
            return _divided(times @ np.diag(wins), times @ np.diag(pairs))
        return _divided(((times @ wins) * times).sum(1), ((times @ pairs) * times).sum(1))

    def calibration_error(self, probability: Float, good: NDArray[np.bool_], bins: int = BINS) -> Measured:
        """Expected calibration error, as `evaluation.calibration.expected_calibration_error`."""
        cell = np.clip(np.searchsorted(np.linspace(0, 1, bins + 1), probability, "right") - 1, 0, bins - 1)
        off = np.zeros((len(good), bins))
        off[np.arange(len(good)), cell] = probability - good
        gaps = self.times @ self.sums(off)
        number = self.times @ self.sums(np.ones(len(good)))
        return self.measured(_divided(np.abs(gaps).sum(1), number))


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
    resamples = BlockResamples(blocks)
    place = places_of(centers, blocks, radius)
    visible = resamples.auc(good, views[columns[-1]].to_numpy(np.float64))
    of_methods: dict[str, object] = {}
    n_places = n_choices = 0
    for method, column in zip(methods, columns, strict=True):
        score = views[column].to_numpy(np.float64)
        auc = resamples.auc(good, score)
        rows, possible, chosen = regret_of_places(place, good, score)
        lost = np.zeros(len(views))
        asked = np.zeros(len(views))
        lost[rows] = possible & ~chosen
        asked[rows] = 1
        n_places = len(rows)
        n_choices = int(sum(0 < good[place == place[row]].mean() < 1 for row in rows))
        of_methods[method] = {
            "auc": resamples.measured(auc).record(),
            "auc_above_visible": resamples.measured(auc - visible).record(),
            "auc_within_blocks": resamples.measured(resamples.auc(good, score, within=True)).record(),
            "regret": resamples.ratio(100 * lost, asked).record(),
            "rank_correlation_with_inliers": _correlation(score, views["n_inliers"].to_numpy(np.float64)),
        }
    found = views["n_inliers"].to_numpy(np.float64) * good
    expected = views["expected_inliers"].to_numpy(np.float64)
    told = np.isfinite(expected)
    ece = resamples.calibration_error(views["score"].to_numpy(), good) if is_probability else None
    return {
        "n_views": len(views),
        "n_localized": int(good.sum()),
        "n_blocks": len(resamples.numbers),
        "n_places": n_places,
        "n_places_of_both_kinds": n_choices,
        "methods": of_methods,
        "ece": ece.record() if ece else None,
        "mean_probability": float(views["score"].mean()) if is_probability else None,
        "share_localized": float(good.mean()),
        "inliers_found_over_expected": (
            {
                "localized": resamples.ratio(np.where(good, found, 0), np.where(good, expected, 0)).record(),
                "all": resamples.ratio(found, expected).record(),
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


def _divided(top: Float, bottom: Float) -> Float:
    return np.divide(top, bottom, out=np.full(np.shape(top), np.nan), where=bottom > 0)
