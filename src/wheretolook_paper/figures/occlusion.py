"""Figure of each method's scores by occlusion model."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.style import context

from wheretolook.dataset.config import ALL, threshold_label
from wheretolook.evaluation.results import ORACLE, is_random, main_rows, methods_of, threshold_keys
from wheretolook.figures.floor_plan import INK, RC, new_figure
from wheretolook_paper.figures.scores import methods_to_show
from wheretolook_paper.styles import method_style

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
        _draw(left, pooled, models, y, "average_precision", 1.0)
        columns = (f"normalized_{end}{key}" for end in ("", "low_", "high_"))
        _draw(right, pooled, models, y, next(columns), 100.0, *columns)
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


def _draw(
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
