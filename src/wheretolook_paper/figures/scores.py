"""Score figures: how often the chosen views localize, relative to the oracle and to a reference method."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.style import context
from matplotlib.ticker import MaxNLocator

from wheretolook.dataset.config import ALL, threshold_label
from wheretolook.evaluation.results import ORACLE, is_random, main_rows, reference_of, threshold_keys
from wheretolook.figures.floor_plan import INK, RC, new_figure
from wheretolook.geometry.poses import Float
from wheretolook_paper.figures.style import Style
from wheretolook_paper.styles import method_group, method_style

_MAX_METHODS = {"Fisher": 3, "probes": 0}  # the best methods of a group that a figure shows; all of other groups
_WRAP = 36  # characters; longer labels are broken into two lines
_DASHED: Style = {"color": INK, "linewidth": 1, "linestyle": "--", "zorder": 1}


def score_figure(scores: pd.DataFrame) -> Figure:
    """Draw how often the first N views chosen by each method localize, in % of the oracle, with intervals.

    One panel for the finest and one for the coarsest threshold, one row per method of `methods_to_show`, the best on
    top. The axes span the methods at least halfway from random choice to the oracle; arrows point to the others.
    `scores` is a table of `wheretolook.evaluation.results.score_table`; rows over all scenes of its first occlusion
    model and candidate set are drawn.
    """
    pooled = _pooled(scores)
    keys = threshold_keys(scores)
    rows = _first_rows(pooled).loc[methods_to_show(pooled, keys[0])]
    columns = {f"normalized_{key}": f"within {threshold_label(key)}" for key in (keys[0], keys[-1])}
    values = np.stack([_intervals(rows, column) for column in columns])[:, _close_to_oracle(rows, keys[0])]
    low = float(np.min(values, where=np.isfinite(values), initial=95.0))
    margin = 0.04 * (100 - low)
    ranges = [(low - margin, 100 + margin)] * len(columns)
    reached = f"{_chosen_views(pooled)} that localize, % of what the {method_style(ORACLE).label} reaches (dashed)"
    return _draw_panels(rows, columns, ranges, 100, reached)


def regret_figure(scores: pd.DataFrame) -> Figure:
    """Draw the regret against the oracle and the paired difference to the reference, at the finest threshold.

    Rows and `scores` are as in `score_figure`; values are percentage points of the chosen views. Raises ValueError if
    the table has no regret.
    """
    pooled = _pooled(scores)
    key = threshold_keys(scores)[0]
    if f"regret_{key}" not in scores:
        raise ValueError("the score table has no regret: evaluate again")
    rows = _first_rows(pooled).loc[methods_to_show(pooled, key)]
    columns = {f"regret_{key}": "regret: oracle minus method\n(lower is better)"}
    if reference := reference_of(pooled):
        columns[f"difference_{key}"] = f"method minus {method_style(reference).label}\n(higher is better)"
    ranges = []
    for column in columns:
        values = _intervals(rows, column)[_close_to_oracle(rows, key)]
        finite = np.isfinite(values)
        low = float(np.min(values, where=finite, initial=0.0))
        high = float(np.max(values, where=finite, initial=0.0))
        margin = 0.06 * max(high - low, 1.0)
        ranges.append((low - margin, high + margin))
    views = f"{_chosen_views(pooled)} within {threshold_label(key)}, percentage points"
    return _draw_panels(rows, columns, ranges, 0, views)


def methods_to_show(pooled: pd.DataFrame, key: str) -> list[str]:
    """Select the methods that a figure shows, best first: three Fisher methods, no probes, all others.

    Args:
        pooled: rows of a score table over all scenes.
        key: threshold by which methods are ordered, at the first N.
    """
    rows = _first_rows(pooled).drop(index=ORACLE, errors="ignore")
    ordered = rows[f"normalized_{key}"].fillna(0.0).sort_values(ascending=False, kind="stable").index
    shown: list[str] = []
    counts: Counter[str] = Counter()
    for method in ordered:
        group = method_group(method)
        counts[group] += 1
        if counts[group] <= _MAX_METHODS.get(group, len(ordered)):
            shown.append(method)
    return shown or list(ordered)


def _pooled(scores: pd.DataFrame) -> pd.DataFrame:
    scores = main_rows(scores)
    return scores[scores["scene"] == ALL]


def _first_rows(pooled: pd.DataFrame) -> pd.DataFrame:
    """Select the row of each method at the first N, indexed by method."""
    return pooled[pooled["top_n"] == pooled["top_n"].iloc[0]].set_index("method")


def _close_to_oracle(rows: pd.DataFrame, key: str) -> Sequence[bool]:
    """Select the methods (M,) at least halfway from random choice to the oracle, or all."""
    shares = rows[f"normalized_{key}"].fillna(0.0)
    baseline = shares[[is_random(str(method)) for method in rows.index]].max()
    close = shares >= (1 + np.nan_to_num(baseline)) / 2
    return list(close if close.any() else ~close)


def _intervals(rows: pd.DataFrame, column: str) -> Float:
    """Read values and lower and upper ends of their intervals (M, 3), in percent; NaN where missing."""
    name, _, key = column.partition("_")
    return 100 * rows.reindex(columns=[column, f"{name}_low_{key}", f"{name}_high_{key}"]).to_numpy(float)


def _draw_panels(
    rows: pd.DataFrame, titles: dict[str, str], ranges: list[tuple[float, float]], dashed: float, caption: str
) -> Figure:
    """Draw one titled panel per column of the table, one row per method: mark, whiskers and number.

    Each panel has a range of values and a dashed line; arrows point to marks outside the range.
    """
    with context(RC):
        figure = new_figure(3.1 + 2.9 * len(titles), 1.5 + 0.3 * len(rows))
        panels: list[Axes] = list(figure.subplots(1, len(titles), sharey=True, squeeze=False)[0])
        for axes, (column, title), limits in zip(panels, titles.items(), ranges, strict=True):
            axes.set_title(title, fontsize=10)
            axes.tick_params(axis="y", length=0)
            axes.tick_params(axis="x", labelsize=9)
            axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
            axes.grid(axis="y", visible=False)
            for y, (method, interval) in enumerate(zip(rows.index, _intervals(rows, column), strict=True)):
                _draw_row(axes, y, str(method), interval, limits)
            axes.set_xlim(limits)
            axes.axvline(dashed, **_DASHED)
        labels = [method_style(str(method)).label for method in rows.index]
        labels = [",\n".join(label.rsplit(", ", 1)) if len(label) > _WRAP else label for label in labels]
        panels[0].set_yticks(range(len(rows)), labels, fontsize=9)
        panels[0].set_ylim(len(rows) - 0.4, -0.6)
        figure.supxlabel(f"{caption}\nwhiskers: 95 % bootstrap interval over locations", fontsize=9)
        return figure


def _draw_row(axes: Axes, y: float, method: str, interval: Float, limits: tuple[float, float]) -> None:
    style = method_style(method)
    value, low, high = interval
    axes.hlines(y, low, high, color=style.color, linewidth=1.6)
    filled = style.marker in Line2D.filled_markers
    edge: Style = {"markeredgecolor": INK if filled else style.color, "markeredgewidth": 0.5 if filled else 1.6}
    axes.plot(value, y, style.marker, color=style.color, markersize=7, label=style.label, **edge)
    number = "" if np.isnan(value) else f"{value:.1f}".replace("-", "−")
    axes.annotate(number, (1.02, y), xycoords=("axes fraction", "data"), va="center", fontsize=8.5)
    text: Style = {"color": style.color, "fontsize": 13, "va": "center"}
    if value < limits[0]:
        axes.text(limits[0], y, "◂", ha="left", **text)
    elif value > limits[1]:
        axes.text(limits[1], y, "▸", ha="right", **text)


def _chosen_views(pooled: pd.DataFrame) -> str:
    n = int(pooled["top_n"].iloc[0])
    return "best views of locations" if n == 1 else f"the best {n} views of locations"
