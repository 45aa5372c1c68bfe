"""Format a score table as Markdown, also by occlusion model, by set of candidates, and as the paper divides it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from wheretolook.dataset.config import ALL, threshold_label
from wheretolook.dataset.viewpoint_table import FIRST, with_first_labels
from wheretolook.evaluation.results import (
    ORACLE,
    PHOTOGRAPHS,
    RELEASED_DIVISOR,
    main_rows,
    methods_of,
    reference_of,
    signed_points,
    threshold_keys,
)
from wheretolook.utils.texts import markdown_table
from wheretolook_paper.styles import method_group, method_style

Row = Mapping[Any, Any]  # a row of a score table by its columns' names

Column = tuple[str, str, Callable[[Row], str]]
"""Header of a Markdown table's column, the score table's column that it needs, and the text of a row."""

SCENES_ABREAST = 8  # scenes in one table; more make another below


def score_markdown(scores: pd.DataFrame, title: str = "Localization score") -> str:
    """Format a score table (`wheretolook.evaluation.results.score_table`) as Markdown.

    The rows are of the first occlusion model and set of candidates: the first N with all columns; other N; both
    localizers; the share of locations with a good view; by scene; held-out photographs; calibration; probes.
    """
    main = main_rows(scores)
    is_probe = main["method"].map(method_group) == "probes"
    methods = main[~is_probe]
    pooled = methods[methods["scene"] == ALL]
    keys = threshold_keys(scores)
    counts = list(pooled["top_n"].unique())
    first = pooled[pooled["top_n"] == counts[0]]
    parts = [f"# {title}", _about(main), _explained(first, keys[0])]
    for n in counts:
        rows = pooled[pooled["top_n"] == n]
        columns = _all_columns(first, keys) if n == counts[0] else _score_columns(keys, 1)
        header = f"## {best_views(n)} of each location ({rows['n_views'].iloc[0]:,} in all)"
        parts += [header, method_table(rows, columns)]
    parts += _first_table(pooled, keys[0], counts)
    parts += _any_table(pooled, keys[0], counts)
    parts += _scene_tables(methods, keys[0], counts[0])
    photographs = scores[(scores["candidates"] == PHOTOGRAPHS) & (main["candidates"].iloc[0] != PHOTOGRAPHS)]
    if len(photographs):
        rows = photographs[(photographs["scene"] == ALL) & (photographs["top_n"] == counts[0])]
        parts += ["## Photographs", f"{_about(photographs)} {best_views(counts[0])} of each."]
        parts += [method_table(rows, _all_columns(rows, keys)), *_scene_tables(photographs, keys[0], counts[0])]
    parts += _calibration(first)
    probes = main[is_probe & (main["scene"] == ALL) & (main["top_n"] == counts[0])]
    if len(probes):
        parts += [
            "## Probes",
            "Rows of the paper's table that are no methods: they look along the direction that a Fisher field says is "
            f"worst (least trace, or where the trace is stationary). {best_views(counts[0])} of each location.",
            method_table(probes, [*_score_columns(keys, 1), *_RANKING], "probe"),
        ]
    return "\n\n".join(parts) + "\n"


def _about(main: pd.DataFrame) -> str:
    n_locations = main.loc[main["scene"] == ALL, "n_locations"].iloc[0]
    text = f"Scenes: {', '.join(_scenes(main))}; {n_locations:,} locations"
    candidates = main["candidates"].iloc[0]
    if candidates == PHOTOGRAPHS:
        text += (
            "; views are photographs, held out of their maps in blocks and scored on the map without their block; a "
            "location is a place that photographs of a block share, of one or more"
        )
    elif candidates != ALL:
        text += f"; to choose from there are the {candidates} directions of a location by the landmarks they see"
    return f"{text}."


def _explained(first: pd.DataFrame, key: str) -> str:
    """Explain the numbers of the table, one line each."""
    limits = threshold_label(key)
    reference = reference_of(first)
    lines = [
        "score: share in % of the chosen viewpoints that localize within both limits, divided by the oracle's share "
        "[95 % bootstrap interval over locations, neighbours resampled together] (undivided). Random is an exact "
        "expectation, its AP and AUC are one draw.",
        f"regret: the oracle's undivided share within {limits} less the method's, in percentage points [interval]; "
        "lower is better.",
    ]
    if reference:
        lines.append(
            f"difference: the method's undivided share within {limits} less that of {method_style(reference).label}, "
            "in percentage points [interval, paired by location], and the p-value of a paired permutation test over "
            "neighbourhoods of locations (none for random's expectation)."
        )
    lines.append(f"AP, AUC: average precision and area under the ROC curve over all candidates, within {limits}.")
    return "\n".join(f"- {line}" for line in lines)


def _score_columns(keys: Sequence[str], n_intervals: int) -> list[Column]:
    """Scores at each threshold, the first few with their intervals."""
    return [
        (threshold_label(key), f"normalized_{key}", partial(score_text, key=key, interval=index < n_intervals))
        for index, key in enumerate(keys)
    ]


def _all_columns(first: pd.DataFrame, keys: Sequence[str]) -> list[Column]:
    key = keys[0]
    regret: Column = ("regret", f"regret_{key}", partial(share_text, name="regret", key=key))
    difference = partial(_difference_text, key=key, reference=reference_of(first))
    return [*_score_columns(keys, len(keys)), regret, ("difference", f"difference_{key}", difference), *_RANKING]


_RANKING: list[Column] = [
    ("AP", "average_precision", lambda row: number_text(row["average_precision"])),
    ("AUC", "roc_auc", lambda row: number_text(row["roc_auc"])),
]


def method_table(rows: pd.DataFrame, columns: Sequence[Column], first: str = "method") -> str:
    """Format a row for each method, without columns that are NaN throughout."""
    shown = [(header, text) for header, needs, text in columns if rows[needs].notna().any()]
    lines = [[method_style(row["method"]).label, *(text(row) for _, text in shown)] for row in rows.to_dict("records")]
    return markdown_table([first, *(header for header, _ in shown)], lines)


def cross_table(
    rows: pd.DataFrame, column: str, values: Iterable[Any], text: Callable[[Row], str], header: str = "{}"
) -> str:
    """Format a table of methods (rows) by values of a column; "–" where there is no row."""
    by_key = {(row["method"], row[column]): row for row in rows.to_dict("records")}
    lines = []
    for method in methods_of(rows):
        cells = [by_key.get((method, value)) for value in values]
        lines.append([method_style(method).label, *("–" if cell is None else text(cell) for cell in cells)])
    return markdown_table(["method", *(header.format(value) for value in values)], lines)


def _first_table(pooled: pd.DataFrame, key: str, counts: Sequence[int]) -> list[str]:
    """Shares of the chosen views by both localizers, if their labels are known."""
    if f"{FIRST}raw_{key}" not in pooled or pooled[f"{FIRST}raw_{key}"].isna().all():
        return []
    names = {n: f"best {n}" for n in counts}
    rows = pooled.assign(by=pooled["top_n"].map(names))
    rows = pd.concat([rows, with_first_labels(rows.assign(by=rows["by"] + ", first"))])
    columns = [f"{name}{suffix}" for name in names.values() for suffix in ("", ", first")]
    about = (
        f"Share in % of the chosen viewpoints that localize within {threshold_label(key)} by the best of several "
        "hypotheses, as in all other tables, and by the first RANSAC result."
    )
    return ["## Both localizers", about, cross_table(rows, "by", columns, partial(share_text, name="raw", key=key))]


def _any_table(pooled: pd.DataFrame, key: str, counts: Sequence[int]) -> list[str]:
    """The share of locations where at least one of the chosen views is good; of one view that is its score."""
    if max(counts) == 1:
        return []
    return [
        "## At least one good",
        f"Share in % of locations where at least one of the N chosen viewpoints localizes within "
        f"{threshold_label(key)}; the oracle's is that of locations that have such a viewpoint.",
        cross_table(pooled, "top_n", counts, partial(share_text, name="any", key=key), "best {}"),
    ]


def _scene_tables(methods: pd.DataFrame, key: str, n: int) -> list[str]:
    scenes = _scenes(methods)
    if len(scenes) < 2:
        return []
    rows = methods[methods["top_n"] == n]
    parts = [
        f"## By scene: {best_views(n).lower()} of each location, within {threshold_label(key)}",
        "Score [interval], good of chosen viewpoints.",
    ]
    for begin in range(0, len(scenes), SCENES_ABREAST):
        some = scenes[begin : begin + SCENES_ABREAST]
        parts.append(cross_table(rows, "scene", some, partial(_counted_text, key=key)))
    return parts


def _scenes(rows: pd.DataFrame) -> list[str]:
    return [name for name in rows["scene"].unique() if name != ALL]


def _calibration(first: pd.DataFrame) -> list[str]:
    lines = []
    for row in first[first["ece"].notna()].to_dict("records"):
        text = f"- {method_style(row['method']).label}: {number_text(row['ece'])}"
        if pd.notna(row["temperature"]):
            text += f" → {number_text(row['ece_scaled'])} with T = {row['temperature']:.2f}"
        lines.append(text)
    about = (
        "Expected calibration error of the predicted probabilities, before → after their logits are divided by a "
        "temperature T, which keeps their order."
    )
    return ["## Calibration", about, "\n".join(lines)] if lines else []


def best_views(n: int) -> str:
    """Name the n best viewpoints of a location."""
    return "Best viewpoint" if n == 1 else f"Best {n} viewpoints"


def score_text(row: Row, key: str, interval: bool) -> str:
    """Format the share divided by the oracle's, in %, and the undivided share."""
    text = share_text(row, "normalized", key) if interval else _percent(row[f"normalized_{key}"])
    return f"{text} ({_percent(row[f'raw_{key}'])})"


