"""The score figures: how well every method chooses, what it loses against the oracle, and against a reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle, product

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.style import context
from matplotlib.ticker import MaxNLocator

from wheretolook.evaluation.score_table import main_rows, methods_of, reference_of, threshold_keys
from wheretolook.evaluation.scores import by_chance
from wheretolook.figures.config import Look
from wheretolook.figures.style import INK, RC, new_figure
from wheretolook.methods.styles import ORACLE, method_group, method_style, rows_by_group
from wheretolook.viewpoints.thresholds import ALL, threshold_label

_OTHER_MARKERS = ("o", "D", "s", "^")  # markers of the second and further N
_WRAP = 36  # longer names of methods are broken into two lines

_WHISKERS = "whiskers: 95 % bootstrap interval over locations"


@dataclass(frozen=True)
class _Layout:
    """What the panels of a figure share: rows of the table by method and N, and the places y of methods."""

    rows: dict[tuple[str, int], dict[str, float]]
    y: dict[str, float]
    top_n: Sequence[int]
    near: Sequence[str]
    """Methods nearer to the oracle than to chance, whose values the axes hold."""

    def others(self) -> list[tuple[int, str, float]]:
        """The second and further N, their markers, and how far below the first they are drawn, in rows."""
        others, markers = self.top_n[1:], cycle(_OTHER_MARKERS)
        places = 0.3 + 0.5 * np.arange(len(others)) / max(2, len(others))
        return list(zip(others, markers, places.tolist(), strict=False))

    def value(self, method: str, n: int, column: str) -> float:
        """In percent; NaN where it is not known."""
        return 100 * self.rows.get((method, n), {}).get(column, float("nan"))

    def ends(self, method: str, n: int, column: str) -> tuple[float, float]:
        """Of the interval, in percent; NaN where it is not known."""
        name, _, key = column.partition("_")
        return self.value(method, n, f"{name}_low_{key}"), self.value(method, n, f"{name}_high_{key}")

    def limits(self, columns: Sequence[str]) -> tuple[float, float]:
        """Ends of an axis that holds the columns, such as "regret_0.05m_0.4deg", and their intervals."""
        known: list[float] = []
        for method, n, column in product(self.near, self.top_n, columns):
            values = (self.value(method, n, column), *self.ends(method, n, column))
            known += [value for value in values if np.isfinite(value)]
        return min(known, default=0.0), max(known, default=0.0)


def score_figure(scores: pd.DataFrame) -> Figure:
    """Localization score of each method at each threshold, for each N.

    One panel for each threshold, one row for each method, groups set apart: a filled mark for the first N, small open
    ones below it for the others, with bootstrap intervals; the oracle a line at 100 %. The axis above a panel gives the
    share before division by the oracle's, for the first N. The axes reach down to the methods that come at least
    halfway from chance to the oracle; arrows and numbers stand for values beyond.

    `scores` is a table of `wheretolook.evaluation.scores.score_table`; its rows over all scenes are drawn, those of the
    first occlusion model and the first set of candidates if there are several.
    """
    scores = main_rows(scores)
    pooled, keys = scores[scores["scene"] == ALL], threshold_keys(scores)
    layout = _layout(pooled, keys[0])
    columns = [f"normalized_{key}" for key in keys]
    low = min(layout.limits(columns)[0], 95.0)
    margin = 0.05 * (100 - low)
    with context(RC):
        figure = new_figure(2.8 + 2.15 * len(keys), _height(layout))
        panels = figure.subplots(1, len(keys), sharex=True, sharey=True, squeeze=False)[0]
        panels[0].set_xlim(low - margin, 100 + margin)
        for axes, key, column in zip(panels, keys, columns, strict=True):
            axes.axvline(100, color=INK, linewidth=1, linestyle="--")
            _draw(axes, layout, column)
            axes.set_title(f"within {threshold_label(key)}", fontsize=10)
            best = pooled.loc[(pooled["method"] == ORACLE) & (pooled["top_n"] == layout.top_n[0]), f"raw_{key}"]
            if len(best) and best.iloc[0] > 0:
                _add_raw_axis(axes, best.iloc[0])
        _name_rows(panels[0], layout)
        shares = f"% of the oracle's share; above each panel: % of the chosen views, {_best(layout.top_n[0])}"
        figure.supxlabel(f"{shares}\n{_WHISKERS}", fontsize=9)
        _add_legend(figure, layout, [Line2D([], [], color=INK, linewidth=1, linestyle="--", label="oracle")])
        return figure


def regret_figure(scores: pd.DataFrame) -> Figure:
    """What each method loses against the oracle and against the reference, at the finest threshold, for each N.

    Rows and `scores` are as in `score_figure`. Left the regret, right the paired difference to the reference if the
    table has one, with bootstrap intervals, in percentage points of the chosen views. Raises ValueError if the table is
    of an older version, without regret.
    """
    scores = main_rows(scores)
    pooled, key = scores[scores["scene"] == ALL], threshold_keys(scores)[0]
    if f"regret_{key}" not in scores:
        raise ValueError("the score table has no regret: evaluate again")
    layout, reference = _layout(pooled, key), reference_of(pooled)
    columns = {f"regret_{key}": "regret: oracle minus method"}
    if reference:
        columns[f"difference_{key}"] = f"method minus {method_style(reference).label}"
    with context(RC):
        figure = new_figure(3.0 + 3.1 * len(columns), _height(layout))
        panels = figure.subplots(1, len(columns), sharey=True, squeeze=False)[0]
        for axes, (column, title) in zip(panels, columns.items(), strict=True):
            low, high = layout.limits([column])
            low, high = min(low, 0.0), max(high, 0.0)
            margin = 0.06 * max(high - low, 1.0)
            axes.set_xlim(low - margin, high + margin)
            axes.axvline(0, color=INK, linewidth=1, linestyle="--")
            _draw(axes, layout, column)
            axes.set_title(title, fontsize=10)
        panels[0].set_xlabel("percentage points, lower is better", fontsize=9)
        if reference:
            panels[1].set_xlabel("percentage points, higher is better", fontsize=9)
        figure.supxlabel(f"shares of chosen views within {threshold_label(key)}\n{_WHISKERS}", fontsize=9)
        _name_rows(panels[0], layout)
        _add_legend(figure, layout, [])
        return figure


def _layout(pooled: pd.DataFrame, key: str) -> _Layout:
    """Rows by groups from top to bottom, in the table's order within each."""
    shown = pooled[pooled["method"] != ORACLE]
    y = rows_by_group(methods_of(shown))
    methods = list(y)
    rows = {(row["method"], row["top_n"]): {str(name): row[name] for name in row} for row in shown.to_dict("records")}
    top_n = [int(n) for n in shown["top_n"].unique()]
    everything = _Layout(rows, y, top_n, methods)
    drawn = next(filter(by_chance, methods), "")
    chance = np.nan_to_num(everything.value(drawn, top_n[0], f"normalized_{key}"))
    halfway = [x for x in methods if everything.value(x, top_n[0], f"normalized_{key}") >= (100 + chance) / 2]
    near = [method for method in halfway if method_group(method) != "probes"]
    return _Layout(rows, y, top_n, near or methods)


