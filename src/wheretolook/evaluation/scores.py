"""The table of localization scores: every method, every N, all scenes together and each alone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wheretolook.dataset.thresholds import ALL, threshold_key
from wheretolook.evaluation.bootstrap import ClusterBootstrap, divide
from wheretolook.evaluation.calibration import expected_calibration_error, scale_probability
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.ranking import TestViews, TopN, choose_at_random, choose_best, choose_by_truth, rank_views
from wheretolook.geometry.poses import Float
from wheretolook.scorers.registry import find
from wheretolook.scorers.styles import ORACLE
from wheretolook.utils.errors import ConfigError

RELEASED_DIVISOR = 0.527
"""What the paper's released code divides every share by, whatever the threshold, the scenes and N."""


_PAIRED = ("difference", "difference_low", "difference_high", "p")
_CALIBRATION = ("ece", "ece_scaled", "temperature")

Choices = Mapping[tuple[str, int], TopN]  # what each method, the oracle too, chooses for each N


def read_scores(path: Path) -> pd.DataFrame:
    """A score table from its CSV file, see `score_table`."""
    table = pd.read_csv(path, keep_default_na=False, na_values=[""])
    return table.assign(reference=table["reference"].fillna("")) if "reference" in table else table


def by_chance(method: str) -> bool:
    """Whether a method draws at random, so that an evaluation tells its exact expectation."""
    known = find(method)
    return known is not None and known.by_chance


def is_probability(method: str) -> bool:
    """Whether a method's score is the probability that a view localizes."""
    known = find(method)
    return known is not None and known.probability


def choose(views: TestViews, scores: Mapping[str, Float], top_n: Sequence[int]) -> Choices:
    """Let every method choose N views of every location; see `score_table`, whose rows come in the same order."""
    choices: dict[tuple[str, int], TopN] = {}
    for method, values in scores.items():
        if by_chance(method):
            choices |= {(method, n): choose_at_random(views, n) for n in top_n}
        else:
            ranks = rank_views(views, values)
            choices |= {(method, n): choose_best(views, ranks, n) for n in top_n}
    return choices | {(ORACLE, n): choose_by_truth(views, n) for n in top_n}


def reference_method(methods: Iterable[str], name: str) -> str:
    """The method that the others are compared with: see `EvaluateConfig.reference`. "" if there is none.

    Raises a ConfigError if no method has that name.
    """
    methods = list(methods)
    if name and name not in methods:
        known = f"There are {', '.join(methods)}."
        raise ConfigError("the reference is none of the methods evaluated", value=name, fix=known)
    found = {other: find(other) for other in methods}
    ranks = {other: known.reference for other, known in found.items() if known is not None and known.probability}
    return name or max(ranks, key=lambda other: ranks[other], default="")


def score_table(
    views: TestViews,
    scores: Mapping[str, Float],
    scenes: Sequence[str],
    config: EvaluateConfig,
    temperatures: Mapping[str, float] | None = None,
    choices: Choices | None = None,
) -> pd.DataFrame:
    """Compare methods by their scores (B,) of views (paper, Sec. 4.1 and its tables 2 and 3).

    At every location the N views with the highest score are chosen, and the chosen views of all locations are pooled. A
    location with fewer than N views contributes what it has. The paper divides all shares by one constant, 0.527; here
    each is also divided by the oracle's at the same threshold, scenes and N.

    Choosing at random is not drawn but computed: its rows hold exact expectations. Its average precision and ROC AUC
    are those of one seeded draw.

    `scenes` are the names of the scenes by their number in `views`, `temperatures` those of learned methods as far as
    known (`wheretolook.evaluation.calibration`), `choices` what `choose` gives, if that is known already. A ConfigError
    is raised if the reference is none of the methods.

    One row for each method (and the oracle), N and scene, `scene` being "all" in rows over all scenes. Columns: method,
    top_n, scene, n_locations, n_views (chosen views), and for each threshold, such as "0.05m_0.4deg":

    - good_*: number of chosen views that are good.
    - raw_*: share of good views. normalized_*: divided by the oracle's share; NaN if that is 0. released_*: divided by
      `RELEASED_DIVISOR`, which can give more than 1.
    - any_*: share of locations with at least one good view.
    - regret_*: the oracle's raw share less the method's, at least 0.
    - difference_*: the method's raw share less the reference's (`EvaluateConfig.reference`), and p_*, the p-value of
      `ClusterBootstrap.paired_p`; NaN without a reference, p_* also for random choice, an expectation.
    - low_* and high_* of raw_, normalized_, any_, regret_ and difference_, such as raw_low_*: bootstrap interval over
      blocks of locations, paired where two methods meet (`ClusterBootstrap.ratio_interval`).

    Then reference (the method that differences are from, "" for none); average_precision and roc_auc of the scores
    against the first threshold, NaN where all views are of one class; and for learned methods, NaN for others, ece
    (expected calibration error, against the first threshold), ece_scaled (with logits divided by the temperature) and
    temperature, both NaN where it is not known. A scene without candidates has rows with 0 locations and NaN.
    """
    pools: list[tuple[str, NDArray[np.bool_]]] = [(ALL, np.ones(views.n_locations, dtype=bool))]
    if len(scenes) > 1:
        pools += [(name, views.location_scene == number) for number, name in enumerate(scenes)]
    else:
        pools += [(scenes[0], pools[0][1])]
    reference = reference_method(scores, config.reference)
    choices = choose(views, scores, config.top_n) if choices is None else choices
    rows: list[dict[str, object]] = []
    for name, locations in pools:
        inside = locations[views.location]
        block = np.arange(views.n_locations) if views.location_block is None else views.location_block
        scene = views.location_scene[locations]
        bootstrap = ClusterBootstrap(block[locations], config.resamples, config.seed, strata=scene)
        good = views.good[inside, 0]
        metrics = {ORACLE: {"average_precision": 1.0, "roc_auc": 1.0, **dict.fromkeys(_CALIBRATION, float("nan"))}}
        for method, values in scores.items():
            metrics[method] = _ranking_metrics(good, values[inside])
            metrics[method] |= _calibration_metrics(method, good, values[inside], (temperatures or {}).get(method))
        shares = {n: _shares(_only(choices, n, locations), reference, bootstrap, config) for n in config.top_n}
        for method in [*scores, ORACLE]:
            for n in config.top_n:
                row = {"method": method, "top_n": n, "scene": name}
                rows.append(row | shares[n][method] | {"reference": reference} | metrics[method])
    return pd.DataFrame(rows)