def share_text(row: Row, name: str, key: str) -> str:
    """Format a share in % with its interval."""
    return _percent(row[f"{name}_{key}"]) + _ends(row, name, key)


def _difference_text(row: Row, key: str, reference: str) -> str:
    if row["method"] == reference:
        return "reference"
    if pd.isna(row[f"difference_{key}"]):
        return "–"
    text = f"{signed_points(row[f'difference_{key}'])}{_ends(row, 'difference', key)}"
    p = row[f"p_{key}"]
    return text if pd.isna(p) else f"{text}, p {'< 0.001' if p < 0.001 else f'{p:.3f}'}"


def _counted_text(row: Row, key: str) -> str:
    """Score of a scene with the numbers behind it; an expected number has a decimal place."""
    text = share_text(row, "normalized", key)
    if pd.isna(row[f"raw_{key}"]):
        return text
    good = row[f"raw_{key}"] * row["n_views"]
    digits = 0 if abs(good - round(good)) < 1e-6 else 1
    return f"{text}, {good:,.{digits}f} of {row['n_views']:,}"


def _ends(row: Row, name: str, key: str) -> str:
    """Interval of a share with a leading space; "" where it is unknown or has no width."""
    low, high = (row.get(f"{name}_{end}_{key}", np.nan) for end in ("low", "high"))  # the paper's shares have none
    as_text = signed_points if name == "difference" else _percent
    return f" [{as_text(low)}, {as_text(high)}]" if pd.notna(low) and low < high else ""


