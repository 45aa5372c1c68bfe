"""Reliability diagrams of predicted probabilities."""

from __future__ import annotations

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context

from wheretolook.evaluation.results import main_rows, methods_of
from wheretolook.figures.floor_plan import GREY, INK, RC, new_figure
from wheretolook_paper.figures.style import Style
from wheretolook_paper.styles import method_style


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
                    _draw(curve, counts, rows[rows["when"] == when])
            curve.set(title=method_style(method).label, xlim=(0, 1), ylim=(0, 1))
            for x, y, text in ((0.3, 0.7, "underconfident"), (0.7, 0.3, "overconfident")):
                curve.text(x, y, text, color=GREY, fontsize=9, ha="center", rotation=45, rotation_mode="anchor")
            curve.legend(handlelength=1.6, borderaxespad=0.2)
            counts.set_xlabel("predicted probability")
            counts.yaxis.set_major_formatter("{x:,.0f}")
        panels[0, 0].set_ylabel("share that localizes")
        panels[1, 0].set_ylabel("viewpoints")
        return figure


def _draw(curve: Axes, counts: Axes, bins: pd.DataFrame) -> None:
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
