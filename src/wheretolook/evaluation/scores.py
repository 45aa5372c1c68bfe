"""Tables of localization scores: a row for each method (and the oracle), N and scene.

`scene` is "all" in rows over all scenes. Columns: method, top_n, scene, n_locations, n_views (chosen views), and for each
threshold, such as "0.05m_0.4deg":

- good_*: number of chosen views that are good.
- raw_*: share of good views. normalized_*: divided by the oracle's share; NaN if that is 0. released_*: divided by
  `RELEASED_DIVISOR`, which can give more than 1.
- any_*: share of locations with at least one good view.
- regret_*: the oracle's raw share less the method's, at least 0.
- difference_*: the method's raw share less the reference's, and p_*, the p-value of `ClusterBootstrap.paired_p`; NaN
  without a reference, p_* also for random choice.
- low_* and high_* of raw_, normalized_, any_, regret_ and difference_, such as raw_low_*: bootstrap interval over blocks
  of locations, paired where two methods are compared (`ClusterBootstrap.ratio_interval`).

If views are labelled by both localizers, the same columns by the first RANSAC result have the prefix "first_".

Then reference ("" for none); average_precision and roc_auc of the scores against the first threshold, NaN where all views
are of one class; and for methods that give probabilities ece (expected calibration error), ece_scaled (with logits
divided by the temperature) and temperature, NaN where unknown. A scene without candidates has rows with 0 locations and
NaN.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wheretolook.dataset.thresholds import ALL, threshold_key
from wheretolook.dataset.viewpoint_table import FIRST
from wheretolook.evaluation.bootstrap import ClusterBootstrap, divide
from wheretolook.evaluation.calibration import expected_calibration_error, scale_probability
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.ranking import (
    CandidateViews,
    TopN,
    choose_at_random,
    choose_best,
    choose_oracle,
    rank_views,
)
from wheretolook.geometry.poses import Float
from wheretolook.scorers.registry import find, is_probability
from wheretolook.scorers.styles import ORACLE
from wheretolook.utils.validation import check_choice

PHOTOGRAPHS = "photographs"  # value of the column `candidates` in rows of held-out photographs

RELEASED_DIVISOR = 0.527
"""Divisor of every share in the paper's released code, whatever the threshold, the scenes and N."""

_PAIRED = ("difference", "difference_low", "difference_high", "p")
_CALIBRATION = {"ece": np.nan, "ece_scaled": np.nan, "temperature": np.nan}  # columns where they are unknown

Choices = Mapping[tuple[str, int], TopN]  # by method, the oracle included, and N


def read_scores(path: Path) -> pd.DataFrame:
    """Read a score table (`score_table`) from its CSV file."""
    return pd.read_csv(path, keep_default_na=False, na_values=[""]).fillna({"reference": ""})


def threshold_keys(scores: pd.DataFrame) -> list[str]:
    """Return the thresholds of a score table, as in its column names."""
    return [name.removeprefix("released_") for name in scores.columns if name.startswith("released_")]


def main_rows(scores: pd.DataFrame, columns: Sequence[str] = ("occlusion", "candidates")) -> pd.DataFrame:
    """Return the rows of a table's first occlusion model and first set of candidates, as far as it has the columns."""
    for name in columns:
        if name in scores:
            scores = scores[scores[name] == scores[name].iloc[0]]
    return scores


def methods_of(scores: pd.DataFrame) -> list[str]:
    """Return the methods of a score table, in order."""
    return list(scores["method"].unique())


def reference_of(scores: pd.DataFrame) -> str:
    """Return the method that a score table compares the others with; "" if there is none."""
    name = str(scores["reference"].iloc[0])
    return name if name in methods_of(scores) else ""


def is_random(method: str) -> bool:
    """Whether a method chooses at random, so that its rows hold exact expectations."""
    return bool(getattr(find(method), "is_random_baseline", False))


def choose(views: CandidateViews, scores: Mapping[str, Float], top_n: Sequence[int]) -> Choices:
    """Choose N views of every location by each method's scores (B,), and by the oracle."""
    choices: dict[tuple[str, int], TopN] = {}
    for method, values in scores.items():
        if is_random(method):
            choices |= {(method, n): choose_at_random(views, n) for n in top_n}
        else:
            ranks = rank_views(views, values)
            choices |= {(method, n): choose_best(views, ranks, n) for n in top_n}
    return choices | {(ORACLE, n): choose_oracle(views, n) for n in top_n}


def reference_method(methods: Iterable[str], name: str) -> str:
    """Return the method that the others are compared with (`EvaluateConfig.reference`); "" if there is none.

    Raises a ConfigError if no method has that name.
    """
    if name:
        check_choice("reference among the methods evaluated", name, methods)
        return name
    learned = {method: record for method in methods if (record := find(method)) is not None and record.probability}
    return max(learned, key=lambda method: learned[method].reference, default="")


