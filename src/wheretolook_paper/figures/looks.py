"""Figure of the locations that sets of views localize jointly, by selection strategy."""

from __future__ import annotations

from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context

from wheretolook.figures.floor_plan import BLUE, GREY, INK, RC, VERMILION, new_figure
from wheretolook_paper.evaluation.looks import TOGETHER
from wheretolook_paper.figures.style import GREEN, ORANGE, PURPLE, SKY

_STYLES: dict[str, tuple[str, str, str]] = {
    TOGETHER: ("chosen jointly", BLUE, "o"),
    "one-by-one": ("one by one, 40° apart", ORANGE, "s"),
    "fisher": ("Fisher information of all", GREEN, "^"),
    "visible": ("most landmarks in view", PURPLE, "D"),
    "even": ("evenly spread", SKY, "v"),
    "random": ("drawn at random", GREY, "x"),
}
"""Label, colour and marker of the drawn strategies."""

_TITLES = {"val": "validation scenes", "test": "test scenes, some by others"}


def looks_figure(table: pd.DataFrame) -> Figure:
    """Draw the share of locations localized jointly over the number of views, a panel for each split.

    `table` has the columns of `look_table`, of which `strategy`, `n_looks`, `n_locations`, `good` and `any_good` are
    drawn, `split` if there are several, and the interval of the product's strategy if present. The dashed line is the
    share of locations at which any view of the largest sets localizes alone, an upper bound for choosing one of them.
    """
    splits = [(_TITLES.get(str(name), str(name)), rows) for name, rows in table.groupby("split", sort=False)] \
        if "split" in table else [("", table)]  # fmt: skip
    with context(RC):
        figure = new_figure(3.9 * len(splits) + 2.4, 3.6)
        panels = figure.subplots(1, len(splits), sharey=True, squeeze=False)[0]
        for axes, (title, rows) in zip(panels, splits, strict=True):
            _draw(axes, rows)
            axes.set(title=f"{title}, {rows['n_locations'].iloc[0]} locations" if title else "", xlabel="views")
        panels[0].set_ylabel("locations localized jointly (%)")
        shown = {text: line for axes in panels for line, text in zip(*axes.get_legend_handles_labels(), strict=True)}
        figure.legend(shown.values(), shown.keys(), loc="outside right center")
        return figure


def _draw(axes: Axes, table: pd.DataFrame) -> None:
    for name, (label, color, marker) in _STYLES.items():
        rows = table[table["strategy"] == name].sort_values("n_looks")
        if rows.empty:
            continue
        look: dict[str, Any] = {"color": color, "marker": marker, "markersize": 5}
        look |= {"linewidth": 2.4, "zorder": 4} if name == TOGETHER else {"linewidth": 1.2}
        axes.plot(rows["n_looks"], 100 * rows["good"], label=label, **look)
        if name == TOGETHER:
            if "good_low" in rows:
                low = 100 * rows["good_low"]
                high = 100 * rows["good_high"]
                axes.fill_between(rows["n_looks"], low, high, color=color, alpha=0.15, linewidth=0)
            most = rows.dropna(subset="any_good").nlargest(1, "n_looks")
            for n, value in zip(most["n_looks"], 100 * most["any_good"], strict=True):
                axes.axhline(value, color=INK, linestyle="--", linewidth=1, label=f"any of the {n} alone")
            one = rows[rows["n_looks"] == 1]
            for value in 100 * one["good"]:
                axes.axhline(value, color=VERMILION, linewidth=0.9, linestyle=":", label="one view")
    axes.set_xticks(sorted(table["n_looks"].unique()))