def _percent(value: float) -> str:
    return "–" if pd.isna(value) else f"{100 * value:.1f}"


def number_text(value: float) -> str:
    """Format a metric in [0, 1]."""
    return "–" if pd.isna(value) else f"{value:.3f}"


_CANDIDATES = (
    "To choose from there are all labelled directions of a location, or those of them that are among its best K by the "
    "number of landmarks they see; the oracle chooses from the same. "
)


def comparisons_markdown(scores: pd.DataFrame) -> str:
    """Format the sections "By occlusion model", "By set of candidates" and "Divided by 0.527" of a score table."""
    if "candidates" in scores and not (scores["candidates"] == PHOTOGRAPHS).all():
        scores = scores[scores["candidates"] != PHOTOGRAPHS]
    parts = _comparison(scores, "occlusion", "occlusion model", "")
    parts += _comparison(scores, "candidates", "set of candidates", _CANDIDATES)
    parts += _released_table(scores)
    return "".join(f"{part}\n\n" for part in parts)


def _comparison(scores: pd.DataFrame, column: str, name: str, about: str) -> list[str]:
    """Format average precision and score of every method by the values of a column; empty if it has one value."""
    values = list(scores[column].unique()) if column in scores else []
    if len(values) < 2:
        return []
    key = threshold_keys(scores)[0]
    n = scores["top_n"].iloc[0]
    others = [other for other in ("occlusion", "candidates") if other != column]
    rows = main_rows(scores[(scores["scene"] == ALL) & (scores["top_n"] == n)], others)
    rows = rows[(rows["method"] != ORACLE) & (rows["method"].map(method_group) != "probes")]

    def cell(row: Row) -> str:
        return f"{number_text(row['average_precision'])}, {score_text(row, key, True)}"

    return [
        f"## By {name}: AP, and {best_views(n).lower()} of each location within {threshold_label(key)}",
        f"{about}The other tables are of the first, {values[0]}.",
        cross_table(rows, column, values, cell),
    ]


def _released_table(scores: pd.DataFrame) -> list[str]:
    main = main_rows(scores)
    keys = threshold_keys(scores)
    if f"released_{keys[0]}" not in main:
        return []
    n = main["top_n"].iloc[0]
    rows = main[(main["scene"] == ALL) & (main["top_n"] == n) & (main["method"].map(method_group) != "probes")]
    columns = [(threshold_label(key), f"released_{key}", partial(share_text, name="released", key=key)) for key in keys]
    return [
        f"## Divided by {RELEASED_DIVISOR}",
        f"{best_views(n)} of each location, for comparison with the paper's numbers only: its released code divides "
        f"the share in % by {RELEASED_DIVISOR} at all thresholds and on all scenes, so 100 is no limit.",
        method_table(rows, columns),
    ]