def score_table(
    views: CandidateViews,
    scores: Mapping[str, Float],
    scenes: Sequence[str],
    config: EvaluateConfig,
    temperatures: Mapping[str, float] | None = None,
    choices: Choices | None = None,
) -> pd.DataFrame:
    """Compare methods by their scores (B,) of views (paper, Sec. 4.1, tables 2 and 3).

    At every location the N views with the highest scores are chosen, or all where there are fewer; the chosen views of
    all locations are pooled. The paper divides all shares by one constant, 0.527; here each is also divided by the
    oracle's share at the same threshold, scenes and N. Rows of random choice hold exact expectations, but its average
    precision and ROC AUC are those of one seeded draw.

    Args:
        views: the views to choose from.
        scores: (B,) by method.
        scenes: names of the scenes by their numbers in `views`.
        config: values of N, thresholds, reference, seed and resamples.
        temperatures: of learned methods, where known (`wheretolook.evaluation.calibration`).
        choices: result of `choose`, if known already.

    Returns:
        The table, with the columns that this module lists.

    Raises:
        ConfigError: the reference is none of the methods.
    """
    pools = [(ALL, np.ones(views.n_locations, dtype=bool))]
    pools += [(name, views.location_scene == number) for number, name in enumerate(scenes)]
    reference = reference_method(scores, config.reference)
    choices = choose(views, scores, config.top_n) if choices is None else choices
    rows: list[dict[str, object]] = []
    for name, locations in pools:
        inside = locations[views.location]
        strata = views.location_scene[locations]
        bootstrap = ClusterBootstrap(views.location_block[locations], config.resamples, config.seed, strata)
        good = views.good[inside, 0]
        metrics = {}
        for method, values in scores.items():
            temperature = (temperatures or {}).get(method, np.nan)
            metrics[method] = _ranking_metrics(good, values[inside])
            metrics[method] |= _calibration_metrics(method, good, values[inside], temperature)
        metrics[ORACLE] = {"average_precision": 1.0, "roc_auc": 1.0, **_CALIBRATION}
        shares = {}
        for n in config.top_n:
            tops = {method: top.only(locations) for (method, number), top in choices.items() if number == n}
            shares[n] = _share_columns(tops, reference, bootstrap, config)
        for method, of_method in metrics.items():
            for n in config.top_n:
                row = {"method": method, "top_n": n, "scene": name}
                rows.append(row | shares[n][method] | {"reference": reference} | of_method)
    return pd.DataFrame(rows)


def _share_columns(
    tops: Mapping[str, TopN], reference: str, bootstrap: ClusterBootstrap, config: EvaluateConfig
) -> dict[str, dict[str, float]]:
    """Return the columns of each of M methods for one N and one pool of L locations."""
    good = np.stack([top.good for top in tops.values()], axis=1)  # (L, M, T)
    any_good = np.stack([top.any_good for top in tops.values()], axis=1)
    chosen = tops[ORACLE].chosen[:, None, None]  # (L, 1, 1): the same for every method
    best = np.broadcast_to(tops[ORACLE].good[:, None], good.shape)
    columns = {"good": good.sum(0)}

    def add(name: str, numerator: Float, denominator: Float) -> None:
        columns[name] = divide(numerator.sum(0), denominator.sum(0))
        columns[f"{name}_low"], columns[f"{name}_high"] = bootstrap.ratio_interval(numerator, denominator)

    add("raw", good, chosen)
    add("normalized", good, best)
    add("any", any_good, np.ones_like(chosen))
    columns["released"] = columns["raw"] / RELEASED_DIVISOR
    add("regret", best - good, chosen)
    if not reference:
        columns |= dict.fromkeys(_PAIRED, np.full(good.shape[1:], np.nan))
    else:
        difference = good - tops[reference].good[:, None]
        add("difference", difference, chosen)
        columns["p"] = bootstrap.paired_p(difference)
        expected = [is_random(reference) or is_random(method) for method in tops]
        columns["p"][expected] = np.nan  # the test does not apply to expectations
    keys = [(prefix, threshold_key(limits)) for prefix in ("", FIRST) for limits in config.thresholds]
    return {
        method: {"n_locations": len(good), "n_views": int(chosen.sum())}
        | {
            f"{prefix}{name}_{key}": float(values[row, index])
            for index, (prefix, key) in enumerate(keys[: good.shape[2]])
            for name, values in columns.items()
        }
        for row, method in enumerate(tops)
    }


def _ranking_metrics(good: NDArray[np.bool_], scores: Float) -> dict[str, float]:
    from sklearn.metrics import average_precision_score, roc_auc_score  # takes a second; reading a table needs none

    if good.all() or not good.any():
        return {"average_precision": np.nan, "roc_auc": np.nan}
    return {
        "average_precision": float(average_precision_score(good, scores)),
        "roc_auc": float(roc_auc_score(good, scores)),
    }


def _calibration_metrics(method: str, good: NDArray[np.bool_], scores: Float, temperature: float) -> dict[str, float]:
    metrics = dict(_CALIBRATION)
    if is_probability(method):
        metrics["ece"] = expected_calibration_error(scores, good)
        if np.isfinite(temperature):
            scaled = scale_probability(scores, temperature)
            metrics |= {"ece_scaled": expected_calibration_error(scaled, good), "temperature": temperature}
    return metrics