def _only(choices: Choices, n: int, locations: NDArray[np.bool_]) -> dict[str, TopN]:
    """What the methods choose for one N at some of the locations."""
    tops = {method: top for (method, number), top in choices.items() if number == n}
    return {name: TopN(t.chosen[locations], t.good[locations], t.any_good[locations]) for name, t in tops.items()}


def _shares(
    tops: Mapping[str, TopN], reference: str, bootstrap: ClusterBootstrap, config: EvaluateConfig
) -> dict[str, dict[str, float]]:
    """Columns of all methods for one N and one pool of locations; M methods are computed together."""
    good = np.stack([top.good for top in tops.values()], axis=1)  # (L, M, T)
    any_good = np.stack([top.any_good for top in tops.values()], axis=1)
    chosen = tops[ORACLE].chosen[:, None]  # (L, 1): every method chooses as many
    best = np.broadcast_to(tops[ORACLE].good[:, None], good.shape)
    n_locations = len(good)
    n_views = float(chosen.sum())
    columns = {"good": good.sum(0), "raw": divide(good.sum(0), n_views)}
    columns["raw_low"], columns["raw_high"] = _interval(bootstrap, good, chosen)
    columns["normalized"] = divide(good.sum(0), best.sum(0))
    columns["normalized_low"], columns["normalized_high"] = _interval(bootstrap, good, best)
    columns["any"] = divide(any_good.sum(0), n_locations)
    columns["any_low"], columns["any_high"] = _interval(bootstrap, any_good, np.ones((n_locations, 1)))
    columns["released"] = columns["raw"] / RELEASED_DIVISOR
    columns["regret"] = divide((best - good).sum(0), n_views)
    columns["regret_low"], columns["regret_high"] = _interval(bootstrap, best - good, chosen)
    if not reference:
        columns |= dict.fromkeys(_PAIRED, np.full(good.shape[1:], np.nan))
    else:
        difference = good - tops[reference].good[:, None]
        columns["difference"] = divide(difference.sum(0), n_views)
        columns["difference_low"], columns["difference_high"] = _interval(bootstrap, difference, chosen)
        columns["p"] = bootstrap.paired_p(_flat(difference)).reshape(good.shape[1:])
        expected = [by_chance(reference) or by_chance(method) for method in tops]
        columns["p"][expected] = np.nan  # an expectation is no draw
    keys = list(enumerate(map(threshold_key, config.thresholds)))
    return {
        method: {"n_locations": n_locations, "n_views": int(n_views)}
        | {f"{name}_{key}": float(values[row, index]) for index, key in keys for name, values in columns.items()}
        for row, method in enumerate(tops)
    }


def _flat(values: Float) -> Float:
    return values.reshape(len(values), values.shape[1] * values.shape[2])


def _interval(bootstrap: ClusterBootstrap, numerator: Float, denominator: Float) -> tuple[Float, Float]:
    """Interval of the ratio of sums over locations, (M, T) each end, of (L, M, T) and (L, M, T) or (L, 1)."""
    low, high = bootstrap.ratio_interval(_flat(numerator), denominator if denominator.ndim == 2 else _flat(denominator))
    return low.reshape(numerator.shape[1:]), high.reshape(numerator.shape[1:])


def _ranking_metrics(good: NDArray[np.bool_], scores: Float) -> dict[str, float]:
    from sklearn.metrics import average_precision_score, roc_auc_score  # takes a second, and reading a table needs none

    measures = {"average_precision": average_precision_score, "roc_auc": roc_auc_score}
    if good.all() or not good.any():
        return dict.fromkeys(measures, float("nan"))
    return {name: float(measure(good, scores)) for name, measure in measures.items()}


def _calibration_metrics(
    method: str, good: NDArray[np.bool_], scores: Float, temperature: float | None
) -> dict[str, float]:
    metrics = dict.fromkeys(_CALIBRATION, float("nan"))
    if is_probability(method):
        metrics["ece"] = expected_calibration_error(scores, good)
        if temperature is not None and np.isfinite(temperature):
            scaled = scale_probability(scores, temperature)
            metrics |= {"ece_scaled": expected_calibration_error(scaled, good), "temperature": temperature}
    return metrics
