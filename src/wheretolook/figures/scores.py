"""Score figures: how often the chosen views localize, relative to the oracle and to a reference method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.style import context
from matplotlib.ticker import MaxNLocator

from wheretolook.dataset.thresholds import ALL, threshold_label
from wheretolook.evaluation.scores import is_random, main_rows, reference_of, threshold_keys
from wheretolook.figures.style import INK, RC, Style, new_figure
from wheretolook.scorers.styles import ORACLE, method_group, method_style

_MAX_METHODS = {"Fisher": 3, "probes": 0}  # the best methods of a group that a figure shows; all of other groups
_WRAP = 36  # characters; longer labels are broken into two lines
_WHISKERS = "whiskers: 95 % bootstrap interval over locations"
_DASHED: Style = {"color": INK, "linewidth": 1, "linestyle": "--", "zorder": 1}


def score_figure(scores: pd.DataFrame) -> Figure:
    """Draw how often the first N views chosen by each method localize, in % of the oracle, with intervals.

    One panel for the finest and one for the coarsest threshold, one row per method of `methods_to_show`, the best on
    top. The axes span the methods at least halfway from random choice to the oracle; arrows point to the others.
    `scores` is a table of `wheretolook.evaluation.scores.score_table`; rows over all scenes of its first occlusion
    model and candidate set are drawn.
    """
    pooled = _pooled(scores)
    keys = threshold_keys(scores)
    shown = methods_to_show(pooled, keys[0])
    columns = {f"normalized_{key}": f"within {threshold_label(key)}" for key in dict.fromkeys((keys[0], keys[-1]))}
    low = min(_range(pooled, _close_to_oracle(pooled, shown, keys[0]), list(columns))[0], 95.0)
    margin = 0.04 * (100 - low)
    with context(RC):
        figure, panels = _rows_and_panels(pooled, shown, columns)
        for axes in panels:
            _set_range(axes, shown, low - margin, 100 + margin, 100)
        oracle = method_style(ORACLE).label
        reached = f"{_chosen_views(pooled)} that localize, % of what the {oracle} reaches (dashed)"
        figure.supxlabel(f"{reached}\n{_WHISKERS}", fontsize=9)
        return figure


def regret_figure(scores: pd.DataFrame) -> Figure:
    """Draw the regret against the oracle and the paired difference to the reference, at the finest threshold.

    Rows and `scores` are as in `score_figure`; values are percentage points of the chosen views. Raises ValueError if
    the table has no regret.
    """
    pooled = _pooled(scores)
    key = threshold_keys(scores)[0]
    if f"regret_{key}" not in scores:
        raise ValueError("the score table has no regret: evaluate again")
    shown = methods_to_show(pooled, key)
    reference = reference_of(pooled)
    columns = {f"regret_{key}": "regret: oracle minus method\n(lower is better)"}
    if reference:
        columns[f"difference_{key}"] = f"method minus {method_style(reference).label}\n(higher is better)"
    with context(RC):
        figure, panels = _rows_and_panels(pooled, shown, columns)
        for axes, column in zip(panels, columns, strict=True):
            low, high = _range(pooled, _close_to_oracle(pooled, shown, key), [column])
            low = min(low, 0.0)
            high = max(high, 0.0)
            margin = 0.06 * max(high - low, 1.0)
            _set_range(axes, shown, low - margin, high + margin, 0)
        views = f"{_chosen_views(pooled)} within {threshold_label(key)}, percentage points"
        figure.supxlabel(f"{views}\n{_WHISKERS}", fontsize=9)
        return figure


def methods_to_show(pooled: pd.DataFrame, key: str) -> list[str]:
    """Select the methods that a figure shows, best first: three Fisher methods, no probes, all others.

    Args:
        pooled: rows of a score table over all scenes.
        key: threshold by which methods are ordered, at the first N.
    """
    rows = _first_rows(pooled).drop(index=ORACLE, errors="ignore")
    ordered = rows[f"normalized_{key}"].fillna(0.0).sort_values(ascending=False, kind="stable").index
    shown: list[str] = []
    counts = dict.fromkeys(_MAX_METHODS, 0)
    for method in ordered:
        group = method_group(method)
        counts[group] = counts.get(group, 0) + 1
        if counts[group] <= _MAX_METHODS.get(group, len(ordered)):
            shown.append(method)
    return shown or list(ordered)


def _close_to_oracle(pooled: pd.DataFrame, shown: Sequence[str], key: str) -> list[str]:
    """Select the methods at least halfway from random choice to the oracle, or all."""
    shares = _first_rows(pooled)[f"normalized_{key}"].fillna(0.0)
    baseline = max((share for method, share in shares.items() if is_random(str(method))), default=0.0)
    return [method for method in shown if shares[method] >= (1 + baseline) / 2] or list(shown)


def _set_range(axes: Axes, shown: Sequence[str], low: float, high: float, dashed: float) -> None:
    """Set the range of the x axis, draw a dashed line, and point arrows to marks outside the range."""
    axes.set_xlim(low, high)
    axes.axvline(dashed, **_DASHED)
    for y, method in enumerate(shown):
        style = method_style(method)
        (value,) = (float(line.get_xdata()[0]) for line in axes.lines if line.get_label() == style.label)  # type: ignore[index,arg-type]
        text: Style = {"color": style.color, "fontsize": 13, "va": "center"}
        if value < low:
            axes.text(low, y, "◂", ha="left", **text)
        elif value > high:
            axes.text(high, y, "▸", ha="right", **text)


def _pooled(scores: pd.DataFrame) -> pd.DataFrame:
    scores = main_rows(scores)
    return scores[scores["scene"] == ALL]


def _first_rows(pooled: pd.DataFrame) -> pd.DataFrame:
    """Select the row of each method at the first N, indexed by method."""
    return pooled[pooled["top_n"] == pooled["top_n"].iloc[0]].set_index("method")


def _interval(row: Any, column: str) -> tuple[float, float, float]:
    """Read value, lower and upper end of an interval from a row of the table, in percent; NaN if missing."""
    name, _, key = column.partition("_")
    value, low, high = (
        100 * float(row.get(part, np.nan)) for part in (column, f"{name}_low_{key}", f"{name}_high_{key}")
    )
    return value, low, high


def _range(pooled: pd.DataFrame, methods: Sequence[str], columns: Sequence[str]) -> tuple[float, float]:
    """Find the smallest and largest finite value or interval end of methods in columns of the table, in percent."""
    rows = _first_rows(pooled)
    values = np.array([_interval(rows.loc[method], column) for method in methods for column in columns])
    values = values[np.isfinite(values)]
    return (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)


def _rows_and_panels(pooled: pd.DataFrame, shown: Sequence[str], columns: dict[str, str]) -> tuple[Figure, list[Axes]]:
    """Draw one titled panel per column of the table, one row per method: mark, whiskers and number."""
    figure = new_figure(3.1 + 2.9 * len(columns), 1.5 + 0.3 * len(shown))
    panels: list[Axes] = list(figure.subplots(1, len(columns), sharey=True, squeeze=False)[0])
    rows = _first_rows(pooled)
    for axes, (column, title) in zip(panels, columns.items(), strict=True):
        axes.set_title(title, fontsize=10)
        axes.tick_params(axis="y", length=0)
        axes.tick_params(axis="x", labelsize=9)
        axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
        axes.grid(axis="y", visible=False)
        for y, method in enumerate(shown):
            style = method_style(method)
            value, low, high = _interval(rows.loc[method], column)
            axes.hlines(y, low, high, color=style.color, linewidth=1.6)
            filled = style.marker in Line2D.filled_markers
            edge: Style = {"markeredgecolor": INK if filled else style.color, "markeredgewidth": 0.5 if filled else 1.6}
            axes.plot(value, y, style.marker, color=style.color, markersize=7, label=style.label, **edge)
            number = "" if np.isnan(value) else f"{value:.1f}".replace("-", "−")
            axes.annotate(number, (1.02, y), xycoords=("axes fraction", "data"), va="center", fontsize=8.5)
    labels = [method_style(method).label for method in shown]
    labels = [",\n".join(label.rsplit(", ", 1)) if len(label) > _WRAP else label for label in labels]
    panels[0].set_yticks(range(len(shown)), labels, fontsize=9)
    panels[0].set_ylim(len(shown) - 0.4, -0.6)
    return figure, panels


def _chosen_views(pooled: pd.DataFrame) -> str:
    n = int(pooled["top_n"].iloc[0])
    return "best views of locations" if n == 1 else f"the best {n} views of locations"
