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
NaN."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wheretolook.dataset.config import ALL, threshold_key, threshold_label
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.viewpoint_table import FIRST
from wheretolook.evaluation.config import SCORES_CSV, EvaluateConfig
from wheretolook.evaluation.ranking import (
    TopN,
    choose_at_random,
    choose_best,
    choose_oracle,
    first_of_locations,
    n_locations,
    rank_views,
)
from wheretolook.evaluation.statistics import ClusterBootstrap, divide, expected_calibration_error, scale_probability
from wheretolook.geometry.poses import Float
from wheretolook.geometry.views import Views
from wheretolook.scorers.random import RandomScorer
from wheretolook.scorers.registry import is_probability
from wheretolook.tracking import (
    ALL_METHODS,
    AUC,
    BEST_TAG,
    FINGERPRINT_TAG,
    REGRET,
    SHARE,
    NestedRun,
    TrackingConfig,
    artifact,
    fingerprint_of,
    joined,
    log,
    log_nested,
    logged_last,
    newest_run,
    start_run,
)
from wheretolook.utils.errors import check_choice
from wheretolook.utils.files import fingerprint, temporary_folder
from wheretolook.visibility.config import OcclusionConfig

ORACLE = "oracle"  # the best views by their labels, as a method of tables

PHOTOGRAPHS = "photographs"  # value of the column `candidates` in rows of held-out photographs

RELEASED_DIVISOR = 0.527
"""Divisor of every share in the paper's released code, whatever the threshold, the scenes and N."""

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
    return method.partition(" ")[0] == RandomScorer.name


def best_in_words(scores: pd.DataFrame) -> str:
    """Name the methods that chose good views most often, and state whether the first two differ significantly.

    Uses the first N, threshold, occlusion model and set of candidates of a score table.
    """
    main = main_rows(scores)
    key = threshold_keys(scores)[0]
    pooled = main[(main["scene"] == ALL) & (main["top_n"] == main["top_n"].iloc[0])]
    rows: dict[str, Mapping[str, Any]] = {row["method"]: row for row in pooled.to_dict("records")}
    methods = [name for name in rows if name != ORACLE]
    ranked = [name for name in methods if not is_random(name)]
    ranked.sort(key=lambda name: -rows[name][f"raw_{key}"])
    n_views, n_locations = (int(rows[ORACLE][name]) for name in ("n_views", "n_locations"))

    def times(name: str) -> str:
        return f"{name} {rows[name][f'raw_{key}'] * n_views:.1f}".removesuffix(".0")

    others = [*ranked[1:2], *(name for name in methods if is_random(name)), ORACLE]
    text = f"Views that localize within {threshold_label(key)}, among {n_views} chosen at {n_locations} locations: "
    text += f"{'; '.join(map(times, [ranked[0], *others]))}."
    return f"{text} {_significance_sentence(rows[ranked[0]], rows[ranked[1]], key)}" if len(ranked) > 1 else text


def _significance_sentence(first: Mapping[str, Any], second: Mapping[str, Any], key: str) -> str:
    """State whether the first of two rows is significantly better.

    Decided by the interval of their difference where one is the reference, else by whether their intervals overlap.
    """
    names = (first["method"], second["method"])
    if first["reference"] in names:
        row, sign = (second, -1) if first["reference"] == names[0] else (first, 1)
        low, high = sorted(sign * row[f"difference_{end}_{key}"] for end in ("low", "high"))
        why = f"the 95 % interval of their difference is {signed_points(low)} to {signed_points(high)} points"
    else:
        low = first[f"raw_low_{key}"] - second[f"raw_high_{key}"]
        high = low
        why = f"their 95 % intervals {'do not overlap' if low > 0 else 'overlap'}"
    if pd.isna(low) or pd.isna(high):
        why = "there are too few for an interval"
    if low > 0:
        return f"The first is significantly better than the second: {why}."
    return f"By {first['n_locations']} locations the first two do not differ significantly: {why}."


def signed_points(value: float) -> str:
    """Format a difference of shares in percentage points, with its sign."""
    return f"{round(100 * value, 1) + 0.0:+.1f}"  # + 0.0 makes -0.0 positive


def choose(views: Views, scores: Mapping[str, Float], top_n: Sequence[int]) -> Choices:
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
    learned = [method for method in methods if is_probability(method)]
    for preferred in ("set", "mlp-2d+3d"):
        for method in learned:
            if method.partition(" ")[0] == preferred:
                return method
    return learned[0] if learned else ""


