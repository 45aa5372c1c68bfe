"""The score figures: how well methods choose, what they lose against the oracle, and against a reference."""

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
from wheretolook.evaluation.score_table import main_rows, methods_of, reference_of, threshold_keys
from wheretolook.evaluation.scores import by_chance
from wheretolook.figures.config import Look
from wheretolook.figures.style import INK, RC, new_figure
from wheretolook.scorers.styles import ORACLE, method_group, method_style

_MOST = {"Fisher": 3, "probes": 0}  # of a group's methods that a figure shows, the best ones; else all
_WRAP = 36  # longer names of methods are broken into two lines
_WHISKERS = "whiskers: 95 % bootstrap interval over locations"


def score_figure(scores: pd.DataFrame) -> Figure:
    """How often the view that a method chooses localizes, at the finest and at the coarsest threshold.

    One row for each method, the best at the finest threshold on top: the share of its chosen views, in % of the
    oracle's, as a mark with its bootstrap interval, and as a number. The axes hold the methods that come at least
    halfway from chance to the oracle; arrows point to the others. Shown are the first N and `methods_to_show`; all
    other numbers stand in the table.

    `scores` is a table of `wheretolook.evaluation.scores.score_table`; its rows over all scenes are drawn, those of the
    first occlusion model and the first set of candidates if there are several.
    """
    pooled = _pooled(scores)
    keys = threshold_keys(scores)
    shown = methods_to_show(pooled, keys[0])
    columns = {f"normalized_{key}": f"within {threshold_label(key)}" for key in dict.fromkeys((keys[0], keys[-1]))}
    lowest = _ends_of(pooled, _near(pooled, shown, keys[0]), list(columns))[0]
    with context(RC):
        figure, panels = _rows_and_panels(pooled, shown, columns)
        for axes in panels:
            low = min(lowest, 95.0)
            axes.set_xlim(low - 0.04 * (100 - low), 100 + 0.04 * (100 - low))
            axes.axvline(100, color=INK, linewidth=1, linestyle="--", zorder=1)
            _point_beyond(axes, shown)
        oracle = method_style(ORACLE).label
        figure.supxlabel(
            f"{_chosen(pooled)} that localize, % of what the {oracle} reaches (dashed)\n{_WHISKERS}", fontsize=9
        )
        return figure


def regret_figure(scores: pd.DataFrame) -> Figure:
    """What methods lose against the oracle and against the reference, at the finest threshold.

    Rows and `scores` are as in `score_figure`. Left the regret, right the paired difference to the reference if the
    table has one, with bootstrap intervals, in percentage points of the chosen views. Raises ValueError if the table is
    of an older version, without regret.
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
            low, high = _ends_of(pooled, _near(pooled, shown, key), [column])
            low = min(low, 0.0)
            high = max(high, 0.0)
            margin = 0.06 * max(high - low, 1.0)
            axes.set_xlim(low - margin, high + margin)
            axes.axvline(0, color=INK, linewidth=1, linestyle="--", zorder=1)
            _point_beyond(axes, shown)
        share = f"{_chosen(pooled)} within {threshold_label(key)}, percentage points"
        figure.supxlabel(f"{share}\n{_WHISKERS}", fontsize=9)
        return figure


def methods_to_show(pooled: pd.DataFrame, key: str) -> list[str]:
    """Methods of a score table that a figure shows, best first: of the Fisher methods three, and no probes.

    Args:
        pooled: rows of a score table over all scenes.
        key: the threshold they are ordered by, at the first N.
    """
    rows = pooled[(pooled["top_n"] == pooled["top_n"].iloc[0]) & (pooled["method"] != ORACLE)]
    shares = rows.set_index("method")[f"normalized_{key}"].fillna(0.0)
    ordered = sorted(methods_of(rows), key=lambda method: -shares[method])
    shown = []
    seen = dict.fromkeys(_MOST, 0)
    for method in ordered:
        group = method_group(method)
        seen[group] = seen.get(group, 0) + 1
        if seen[group] <= _MOST.get(group, len(ordered)):
            shown.append(method)
    return shown or ordered


def _near(pooled: pd.DataFrame, shown: Sequence[str], key: str) -> list[str]:
    """Methods that come at least halfway from chance to the oracle."""
    shares = _first_rows(pooled)[f"normalized_{key}"].fillna(0.0)
    chance = max((shares[method] for method in methods_of(pooled) if by_chance(method)), default=0.0)
    return [method for method in shown if shares[method] >= (1 + chance) / 2] or list(shown)


def _point_beyond(axes: Axes, shown: Sequence[str]) -> None:
    """Arrows at the ends of the axis to marks beyond them."""
    low, high = axes.get_xlim()
    for y, method in enumerate(shown):
        label = method_style(method).label
        (value,) = (float(line.get_xdata()[0]) for line in axes.lines if line.get_label() == label)  # type: ignore[index,arg-type]
        for beyond, end, text, side in ((value < low, low, "◂", "left"), (value > high, high, "▸", "right")):
            if beyond:
                axes.text(end, y, text, color=method_style(method).color, fontsize=13, va="center", ha=side)


def _pooled(scores: pd.DataFrame) -> pd.DataFrame:
    scores = main_rows(scores)
    return scores[scores["scene"] == ALL]


def _first_rows(pooled: pd.DataFrame) -> pd.DataFrame:
    """A row for each method, of the first N, by its name."""
    return pooled[pooled["top_n"] == pooled["top_n"].iloc[0]].set_index("method")


def _interval(row: Any, column: str) -> tuple[float, float, float]:
    """Value and ends of the interval in a row of the table, in percent; NaN where they are not known."""
    name, _, key = column.partition("_")
    names = (column, f"{name}_low_{key}", f"{name}_high_{key}")
    value, low, high = (100 * float(row.get(one, np.nan)) for one in names)
    return value, low, high


def _ends_of(pooled: pd.DataFrame, shown: Sequence[str], columns: Sequence[str]) -> tuple[float, float]:
    """Ends of an axis that holds the columns and their intervals."""
    rows = _first_rows(pooled)
    known = [x for method in shown for column in columns for x in _interval(rows.loc[method], column) if np.isfinite(x)]
    return min(known, default=0.0), max(known, default=0.0)


def _rows_and_panels(pooled: pd.DataFrame, shown: Sequence[str], columns: dict[str, str]) -> tuple[Figure, list[Axes]]:
    """A panel for each column of the table, with its title; a row for each method, a mark, whiskers and a number."""
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
            (value, low, high) = _interval(rows.loc[method], column)
            axes.hlines(y, low, high, color=style.color, linewidth=1.6)
            filled = style.marker in Line2D.filled_markers
            edge: Look = {"markeredgecolor": INK if filled else style.color, "markeredgewidth": 0.5 if filled else 1.6}
            axes.plot(value, y, style.marker, color=style.color, markersize=7, label=style.label, **edge)
            number = "" if np.isnan(value) else f"{value:.1f}".replace("-", "−")
            place: Look = {"xycoords": ("axes fraction", "data"), "va": "center", "fontsize": 8.5}
            axes.annotate(number, (1.02, y), **place)
    labels = [method_style(method).label for method in shown]
    labels = [",\n".join(label.rsplit(", ", 1)) if len(label) > _WRAP else label for label in labels]
    panels[0].set_yticks(range(len(shown)), labels, fontsize=9)
    panels[0].set_ylim(len(shown) - 0.4, -0.6)
    return figure, panels


def _chosen(pooled: pd.DataFrame) -> str:
    n = int(pooled["top_n"].iloc[0])
    return "best views of locations" if n == 1 else f"the best {n} views of locations"
