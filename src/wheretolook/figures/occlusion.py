"""How much the occlusion model matters."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context

from wheretolook.evaluation.config import threshold_label
from wheretolook.evaluation.report import main_rows, threshold_keys
from wheretolook.evaluation.scores import ALL
from wheretolook.figures.style import INK, RC, method_style, new_figure

_LABELS = {"mesh": "mesh\nrays", "tsdf": "TSDF", "hidden-points": "hidden-point\nremoval", "none": "none"}


def occlusion_figure(scores: pd.DataFrame) -> Figure:
    """Average precision and share of good best views of each method, by occlusion model.

    Args:
        scores: tables of `wheretolook.evaluation.scores.score_table`, one below the other, with a column `occlusion`;
            the rows over all scenes of the first N, and of the first set of candidates, are drawn.

    Returns:
        Two panels with the occlusion models side by side, in their order in the table: average precision, and the share
        at the first threshold, in % of the oracle's, with bootstrap intervals. Choosing at random looks at no landmark
        and is a line, the oracle a line at 100 %.
    """
    scores = main_rows(scores, ("candidates",))
    key, n = threshold_keys(scores)[0], scores["top_n"].iloc[0]
    pooled = scores[(scores["scene"] == ALL) & (scores["top_n"] == n) & (scores["method"] != "oracle")]
    models = list(pooled["occlusion"].unique())
    chosen = "best view" if n == 1 else f"best {n} views"
    with context(RC):
        figure = new_figure(7.4, 4.0)
        left, right = figure.subplots(1, 2)
        _draw_methods(left, pooled, models, "average_precision", 1.0)
        ends = (f"normalized_low_{key}", f"normalized_high_{key}")
        _draw_methods(right, pooled, models, f"normalized_{key}", 100.0, ends)
        left.set(ylabel=f"average precision, {threshold_label(key)}", ylim=(0, 1.03))
        right.set(ylabel=f"{chosen} within {threshold_label(key)},\n% of the oracle's", ylim=(0, 108))
        right.axhline(100, color=INK, linewidth=1, linestyle="--", label=method_style("oracle").label)
        right.set_title("whiskers: 95 % bootstrap interval over locations", fontsize=8)
        for axes in (left, right):
            axes.set(xticks=range(len(models)), xticklabels=[_LABELS.get(model, model) for model in models])
            axes.set(xlim=(-0.5, len(models) - 0.5), xlabel="occlusion model")
            axes.grid(axis="x", visible=False)
            axes.tick_params(axis="x", length=0)
        handles, labels = right.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=4, columnspacing=1.2, handlelength=2.6)
        return figure


def _draw_methods(
    axes: Axes, pooled: pd.DataFrame, models: list[str], column: str, scale: float, ends: tuple[str, ...] = ()
) -> None:
    """Marks of each method at each occlusion model, side by side; `ends` names the columns of its whiskers."""
    methods = list(dict.fromkeys(zip(pooled["method"], pooled["inputs"], strict=True)))
    side_by_side = [method for method in methods if method[0] != "random"]
    for method in methods:
        style = method_style(*method)
        rows = pooled[(pooled["method"] == method[0]) & (pooled["inputs"] == method[1])]
        by_model = scale * rows.set_index("occlusion").reindex(models)[[column, *ends]]
        value = by_model[column].to_numpy()
        if method[0] == "random":
            axes.axhline(value[0], color=style.color, linestyle=style.dashes, label=style.label)
            continue
        x = np.arange(len(models)) + 0.62 * ((side_by_side.index(method) + 0.5) / len(side_by_side) - 0.5)
        axes.plot(x, value, color=style.color, linestyle=style.dashes, linewidth=1, marker=style.marker, markersize=6,
                  label=style.label)  # fmt: skip
        if ends:
            low, high = (by_model[end].to_numpy() for end in ends)
            spread = np.clip(np.nan_to_num([value - low, high - value]), 0, None)
            axes.errorbar(x, value, spread, fmt="none", ecolor=style.color, elinewidth=1, capsize=2)