def score_table(
    views: Views,
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
        temperatures: of learned methods, where known (`wheretolook.evaluation.statistics`).
        choices: result of `choose`, if known already.

    Returns:
        The table, with the columns that this module lists.

    Raises:
        ConfigError: the reference is none of the methods.
    """
    places = first_of_locations(views)
    pools = [(ALL, np.ones(len(places), dtype=bool))]
    pools += [(name, places.scene == number) for number, name in enumerate(scenes)]
    reference = reference_method(scores, config.reference)
    choices = choose(views, scores, config.top_n) if choices is None else choices
    rows: list[dict[str, object]] = []
    for name, locations in pools:
        inside = locations[views.waypoint]
        strata = places.scene[locations]
        bootstrap = ClusterBootstrap(places.block[locations], config.resamples, config.seed, strata)
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
        for name in ("difference", "difference_low", "difference_high", "p"):
            columns[name] = np.full(good.shape[1:], np.nan)
    else:
        difference = good - tops[reference].good[:, None]
        add("difference", difference, chosen)
        columns["p"] = bootstrap.paired_p(difference)
        expected = [is_random(reference) or is_random(method) for method in tops]
        columns["p"][expected] = np.nan  # the test does not apply to expectations
    keys = [threshold_key(limits) for limits in config.thresholds]
    ends = [("", key) for key in keys] + [(FIRST, key) for key in keys]
    rows: dict[str, dict[str, float]] = {}
    for row, method in enumerate(tops):
        rows[method] = {"n_locations": len(good), "n_views": int(chosen.sum())}
        for index, (prefix, key) in enumerate(ends[: good.shape[2]]):
            for name, values in columns.items():
                rows[method][f"{prefix}{name}_{key}"] = float(values[row, index])
    return rows


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


@dataclass(frozen=True, eq=False)
class ScoredSet:
    """Scores, choices and score table of one candidate set by one occlusion model."""

    views: Views
    scores: Mapping[str, Float]  # (B,) by method
    choices: Choices
    table: pd.DataFrame  # with columns `occlusion` and `candidates`
    scenes: Sequence[SceneFolder]  # by their numbers in the views


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Result of comparing methods on the scenes of a split."""

    scenes: Sequence[SceneFolder]
    weights: Mapping[Path, str]  # files of weights, and the method that each serves
    views: Views  # all labelled views
    scored: Sequence[ScoredSet]  # for each occlusion model and candidate set
    table: pd.DataFrame  # their score tables, one below the other
    calibration: pd.DataFrame  # reliability curves of learned methods, see `calibration_rows`; empty without any


def evaluation_params(dataset: Dataset, scenes: Sequence[SceneFolder], weights: Iterable[Path]) -> dict[str, Any]:
    """Return the parameters of an evaluation's run that identify its scenes and weights."""
    return {
        "dataset": dataset.name,
        "dataset_fingerprint": Dataset(dataset.root, tuple(scenes)).fingerprint(),
        "scenes": " ".join(scene.name for scene in scenes),
        "weights": " ".join(f"{path.stem}:{fingerprint(path)}" for path in weights),
    }


def runs_of_rows(table: pd.DataFrame, params: Mapping[str, Any]) -> Iterator[NestedRun]:
    """Yield a nested run for each method, occlusion model and candidate set of joined score tables.

    Metrics are those of `first_metrics`, those of all views by their columns, and the others by N, the scene unless it
    is all of them, and the column, such as `top-5/any_5m_10deg`, `top-1/first_raw_0.05m_0.4deg` (by the first RANSAC
    result) and `top-1/apartment-210/regret_0.05m_0.4deg`.
    """
    keys = threshold_keys(table)
    of_pooled = [f"{name}_{key}" for key in keys for name in ("raw", "any", "normalized", "regret")]
    # not all columns, as each metric costs MLflow 0.3 ms; `scores.csv`, an artifact, has them
    strictest = ("regret_low", "regret_high", "difference", "difference_low", "difference_high", "p")
    of_pooled += [f"{name}_{keys[0]}" for name in strictest]
    of_pooled += [FIRST + name for name in of_pooled if FIRST + name in table]
    names = ["method", "occlusion", "candidates"]
    for key, rows in table.groupby(names, sort=False):
        own = dict(zip(names, map(str, key), strict=True))
        pooled = rows[rows["scene"] == ALL]
        metrics = first_metrics(pooled)
        for name in ("n_locations", "average_precision", "roc_auc", "ece", "ece_scaled", "temperature"):
            metrics[name] = float(pooled[name].iloc[0])  # the same for every N
        metrics |= _metrics_by_n(pooled, of_pooled) | _metrics_by_n(rows[rows["scene"] != ALL], [f"regret_{keys[0]}"])
        candidates = own["candidates"] if own["candidates"] != ALL else ""
        yield NestedRun(joined(own["method"], own["occlusion"], candidates), {**params, **own}, metrics)


def _metrics_by_n(rows: pd.DataFrame, columns: Iterable[str]) -> dict[str, float]:
    metrics: dict[str, float] = {}
    for row in rows.to_dict("records"):
        prefix = f"top-{row['top_n']}" + ("" if row["scene"] == ALL else f"/{row['scene']}")
        metrics |= {f"{prefix}/{name}": float(row[name]) for name in columns}
    return metrics


def first_metrics(rows: pd.DataFrame) -> dict[str, float]:
    """Return the metrics to sort runs by: of one method's first choice over all scenes, at the first threshold."""
    strictest = threshold_keys(rows)[0]
    first = rows[(rows["scene"] == ALL) & (rows["top_n"] == rows["top_n"].min())].iloc[0]
    columns = {REGRET: f"regret_{strictest}", SHARE: f"raw_{strictest}", AUC: "roc_auc"}
    return {name: float(first[column]) for name, column in columns.items()}


def best_of(table: pd.DataFrame) -> tuple[dict[str, str], dict[str, float]]:
    """Return the method with the least regret in the main rows, as a tag, and its `first_metrics`; empty if none.

    Random choice and the oracle do not count.
    """
    main = main_rows(table)
    methods = [name for name in methods_of(main) if name != ORACLE and not is_random(name)]
    metrics = {name: first_metrics(main[main["method"] == name]) for name in methods}
    if not metrics:
        return {}, {}
    best = min(metrics, key=lambda name: metrics[name][REGRET])
    return {BEST_TAG: best}, metrics[best]


def _runs_with_locations(
    scored: Sequence[ScoredSet], params: Mapping[str, Any], config: EvaluateConfig, file: Path
) -> Iterator[NestedRun]:
    """Yield the runs of `runs_of_rows`, each with its `location_table` in the same `file`."""
    for one in scored:
        for nested in runs_of_rows(one.table, params):
            tables = [location_table(one, nested.params["method"], n, config) for n in config.top_n]
            pd.concat(tables).to_parquet(file, index=False)
            yield replace(nested, files=(file,))


def location_table(scored: ScoredSet, method: str, n: int, config: EvaluateConfig) -> pd.DataFrame:
    """Return a method's choice at each location, one row each.

    Columns: scene, location_id, top_n, chosen (views), for each threshold good_* (number of good ones) and any_*
    (whether one is; both are expectations for random choice), and best_score, the score of the first choice; NaN for
    random choice and the oracle.
    """
    places = first_of_locations(scored.views)
    top = scored.choices[method, n]
    names = [scored.scenes[number].name for number in places.scene]
    table = pd.DataFrame({"scene": names, "location_id": places.location_id, "top_n": n})
    table["chosen"] = top.chosen.astype(np.int64)
    for index, key in enumerate(map(threshold_key, config.thresholds)):
        table[f"good_{key}"] = top.good[:, index]
        table[f"any_{key}"] = top.any_good[:, index]
    best = np.full(len(places), np.nan)
    if method in scored.scores and not is_random(method):
        np.fmax.at(best, scored.views.waypoint, scored.scores[method])
    return table.assign(best_score=best)


def log_evaluation(
    dataset: Dataset,
    evaluation: Evaluation,
    config: EvaluateConfig,
    tracking: TrackingConfig,
    occlusion: OcclusionConfig,
    results: Path,
) -> None:
    """Log an evaluation as a run with the files in the folder `results`, and nested runs (`runs_of_rows`).

    Settings of occlusion models are logged if the configuration names any. Nothing is logged if the newest evaluation
    of the dataset had the same parameters and results.
    """
    views = evaluation.views
    params = evaluation_params(dataset, evaluation.scenes, evaluation.weights)
    params |= {name: value for name, value in asdict(config).items() if name not in ("weights", "methods")}
    params = {name: value for name, value in params.items() if value or name not in ("anywhere", "photographs")}
    if config.occlusions:
        params |= {f"occlusion_{name}": value for name, value in asdict(occlusion).items() if name != "model"}
    mark = fingerprint_of(params, evaluation.table.to_csv(index=False), evaluation.calibration.to_csv(index=False))
    if logged_last(tracking, "evaluate", dataset.name, mark, SCORES_CSV) is not None:
        return
    best, metrics = best_of(evaluation.table)
    metrics |= {"n_locations": n_locations(views), "n_views": len(views), "positives": views.good[:, 0].mean()}
    tags = {"dataset": dataset.name, FINGERPRINT_TAG: mark, **best}
    with temporary_folder() as folder, start_run(tracking, ALL_METHODS, "evaluate", params, tags=tags) as (client, run):
        # others are left by a killed process
        files = (file for file in results.iterdir() if file.is_file() and file.suffix != ".partial")
        log(client, run, metrics=metrics, files=files)
        nested = _runs_with_locations(evaluation.scored, params, config, folder / "locations.parquet")
        log_nested(tracking, run, "evaluate", nested)


def latest_scores(tracking: TrackingConfig, dataset: str | None = None) -> pd.DataFrame | None:
    """Return the score table of the newest evaluation in a store, of one dataset or any; None if there is none."""
    run = newest_run(tracking, "evaluate", {"dataset": dataset} if dataset else None)
    if run is None:
        return None
    return read_scores(artifact(tracking, run.info.run_id, SCORES_CSV))
