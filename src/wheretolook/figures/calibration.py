"""Whether predicted probabilities mean what they say."""

from __future__ import annotations

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context

from wheretolook.evaluation.score_table import main_rows, methods_of
from wheretolook.figures.config import Look
from wheretolook.figures.style import GREY, INK, RC, new_figure
from wheretolook.scorers.method import MethodStyle
from wheretolook.scorers.styles import method_style

_BEFORE = "before"
_AFTER = "after"


def calibration_figure(table: pd.DataFrame) -> Figure:
    """Reliability diagram of each learned method before (open marks) and after temperature scaling (filled).

    One column for each method: above, the share of good views over the mean prediction of each bin; below, the number
    of views in each bin. Above the diagonal a method is too careful, below it too sure. `table` is `calibration.csv` of
    the evaluate stage: a row for each method, `when` ("before", "after") and bin. Of several occlusion models or sets
    of candidates the first is drawn.
    """
    table = main_rows(table)
    methods = methods_of(table)
    with context(RC):
        figure = new_figure(0.9 + 2.8 * len(methods), 4.3)
        panels = figure.subplots(2, len(methods), sharex=True, sharey="row", squeeze=False, height_ratios=(3, 1))
        for (curve, counts), method in zip(panels.T, methods, strict=True):
            style = method_style(method)
            rows = table[table["method"] == method]
            curve.plot([0, 1], [0, 1], color=INK, linewidth=1, linestyle="--")
            for when in (_BEFORE, _AFTER):
                part = rows[rows["when"] == when].sort_values("bin_low")
                if len(part):
                    _draw(curve, counts, part, style, when)
            curve.set(title=style.label, xlim=(0, 1), ylim=(0, 1))
            for x, y, text in ((0.3, 0.7, "too careful"), (0.7, 0.3, "too sure")):
                curve.text(x, y, text, color=GREY, fontsize=9, ha="center", rotation=45, rotation_mode="anchor")
            curve.legend(handlelength=1.6, borderaxespad=0.2)
            counts.set_xlabel("predicted probability")
            counts.yaxis.set_major_formatter("{x:,.0f}")
        panels[0, 0].set_ylabel("share that localizes")
        panels[1, 0].set_ylabel("viewpoints")
        return figure


def _draw(curve: Axes, counts: Axes, part: pd.DataFrame, style: MethodStyle, when: str) -> None:
    scaled = when == _AFTER
    line: Look = {"color": style.color, "linewidth": 1.2, "linestyle": "-" if scaled else ":"}
    mark: Look = {"marker": style.marker, "markersize": 5, "markerfacecolor": style.color if scaled else "white"}
    label = f"T = {part['temperature'].iloc[0]:.2f}" if scaled else "as predicted"
    label += f": ECE {part['ece'].iloc[0]:.3f}"
    known = part[part["n"] > 0]
    where: Look = {"clip_on": False, "zorder": 3 if scaled else 2.5}
    curve.plot(known["mean_predicted"], known["share_good"], label=label, **line, **mark, **where)
    counts.stairs(part["n"], [*part["bin_low"], part["bin_high"].iloc[-1]], **line)
