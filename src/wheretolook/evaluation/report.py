"""The score table for people, in Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pandas as pd

from wheretolook.evaluation.config import threshold_label
from wheretolook.evaluation.scores import ALL
from wheretolook.figures.style import method_style


def threshold_keys(scores: pd.DataFrame) -> list[str]:
    """Thresholds of a score table, by the names its columns use."""
    return [name.removeprefix("any_") for name in scores.columns if name.startswith("any_")]


def score_markdown(scores: pd.DataFrame, title: str = "Localization score") -> str:
    """Tables of a score table (`wheretolook.evaluation.scores.score_table`): one for each N, then one by scene.

    Args:
        scores: the table.
        title: first line.
    """
    occlusions = list(scores["occlusion"].unique()) if "occlusion" in scores else []
    comparison = _occlusion_table(scores, occlusions) if len(occlusions) > 1 else []
    if occlusions:
        scores = scores[scores["occlusion"] == occlusions[0]]
    pooled = scores[scores["scene"] == ALL]
    scenes = [name for name in scores["scene"].unique() if name != ALL]
    keys = threshold_keys(scores)
    parts = [
        f"# {title}",
        f"Scenes: {', '.join(scenes)}; {pooled['n_locations'].iloc[0]:,} locations. "
        "Share in % of the chosen viewpoints that localize within both limits, divided by the oracle's share "
        "[95 % bootstrap interval over locations], and "
        "undivided in round brackets. AP and AUC (ROC) of the scores are against the first limits. Random is an exact "
        "expectation, its AP and AUC are one draw.",
    ]
    for n, rows in pooled.groupby("top_n", sort=False):
        chosen = "viewpoint" if n == 1 else f"{n} viewpoints"
        parts.append(f"## Best {chosen} of each location ({rows['n_views'].iloc[0]:,} in all)")
        lines = []
        for row in rows.to_dict("records"):
            shares = [_share(row, key, interval=index == 0) for index, key in enumerate(keys)]
            metrics = [_number(row["average_precision"]), _number(row["roc_auc"])]
            lines.append([method_style(row["method"], row["inputs"]).label, *shares, *metrics])
        parts.append(markdown_table(["method", *map(threshold_label, keys), "AP", "AUC"], lines))
    first = scores[(scores["top_n"] == scores["top_n"].iloc[0]) & (scores["scene"] != ALL)]
    if len(scenes) > 1:
        parts.append(f"## By scene: best {scores['top_n'].iloc[0]} of each location, within {threshold_label(keys[0])}")
        methods = list(dict.fromkeys(zip(first["method"], first["inputs"], strict=True)))
        by_key = {(row["scene"], row["method"], row["inputs"]): row for row in first.to_dict("records")}
        lines = []
        for method in methods:
            shares = [_share(by_key[(scene, *method)], keys[0], interval=True) for scene in scenes]
            lines.append([method_style(*method).label, *shares])
        parts.append(markdown_table(["method", *scenes], lines))
    return "\n\n".join([*parts, *comparison]) + "\n"


def _occlusion_table(scores: pd.DataFrame, occlusions: Sequence[str]) -> list[str]:
    """Average precision and the best view's share of every method, by occlusion model."""
    key, n = threshold_keys(scores)[0], scores["top_n"].iloc[0]
    pooled = scores[(scores["scene"] == ALL) & (scores["top_n"] == n) & (scores["method"] != "oracle")]
    by_key = {(row["method"], row["inputs"], row["occlusion"]): row for row in pooled.to_dict("records")}
    methods = list(dict.fromkeys(zip(pooled["method"], pooled["inputs"], strict=True)))
    lines = []
    for method in methods:
        rows = [by_key[(*method, occlusion)] for occlusion in occlusions]
        cells = [f"{_number(row['average_precision'])}, {_share(row, key, interval=True)}" for row in rows]
        lines.append([method_style(*method).label, *cells])
    title = f"## By occlusion model: AP, and best {n} of each location within {threshold_label(key)}"
    note = f"The tables above are with {occlusions[0]}."
    return [title, note, markdown_table(["method", *occlusions], lines)]


def _share(row: dict[Any, Any], key: str, interval: bool) -> str:
    normalized, raw = row[f"normalized_{key}"], row[f"raw_{key}"]
    low, high = row[f"normalized_low_{key}"], row[f"normalized_high_{key}"]
    ends = f" [{100 * low:.1f}, {100 * high:.1f}]" if interval and pd.notna(low) and low < high else ""
    return f"{_percent(normalized)}{ends} ({_percent(raw)})"


def _percent(value: float) -> str:
    return "–" if pd.isna(value) else f"{100 * value:.1f}"


def _number(value: float) -> str:
    return "–" if pd.isna(value) else f"{value:.3f}"


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table whose columns also line up as plain text."""
    widths = [max(len(line[column]) for line in [header, *rows]) for column in range(len(header))]
    lines = [header, ["-" * width for width in widths], *rows]
    return "\n".join(
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) + " |" for line in lines
    )
