"""The table of localization scores: every method, every N, all scenes together and each alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from sklearn.metrics import average_precision_score, roc_auc_score

from wheretolook.evaluation.bootstrap import LocationBootstrap
from wheretolook.evaluation.config import EvaluateConfig, threshold_key
from wheretolook.evaluation.ranking import TestViews, TopN, choose_at_random, choose_best, choose_by_truth
from wheretolook.geometry import Float

ALL = "all"
"""Value of the column `scene` in rows over all scenes."""

Method = tuple[str, str]
"""Name of a method and its input variant ("" if it has none)."""


def score_table(
    views: TestViews, scores: Mapping[Method, Float], scenes: Sequence[str], config: EvaluateConfig
) -> pd.DataFrame:
    """Compare methods (paper, Sec. 4.1 and its tables 2 and 3).

    At every location the N views with the highest score are chosen, and the chosen views of all locations are pooled.
    A location with fewer than N views contributes what it has. The paper divides all shares by one constant, 0.527;
    here each is divided by the oracle's at the same threshold, scenes and N.

    Choosing at random is not drawn but computed: its rows hold exact expectations. Its average precision and ROC AUC
    are those of one seeded draw.

    Args:
        views: the candidates.
        scores: (B,) scores by method and inputs.
        scenes: names of the scenes, by their number in `views`.
        config: values of N, thresholds, bootstrap.

    Returns:
        One row for each method (and the oracle), N and scene, `scene` being "all" in rows over all scenes. Columns:
        method, inputs, top_n, scene, n_locations, n_views (chosen views), and for each threshold, such as
        "0.05m_0.4deg": raw_* (share of good views), normalized_* (divided by the oracle's share; NaN if that is 0),
        any_* (share of locations with at least one good view), and low_* and high_* of raw_ and normalized_ (bootstrap
        interval over locations, see `LocationBootstrap`); then average_precision and roc_auc of the scores against the
        first threshold, NaN where all views are of one class. All shares lie in [0, 1].
    """
    pools: list[tuple[str, NDArray[np.bool_]]] = [(ALL, np.ones(views.n_locations, dtype=bool))]
    if len(scenes) > 1:
        pools += [(name, views.location_scene == number) for number, name in enumerate(scenes)]
    else:
        pools += [(scenes[0], pools[0][1])]
    methods: list[Method] = [*scores, ("oracle", "")]
    rows = []
    for name, locations in pools:
        inside = locations[views.location]
        bootstrap = LocationBootstrap(views.location_scene[locations], config.resamples, config.seed)
        ranked = {method: _ranking_metrics(views.good[inside, 0], values[inside]) for method, values in scores.items()}
        for method in methods:
            for n in config.top_n:
                oracle = _only(choose_by_truth(views, n), locations)
                if method[0] == "oracle":
                    top = oracle
                elif method[0] == "random":
                    top = _only(choose_at_random(views, n), locations)
                else:
                    top = _only(choose_best(views, scores[method], n), locations)
                row = {"method": method[0], "inputs": method[1], "top_n": n, "scene": name}
                row |= _shares(top, oracle, bootstrap, config)
                row |= ranked.get(method, {"average_precision": 1.0, "roc_auc": 1.0})
                rows.append(row)
    return pd.DataFrame(rows)


def _only(top: TopN, locations: NDArray[np.bool_]) -> TopN:
    return TopN(top.chosen[locations], top.good[locations], top.any_good[locations])


def _shares(top: TopN, oracle: TopN, bootstrap: LocationBootstrap, config: EvaluateConfig) -> dict[str, float]:
    columns: dict[str, float] = {"n_locations": len(top.chosen), "n_views": int(top.chosen.sum())}
    chosen, best = top.chosen[:, None], oracle.good.sum(0)
    raw = top.good.sum(0) / chosen.sum()
    normalized = np.divide(top.good.sum(0), best, out=np.full(len(best), np.nan), where=best > 0)
    raw_ends, normalized_ends = bootstrap.ratio(top.good, chosen), bootstrap.ratio(top.good, oracle.good)
    for index, threshold in enumerate(config.thresholds):
        key = threshold_key(threshold)
        columns[f"raw_{key}"] = float(raw[index])
        columns[f"raw_low_{key}"], columns[f"raw_high_{key}"] = (float(end[index]) for end in raw_ends)
        columns[f"normalized_{key}"] = float(normalized[index])
        columns[f"normalized_low_{key}"], columns[f"normalized_high_{key}"] = (
            float(end[index]) for end in normalized_ends
        )
        columns[f"any_{key}"] = float(top.any_good[:, index].mean())
    return columns


def _ranking_metrics(good: NDArray[np.bool_], scores: Float) -> dict[str, float]:
    if good.all() or not good.any():
        return {"average_precision": float("nan"), "roc_auc": float("nan")}
    return {
        "average_precision": float(average_precision_score(good, scores)),
        "roc_auc": float(roc_auc_score(good, scores)),
    }
