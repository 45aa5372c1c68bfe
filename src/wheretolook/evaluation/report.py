"""The score table for people, in Markdown."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import pandas as pd

from wheretolook.dataset.thresholds import ALL, threshold_label
from wheretolook.evaluation.score_table import PHOTOGRAPHS, main_rows, methods_of, reference_of, threshold_keys
from wheretolook.evaluation.scores import RELEASED_DIVISOR, by_chance
from wheretolook.scorers.styles import ORACLE, method_group, method_style
from wheretolook.utils.markdown import markdown_table

Row = Mapping[Any, Any]  # a row of a score table by its columns' names

Column = tuple[str, str, Callable[[Row], str]]
"""Header of a Markdown table's column, the score table's column that it needs, and the text of a row."""

SCENES_ABREAST = 8  # scenes in one table; more make another below


def score_markdown(scores: pd.DataFrame, title: str = "Localization score") -> str:
    """A table of `wheretolook.evaluation.scores.score_table` in Markdown, with `occlusion` and `candidates` or without.

    The first N with all that is known; other N; the share of locations with a good view; by scene; by occlusion model
    and by set of candidates if there are several (the tables above are of the first); shares divided by the released
    code's constant; calibration; probes apart. What an older table lacks is left out.
    """
    main = main_rows(scores)
    of_photographs = _of_photographs(scores)
    if len(main) and not of_photographs.all():
        scores, photographs = scores[~of_photographs], scores[of_photographs]
    else:
        photographs = scores.iloc[:0]
    probe = main["method"].map(method_group) == "probes"
    methods = main[~probe]
    probes = main[probe]
    pooled = methods[methods["scene"] == ALL]
    keys = threshold_keys(scores)
    counts = list(pooled["top_n"].unique())
    first = pooled[pooled["top_n"] == counts[0]]
    parts = [f"# {title}", _about(main), *_explained(first, keys[0])]
    most = [*_score_columns(keys, len(keys)), *_certainty_columns(first, keys[0]), *_RANKING]
    for n in counts:
        rows = pooled[pooled["top_n"] == n]
        parts += [f"## {_best(n)} of each location ({rows['n_views'].iloc[0]:,} in all)"]
        parts += [_table(rows, most if n == counts[0] else _score_columns(keys, 1))]
    parts += _any_table(pooled, keys[0], counts)
    parts += _scene_tables(methods, keys[0], counts[0])
    parts += _comparison(scores, "occlusion", "occlusion model", "", keys[0])
    parts += _comparison(scores, "candidates", "set of candidates", _CANDIDATES, keys[0])
    parts += _photographs(photographs, keys, counts[0])
    parts += _released_table(first, keys)
    parts += _calibration(first)
    if len(probes):
        rows = probes[(probes["scene"] == ALL) & (probes["top_n"] == counts[0])]
        parts += [
            "## Probes",
            "Rows of the paper's table that are no methods: they look along the direction that a Fisher field says is "
            f"worst (least trace, or where the trace is stationary). {_best(counts[0])} of each location.",
            _table(rows, [*_score_columns(keys, 1), *_RANKING], "probe"),
        ]
    return "\n\n".join(parts) + "\n"


def _of_photographs(scores: pd.DataFrame) -> pd.Series[bool]:
    return scores["candidates"] == PHOTOGRAPHS if "candidates" in scores else pd.Series(False, index=scores.index)


def _photographs(rows: pd.DataFrame, keys: Sequence[str], n: int) -> list[str]:
    """The table of photographs where there are rendered views before them."""
    if rows.empty:
        return []
    first = rows[(rows["scene"] == ALL) & (rows["top_n"] == n)]
    columns = [*_score_columns(keys, len(keys)), *_certainty_columns(first, keys[0]), *_RANKING]
    return [
        "## Photographs",
        f"{_about(rows)} {_best(n)} of each.",
        _table(first, columns),
        *_scene_tables(rows, keys[0], n),
    ]


def best_in_words(scores: pd.DataFrame) -> str:
    """Which method chose good views most often, and whether the intervals tell it from the next, in two sentences.

    By the first N, threshold, occlusion model and set of candidates of a score table. Two methods are told apart by the
    interval of their difference where one is the reference, else by whether the intervals of their shares overlap.
    """
    main = main_rows(scores)
    key = threshold_keys(scores)[0]
    pooled = main[(main["scene"] == ALL) & (main["top_n"] == main["top_n"].iloc[0])]
    rows: dict[str, Row] = {row["method"]: row for row in pooled.to_dict("records")}
    methods = [name for name in rows if name != ORACLE and method_group(name) != "probes"]
    ranked = [name for name in methods if not by_chance(name)]
    ranked.sort(key=lambda name: -rows[name][f"raw_{key}"])  # of equals the first in the table
    n_views, n_locations, n = (int(rows[ORACLE][name]) for name in ("n_views", "n_locations", "top_n"))
    at = "at " if n == 1 else ""
    of = (
        f" of {n_locations} locations"
        if n == 1
        else f" of {n_views} times ({n} views at each of {n_locations} locations)"
    )

    def times(name: str) -> str:
        return at + f"{rows[name][f'raw_{key}'] * n_views:.1f}".removesuffix(".0")

    others = [*ranked[1:2], *(name for name in methods if by_chance(name))]
    told = [f"{method_style(name).label} {times(name)}" for name in others]
    best = method_style(ranked[0]).label
    text = (
        f"{best[:1].upper()}{best[1:]} chose a view that localizes within {threshold_label(key)} {times(ranked[0])}{of}"
    )
    text += f"; {', '.join([*told, f'and the oracle, which knows, {times(ORACLE)}'])}."
    return f"{text} {_told_apart(rows[ranked[0]], rows[ranked[1]], key)}" if len(ranked) > 1 else text


def _told_apart(first: Row, second: Row, key: str) -> str:
    """Whether the intervals of two rows, of which the first has the higher share, tell them apart, in a sentence."""
    names = (first["method"], second["method"])
    n_locations = first["n_locations"]
    reference = first.get("reference", "")
    if reference in names:
        row, sign = (second, -1) if reference == names[0] else (first, 1)
        low, high = sorted(sign * row[f"difference_{end}_{key}"] for end in ("low", "high"))
        why = f"the 95 % interval of their difference is {_signed(low)} to {_signed(high)} points"
        apart = low > 0
        if low == high == 0:
            return "The first two chose equally well everywhere."
    else:
        low = first[f"raw_low_{key}"]
        high = second[f"raw_high_{key}"]
        apart = low > high
        ends = [_ends(row, "raw", key).strip() for row in (first, second)]
        why = f"the 95 % intervals of their shares {'do not overlap' if apart else 'overlap'}, {' and '.join(ends)}"
    if pd.isna(low) or pd.isna(high):
        why = "there are too few for an interval"
    if apart:
        return f"The first is better than the second by more than chance: {why}."
    return f"By {n_locations} locations it cannot be told which of the first two is better: {why}."


def _about(main: pd.DataFrame) -> str:
    scenes = [name for name in main["scene"].unique() if name != ALL]
    n_locations = main.loc[main["scene"] == ALL, "n_locations"].iloc[0]
    text = f"Scenes: {', '.join(scenes)}; {n_locations:,} locations"
    candidates = main["candidates"].iloc[0] if "candidates" in main else ALL
    if candidates == PHOTOGRAPHS:
        text += (
            "; views are photographs, left out of their maps in blocks and scored on the map without their block; a "
            "location is a place that photographs of a block share, of one or more"
        )
    elif candidates != ALL:
        text += f"; to choose from there are the {candidates} directions of a location by the landmarks they see"
    return f"{text}."


def _explained(first: pd.DataFrame, key: str) -> list[str]:
    """What the numbers mean, one line for each that is there."""
    limits = threshold_label(key)
    reference = reference_of(first)
    lines = [
        "score: share in % of the chosen viewpoints that localize within both limits, divided by the oracle's share "
        "[95 % bootstrap interval over locations, neighbours resampled together] (undivided). Random is an exact "
        "expectation, its AP and AUC are one draw."
    ]
    if f"regret_{key}" in first:
        lines.append(
            f"regret: the oracle's undivided share within {limits} less the method's, in percentage points [interval]; "
            "lower is better."
        )
    if reference:
        lines.append(
            f"difference: the method's undivided share within {limits} less that of {method_style(reference).label}, "
            "in percentage points [interval, paired by location], and the p-value of a paired permutation test over "
            "neighbourhoods of locations (none for random's expectation)."
        )
    lines.append(f"AP, AUC: average precision and area under the ROC curve over all candidates, within {limits}.")
    return ["\n".join(f"- {line}" for line in lines)]


def _score_columns(keys: Sequence[str], n_intervals: int) -> list[Column]:
    """Scores at each threshold, the first few with their intervals."""
    return [
        (threshold_label(key), f"normalized_{key}", partial(_score, key=key, interval=index < n_intervals))
        for index, key in enumerate(keys)
    ]


def _certainty_columns(first: pd.DataFrame, key: str) -> list[Column]:
    difference = partial(_difference, key=key, reference=reference_of(first))
    return [
        ("regret", f"regret_{key}", partial(_with_ends, name="regret", key=key)),
        ("difference", f"difference_{key}", difference),
    ]


_RANKING: list[Column] = [
    ("AP", "average_precision", lambda row: _number(row["average_precision"])),
    ("AUC", "roc_auc", lambda row: _number(row["roc_auc"])),
]


def _table(rows: pd.DataFrame, columns: Sequence[Column], first: str = "method") -> str:
    """A row for each method; columns of which nothing is known are left out."""
    shown = [(header, text) for header, needs, text in columns if needs in rows and rows[needs].notna().any()]
    lines = [[method_style(row["method"]).label, *(text(row) for _, text in shown)] for row in rows.to_dict("records")]
    return markdown_table([first, *(header for header, _ in shown)], lines)


def _any_table(pooled: pd.DataFrame, key: str, counts: Sequence[int]) -> list[str]:
    """The share of locations where at least one of the chosen views is good; of one view that is its score."""
    if max(counts) == 1:
        return []
    by_key = {(row["method"], row["top_n"]): row for row in pooled.to_dict("records")}
    lines = [
        [method_style(method).label, *(_with_ends(by_key[method, n], "any", key) for n in counts)]
        for method in methods_of(pooled)
    ]
    return [
        "## At least one good",
        f"Share in % of locations where at least one of the N chosen viewpoints localizes within "
        f"{threshold_label(key)}; the oracle's is that of locations that have such a viewpoint.",
        markdown_table(["method", *(f"best {n}" for n in counts)], lines),
    ]


def _scene_tables(methods: pd.DataFrame, key: str, n: int) -> list[str]:
    scenes = [name for name in methods["scene"].unique() if name != ALL]
    if len(scenes) < 2:
        return []
    rows = methods[methods["top_n"] == n]
    by_key = {(row["scene"], row["method"]): row for row in rows.to_dict("records")}
    parts = [
        f"## By scene: {_best(n).lower()} of each location, within {threshold_label(key)}",
        "Score [interval], good of chosen viewpoints.",
    ]
    for begin in range(0, len(scenes), SCENES_ABREAST):
        some = scenes[begin : begin + SCENES_ABREAST]
        lines = [
            [method_style(method).label, *(_counted(by_key[scene, method], key) for scene in some)]
            for method in methods_of(rows)
        ]
        parts.append(markdown_table(["method", *some], lines))
    return parts


_CANDIDATES = (
    "To choose from there are all labelled directions of a location, or those of them that are among its best K by the "
    "number of landmarks they see; the oracle chooses from the same. "
)


def _comparison(scores: pd.DataFrame, column: str, name: str, about: str, key: str) -> list[str]:
    """Average precision and the score of every method by the values of a column, if there are several."""
    values = list(scores[column].unique()) if column in scores else []
    if len(values) < 2:
        return []
    n = scores["top_n"].iloc[0]
    others = [name for name in ("occlusion", "candidates") if name != column]
    rows = main_rows(scores[(scores["scene"] == ALL) & (scores["top_n"] == n)], others)
    rows = rows[(rows["method"] != ORACLE) & (rows["method"].map(method_group) != "probes")]
    by_key = {(row["method"], row[column]): row for row in rows.to_dict("records")}

    def cell(row: Row | None) -> str:
        return "–" if row is None else f"{_number(row['average_precision'])}, {_score(row, key, True)}"

    lines = [
        [method_style(method).label, *(cell(by_key.get((method, value))) for value in values)]
        for method in methods_of(rows)
    ]
    return [
        f"## By {name}: AP, and {_best(n).lower()} of each location within {threshold_label(key)}",
        f"{about}The other tables are of the first, {values[0]}.",
        markdown_table(["method", *values], lines),
    ]


def _released_table(first: pd.DataFrame, keys: Sequence[str]) -> list[str]:
    if f"released_{keys[0]}" not in first:
        return []
    columns: list[Column] = [
        (threshold_label(key), f"released_{key}", partial(_with_ends, name="released", key=key)) for key in keys
    ]
    return [
        f"## Divided by {RELEASED_DIVISOR}",
        f"{_best(first['top_n'].iloc[0])} of each location, for comparison with the paper's numbers only: its released "
        f"code divides the share in % by {RELEASED_DIVISOR} at all thresholds and on all scenes, so 100 is no limit.",
        _table(first, columns),
    ]


def _calibration(first: pd.DataFrame) -> list[str]:
    if "ece" not in first or not first["ece"].notna().any():
        return []
    lines = []
    for row in first[first["ece"].notna()].to_dict("records"):
        text = f"- {method_style(row['method']).label}: {_number(row['ece'])}"
        if pd.notna(row["temperature"]):
            text += f" → {_number(row['ece_scaled'])} with T = {row['temperature']:.2f}"
        lines.append(text)
    return [
        "## Calibration",
        "Expected calibration error of the predicted probabilities, before → after their logits are divided by a "
        "temperature T, which keeps their order.",
        "\n".join(lines),
    ]


def _best(n: int) -> str:
    return "Best viewpoint" if n == 1 else f"Best {n} viewpoints"


def _score(row: Row, key: str, interval: bool) -> str:
    text = _with_ends(row, "normalized", key) if interval else _percent(row[f"normalized_{key}"])
    return f"{text} ({_percent(row[f'raw_{key}'])})" if f"raw_{key}" in row else text


def _difference(row: Row, key: str, reference: str) -> str:
    if row["method"] == reference:
        return "reference"
    if pd.isna(row[f"difference_{key}"]):
        return "–"
    text = f"{_signed(row[f'difference_{key}'])}{_ends(row, 'difference', key)}"
    p = row.get(f"p_{key}", float("nan"))
    return text if pd.isna(p) else f"{text}, p {'< 0.001' if p < 0.001 else f'{p:.3f}'}"


def _counted(row: Row, key: str) -> str:
    """Score of a scene with the numbers behind it; an expected number has a decimal place."""
    text = _with_ends(row, "normalized", key)
    if f"raw_{key}" not in row or pd.isna(row[f"raw_{key}"]):
        return text
    good = row[f"raw_{key}"] * row["n_views"]
    digits = 0 if abs(good - round(good)) < 1e-6 else 1
    return f"{text}, {good:,.{digits}f} of {row['n_views']:,}"


def _with_ends(row: Row, name: str, key: str) -> str:
    return _percent(row[f"{name}_{key}"]) + _ends(row, name, key)


def _ends(row: Row, name: str, key: str) -> str:
    """Interval of a share, with a space in front; nothing where it is not known or has no width."""
    low, high = (row.get(f"{name}_{end}_{key}", float("nan")) for end in ("low", "high"))
    as_text = _signed if name == "difference" else _percent
    return f" [{as_text(low)}, {as_text(high)}]" if pd.notna(low) and low < high else ""


def _percent(value: float) -> str:
    return "–" if pd.isna(value) else f"{100 * value:.1f}"


def _signed(value: float) -> str:
    return f"{round(100 * value, 1) + 0.0:+.1f}"  # + 0.0 makes -0.0 positive


def _number(value: float) -> str:
    return "–" if pd.isna(value) else f"{value:.3f}"