def _height(layout: _Layout) -> float:
    n_rows = max(layout.y.values()) + 1
    return 1.6 + n_rows * (0.31 if n_rows > 8 else 0.4)


def _draw(axes: Axes, layout: _Layout, column: str) -> None:
    """Marks of all methods for one column of the table; arrows and numbers for those beyond the axis' ends."""
    low, high = axes.get_xlim()
    plate = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}
    for method, y in layout.y.items():
        style = method_style(method)
        values = [layout.value(method, n, column) for n in layout.top_n]
        if low <= values[0] <= high:
            axes.hlines(y, *layout.ends(method, layout.top_n[0], column), color=INK, linewidth=1.2)
            filled = style.marker in Line2D.filled_markers
            edge: Look = {"markeredgecolor": INK if filled else style.color, "markeredgewidth": 0.5 if filled else 1.6}
            axes.plot(values[0], y, style.marker, color=style.color, markersize=7, label=style.label, **edge)
        for value, (n, marker, below) in zip(values[1:], layout.others(), strict=True):
            if low <= value <= high:
                axes.hlines(y + below, *layout.ends(method, n, column), color=style.color, linewidth=0.8)
                small: Look = {"markersize": 3.4, "markerfacecolor": "white", "markeredgewidth": 1}
                axes.plot(value, y + below, marker, color=style.color, **small)
        for beyond, end, text, side, shift in (
            ([value for value in values if value < low], low, "◂ {}", "left", 2),
            ([value for value in values if value > high], high, "{} ▸", "right", -2),
        ):
            if beyond and not low <= values[0] <= high:  # else the first mark stands where the text would
                numbers = " · ".join(f"{value:.0f}" for value in beyond).replace("-", "−")
                look: Look = {"fontsize": 7.5, "va": "center", "ha": side, "zorder": 1.9, "bbox": plate}
                axes.annotate(text.format(numbers), (end, y), (shift, 0), textcoords="offset points", **look)


def _add_raw_axis(axes: Axes, best: float) -> None:
    """A second axis, above, of the shares before they are divided by the oracle's, `best`."""
    both_ways = (lambda share: np.multiply(share, best), lambda share: np.divide(share, best))
    above = axes.secondary_xaxis("top", functions=both_ways)
    above.tick_params(labelsize=8, length=2)
    above.spines["top"].set_visible(True)


def _name_rows(axes: Axes, layout: _Layout) -> None:
    labels = [method_style(method).label for method in layout.y]
    labels = [",\n".join(label.rsplit(", ", 1)) if len(label) > _WRAP else label for label in labels]
    axes.set_yticks(list(layout.y.values()), labels, fontsize=9)
    axes.set_ylim(max(layout.y.values()) + 0.8, -0.6)
    for panel in axes.figure.axes:
        panel.tick_params(axis="y", length=0)
        panel.tick_params(axis="x", labelsize=9)
        panel.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))


def _best(n: int) -> str:
    return "best view" if n == 1 else f"best {n} views"


def _add_legend(figure: Figure, layout: _Layout, more: Sequence[Line2D]) -> None:
    handles = [Line2D([], [], color=INK, linewidth=1.2, marker="o", markersize=7, label=_best(layout.top_n[0]))]
    small: Look = {"color": INK, "linewidth": 0.8, "markersize": 3.4, "markerfacecolor": "white"}
    handles += [Line2D([], [], marker=marker, label=_best(n), **small) for n, marker, _ in layout.others()]
    handles += more
    if any(axes.texts for axes in figure.axes):
        beyond = f"beyond the axis, N = {', '.join(map(str, layout.top_n))}"
        handles.append(Line2D([], [], color=INK, linestyle="none", marker="$◂$", markersize=5, label=beyond))
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), columnspacing=1.4, handlelength=1.6)
