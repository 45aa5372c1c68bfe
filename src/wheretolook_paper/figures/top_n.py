"""Scores of the best N viewpoints of a location: the paper's figure "Multiple viewpoints results"."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.style import context

from wheretolook.dataset.config import ALL, threshold_label
from wheretolook.evaluation.results import ORACLE, main_rows, methods_of, threshold_keys
from wheretolook.figures.floor_plan import GREY, new_figure
from wheretolook.scorers.registry import find
from wheretolook_paper.evaluation.paper_tables import PAPER
from wheretolook_paper.figures.style import PRINT, TWO_COLUMNS_IN, Style
from wheretolook_paper.styles import STYLES, method_style

ROWS = {
    "normalized": "good ones among the best N\n(% of the oracle's share)",
    "any": "locations with a good one\namong N (%)",
}
"""The two scores of several viewpoints: columns of the score table, and their labels."""

_PRINTED = {row.name: row.printed for row in PAPER["vs_others"]}
_PAPER_MARKS = {"proposed": ("D", "paper, proposed"), "random": ("s", "paper, random")}


def top_n_figure(scores: pd.DataFrame, methods: Sequence[str] = ()) -> Figure:
    """Draw scores over the number N of best viewpoints at each threshold.

    Above, the share of good viewpoints among the best N of all locations, in % of the oracle's; below, the share of
    locations with a good one among N, the oracle's as lines. Whiskers are 95 % bootstrap intervals. Open grey marks are
    the paper's numbers, which it prints for N = 1 only, on other scenes and divided by its released code's constant.

    `scores` is a table of `wheretolook.evaluation.results.score_table`; its rows over all scenes are drawn, of the first
    occlusion model and set of candidates; without methods named, those that are `of_the_few`.
    """
    scores = main_rows(scores)
    pooled = scores[scores["scene"] == ALL]
    keys = threshold_keys(scores)
    shown = _present(pooled, methods) if methods else _the_few(pooled)
    top_n = [int(n) for n in pooled["top_n"].unique()]
    with context(PRINT):
        figure = new_figure(TWO_COLUMNS_IN, 4.6)
        panels = figure.subplots(len(ROWS), len(keys), sharex=True, sharey="row", squeeze=False)
        for line, (column, name) in zip(panels, ROWS.items(), strict=True):
            for index, (axes, key) in enumerate(zip(line, keys, strict=True)):
                _draw(axes, pooled, shown, top_n, f"{column}_{{}}{key}")
                if column == "normalized":
                    axes.set_title(f"within {threshold_label(key)}")
                    for printed_row, (marker, _) in _PAPER_MARKS.items():
                        mark: Style = {"markersize": 5, "color": GREY, "markerfacecolor": "white"}
                        axes.plot(-0.5, _PRINTED[printed_row][index], marker, **mark)
                else:
                    style = method_style(ORACLE)
                    best = 100 * pooled[pooled["method"] == ORACLE][f"{column}_{key}"]
                    ends = np.arange(len(top_n)) - 0.42, np.arange(len(top_n)) + 0.42
                    axes.hlines(best, *ends, color=style.color, linewidth=1, label=style.label)
            line[0].set_ylabel(name)
        for axes in panels[-1]:
            axes.set_xlabel("N")
        look: Style = {"linestyle": "none", "color": GREY, "markerfacecolor": "white"}
        printed = [Line2D([], [], marker=marker, label=label, **look) for marker, label in _PAPER_MARKS.values()]
        handles = [*panels[1, 0].get_legend_handles_labels()[0], *printed]
        figure.legend(handles=handles, loc="outside upper center", ncols=4, columnspacing=1.6, handlelength=1.4)
        return figure


def top_n_table(scores: pd.DataFrame) -> pd.DataFrame:
    """Return the numbers of `top_n_figure` at the finest threshold, in %, and the oracle's: a row per method."""
    scores = main_rows(scores)
    pooled = scores[scores["scene"] == ALL]
    key = threshold_keys(scores)[0]
    shown = [*_the_few(pooled), ORACLE]
    names = {"normalized": "good ones, % of the oracle's", "any": "locations with one, %"}
    parts = {name: 100 * pooled.pivot(index="method", columns="top_n", values=f"{column}_{key}")
             for column, name in names.items()}  # fmt: skip
    table = pd.concat(parts, axis=1).loc[shown].rename(columns="N = {}".format, level=1)
    table.columns.names = [None, None]
    table.index = pd.Index([method_style(method).label for method in shown])
    return table


def _the_few(pooled: pd.DataFrame) -> list[str]:
    """Return the methods of a table that summary figures show (`MethodStyle.summary`), the last registered first."""
    first: dict[str, str] = {}
    for name in methods_of(pooled):
        known = find(name)
        if known and method_style(name).summary:
            first.setdefault(known.folder, name)
    order = list(STYLES)
    return sorted(first.values(), key=lambda name: order.index(name.partition(" ")[0]), reverse=True)


def _present(pooled: pd.DataFrame, methods: Sequence[str]) -> list[str]:
    """Return the methods present in a table; a family name stands for its first method there."""
    first: dict[str, str] = {}
    for name in methods_of(pooled):
        known = find(name)
        first |= {name: name} | ({known.family: name} if known and known.family not in first else {})
    return list(dict.fromkeys(first[name] for name in methods if name in first))


def _draw(axes: Axes, pooled: pd.DataFrame, methods: Sequence[str], top_n: Sequence[int], column: str) -> None:
    """Draw markers of all methods over N; `column` with "low_", "high_" or "" inserted names the columns."""
    places = np.arange(len(top_n), dtype=float)
    for number, method in enumerate(methods):
        rows = pooled[pooled["method"] == method].set_index("top_n").reindex(list(top_n))
        style = method_style(method)
        at = places + 0.14 * (number - (len(methods) - 1) / 2)  # side by side, or whiskers would hide one another
        value, low, high = (100 * rows[column.format(end)].to_numpy(dtype=float) for end in ("", "low_", "high_"))
        axes.vlines(at, low, high, color=style.color, linewidth=0.9)
        axes.plot(at, value, style.marker, color=style.color, markersize=5, label=style.label)
    axes.set_xticks(places, [f"{n}" for n in top_n])
    axes.set(xlim=(-0.65, len(top_n) - 0.5), ylim=(None, 101))
    axes.grid(axis="x", visible=False)
