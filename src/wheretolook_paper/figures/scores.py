"""Figures of score tables: by method and threshold, by the number of views and by occlusion; calibration and training."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.style import context
from matplotlib.ticker import MaxNLocator

from wheretolook.dataset.config import ALL, threshold_label
from wheretolook.evaluation.results import ORACLE, is_random, main_rows, methods_of, reference_of, threshold_keys
from wheretolook.figures.floor_plan import GREY, INK, RC, new_figure
from wheretolook.geometry.poses import Float
from wheretolook.scorers.registry import find
from wheretolook_paper.evaluation.paper_tables import PAPER
from wheretolook_paper.figures.style import PRINT, TWO_COLUMNS_IN, Style
from wheretolook_paper.styles import STYLES, method_group, method_style

_MAX_METHODS = {"Fisher": 3, "probes": 0}  # the best methods of a group that a figure shows; all of other groups
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
        # labels of more characters are broken into two lines
        labels = [",\n".join(label.rsplit(", ", 1)) if len(label) > 36 else label for label in labels]
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
    present = methods_of(pooled)
    shown = [name for name in methods if name in present] or _the_few(pooled)
    top_n = [int(n) for n in pooled["top_n"].unique()]
    with context(PRINT):
        figure = new_figure(TWO_COLUMNS_IN, 4.6)
        panels = figure.subplots(len(ROWS), len(keys), sharex=True, sharey="row", squeeze=False)
        for line, (column, name) in zip(panels, ROWS.items(), strict=True):
            for index, (axes, key) in enumerate(zip(line, keys, strict=True)):
                _draw_numbers(axes, pooled, shown, top_n, f"{column}_{{}}{key}")
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


def _draw_numbers(axes: Axes, pooled: pd.DataFrame, methods: Sequence[str], top_n: Sequence[int], column: str) -> None:
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


_LABELS = {"mesh": "mesh rays", "tsdf": "TSDF", "hidden-points": "hidden-point removal", "none": "none: through walls"}
_MARKERS = ("o", "s", "^", "D")


def occlusion_figure(scores: pd.DataFrame) -> Figure:
    """Draw the average precision and the share of good best views of each method by occlusion model.

    The share is that at the finest threshold, in % of the oracle's, with bootstrap intervals. A row for each method, a
    mark for each occlusion model; the random choice and the oracle are lines. Shown are the methods that
    `figures.scores.methods_to_show` chooses and that occlusion changes, on axes that begin where the marks do.
    `scores` are tables of `wheretolook.evaluation.results.score_table`, one below the other, with a column `occlusion`;
    the rows over all scenes, of the first N and the first set of candidates, are drawn.
    """
    scores = main_rows(scores, ("candidates",))
    key = threshold_keys(scores)[0]
    n = scores["top_n"].iloc[0]
    pooled = scores[(scores["scene"] == ALL) & (scores["top_n"] == n) & (scores["method"] != ORACLE)]
    models = list(pooled["occlusion"].unique())
    chosen = "best view" if n == 1 else f"best {n} views"
    first = pooled[pooled["occlusion"] == models[0]]
    methods = [method for method in methods_to_show(first, key) if not is_random(method)]
    methods = [method for method in methods if _depends(pooled[pooled["method"] == method])] or methods
    y = {method: float(row) for row, method in enumerate(methods)}
    with context(RC):
        figure = new_figure(8.0, 1.5 + 0.3 * (max(y.values(), default=0) + 1))
        left, right = figure.subplots(1, 2, sharey=True)
        _draw_method(left, pooled, models, y, "average_precision", 1.0)
        columns = (f"normalized_{end}{key}" for end in ("", "low_", "high_"))
        _draw_method(right, pooled, models, y, next(columns), 100.0, *columns)
        left.set(xlabel=f"average precision\n{threshold_label(key)}", xlim=(_begin(left, 0.1), 1.02))
        right.set(
            xlabel=f"{chosen} within {threshold_label(key)}\n% of the oracle's share", xlim=(_begin(right, 10), 104)
        )
        figure.supxlabel("whiskers: 95 % bootstrap interval over locations", fontsize=8)
        right.axvline(100, color=INK, linewidth=1, linestyle="--", label=method_style(ORACLE).label)
        left.set_yticks(list(y.values()), [method_style(method).label for method in y], fontsize=9)
        left.set_ylim(max(y.values(), default=0) + 0.7, -0.7)
        for axes in (left, right):
            axes.tick_params(axis="y", length=0)
        names = [_LABELS.get(model, model) for model in models]
        handles = [Line2D([], [], linestyle="none", label=x, **_mark(n, INK)) for n, x in enumerate(names)]
        labels = [method_style(name).label for name in (ORACLE, *filter(is_random, methods_of(pooled)))]
        handles += [line for line in right.lines if line.get_label() in labels]
        figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), columnspacing=1.4)
        return figure


def _depends(rows: pd.DataFrame) -> bool:
    """Return whether a method's scores depend on the occlusion model."""
    return rows["average_precision"].nunique(dropna=False) > 1


def _begin(axes: Axes, step: float) -> float:
    """Return the start of an axis: the multiple of `step` below the data, at least 0."""
    return max(0.0, float(step * np.floor(axes.dataLim.x0 / step)))


def _mark(number: int, color: str) -> dict[str, Any]:
    """Return the marker style of an occlusion model by its number; the first is filled."""
    fill = color if number == 0 else "white"
    return {"marker": _MARKERS[number % len(_MARKERS)], "color": color, "markersize": 6, "markerfacecolor": fill}


def _draw_method(
    axes: Axes, pooled: pd.DataFrame, models: list[str], y: dict[str, float], column: str, scale: float, *ends: str
) -> None:
    """Draw a method's markers, joined by a line, or with whiskers if `ends` names their columns."""
    for method, place in y.items():
        style = method_style(method)
        rows = pooled[pooled["method"] == method]
        by_model = scale * rows.set_index("occlusion").reindex(models)[[column, *ends]]
        shift = 0.2 * (np.arange(len(models)) - (len(models) - 1) / 2) if ends else np.zeros(len(models))
        joined = "none" if ends else "-"
        axes.plot(
            by_model[column], place + shift, color=style.color, linewidth=0.8, linestyle=joined, label=style.label
        )
        for number, value in enumerate(by_model[column]):
            if ends:
                low, high = (by_model[end].iloc[number] for end in ends)
                axes.hlines(place + shift[number], low, high, color=style.color, linewidth=0.9)
            axes.plot(value, place + shift[number], **_mark(number, style.color), linestyle="none")
    for method in filter(is_random, methods_of(pooled)):
        style = method_style(method)
        value = scale * pooled.loc[pooled["method"] == method, column].iloc[0]
        axes.axvline(value, color=style.color, linestyle=style.dashes, label=style.label, zorder=1)


def calibration_figure(table: pd.DataFrame) -> Figure:
    """Draw the reliability diagram of each learned method before (open marks) and after (filled) temperature scaling.

    `table` is `calibration.csv` of the evaluate stage: one row per method, `when` ("before", "after") and bin; only
    rows of the first occlusion model and candidate set are drawn. Each method is a column of two panels: the share of
    good views over the mean prediction of each bin, and the number of views per bin.
    """
    table = main_rows(table)
    methods = methods_of(table)
    with context(RC):
        figure = new_figure(0.9 + 2.8 * len(methods), 4.3)
        panels = figure.subplots(2, len(methods), sharex=True, sharey="row", squeeze=False, height_ratios=(3, 1))
        for (curve, counts), method in zip(panels.T, methods, strict=True):
            curve.plot([0, 1], [0, 1], color=INK, linewidth=1, linestyle="--")
            rows = table[table["method"] == method].sort_values("bin_low")
            for when in ("before", "after"):
                if (rows["when"] == when).any():
                    _draw_curve(curve, counts, rows[rows["when"] == when])
            curve.set(title=method_style(method).label, xlim=(0, 1), ylim=(0, 1))
            for x, y, text in ((0.3, 0.7, "underconfident"), (0.7, 0.3, "overconfident")):
                curve.text(x, y, text, color=GREY, fontsize=9, ha="center", rotation=45, rotation_mode="anchor")
            curve.legend(handlelength=1.6, borderaxespad=0.2)
            counts.set_xlabel("predicted probability")
            counts.yaxis.set_major_formatter("{x:,.0f}")
        panels[0, 0].set_ylabel("share that localizes")
        panels[1, 0].set_ylabel("viewpoints")
        return figure


def _draw_curve(curve: Axes, counts: Axes, bins: pd.DataFrame) -> None:
    """Draw the bins of one method before or after scaling."""
    first = bins.iloc[0]
    style = method_style(first["method"])
    scaled = first["when"] == "after"
    line: Style = {"color": style.color, "linewidth": 1.2, "linestyle": "-" if scaled else ":"}
    mark: Style = {"marker": style.marker, "markersize": 5, "markerfacecolor": style.color if scaled else "white"}
    name = f"T = {first['temperature']:.2f}" if scaled else "as predicted"
    filled = bins[bins["n"] > 0]
    points = filled[["mean_predicted", "share_good"]].to_numpy().T
    label = f"{name}: ECE {first['ece']:.3f}"
    curve.plot(*points, label=label, clip_on=False, zorder=3 if scaled else 2.5, **line, **mark)
    counts.stairs(bins["n"], [*bins["bin_low"], bins["bin_high"].iloc[-1]], **line)


def training_figure(histories: Mapping[str, pd.DataFrame]) -> Figure:
    """Draw loss and average precision over epochs (from 1), with a ring at the best validation average precision.

    `histories` have, for each method, a row for each epoch with `epoch`, `train_bce`, `val_bce`,
    `train_average_precision` and `val_average_precision`.
    """
    with context(RC):
        figure = new_figure(9, 3.4)
        panels = figure.subplots(1, 2)
        for method, history in histories.items():
            style = method_style(method)
            dotted: Style = {"linestyle": ":", "linewidth": 1.1, "label": f"{style.label}: training"}
            solid: Style = {"linestyle": "-", "label": f"{style.label}: validation"}
            for panel, name in zip(panels, ("bce", "average_precision"), strict=True):
                panel.plot(1 + history["epoch"], history[f"train_{name}"], color=style.color, **dotted)
                panel.plot(1 + history["epoch"], history[f"val_{name}"], color=style.color, **solid)
            best = history.iloc[int(history["val_average_precision"].to_numpy().argmax())]
            ring: Style = {"marker": "o", "markersize": 8, "markerfacecolor": "none", "color": style.color}
            panels[1].plot(1 + best["epoch"], best["val_average_precision"], linestyle="none", **ring)
        panels[0].set(xlabel="epoch (log)", ylabel="weighted cross-entropy")
        panels[1].set(xlabel="epoch (log)", ylabel="average precision")
        for panel in panels:  # some methods train for eight epochs, others for hundreds
            panel.set_xscale("log")
            panel.xaxis.set_major_formatter("{x:g}")
        handles, labels = panels[1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=max(1, len(histories)))
        return figure
