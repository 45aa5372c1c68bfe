"""Draws what photographs that extend maps gain, by policy, and what was predicted of them."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context

from wheretolook.figures.floor_plan import BLUE, GREY, INK, RC, VERMILION, new_figure
from wheretolook_paper.evaluation.extend import policies, registrations

LABELS = {
    "random": "random",
    "even": "even spread",
    "worst": "lowest score, apart",
    "walk": "a longer walk",
    "pairs-landmarks": "pairs, by landmarks",
    "pairs-depth": "pairs, by depth images",
    "pairs": "pairs, by the mesh",
}


def extend_figure(table: pd.DataFrame) -> Figure:
    """Draw the gain of each policy with its interval, and predicted against measured shares and registrations."""
    with context(RC):
        figure = new_figure(11.5, 3.6)
        gains, shares, photographs = figure.subplots(1, 3, width_ratios=(1.3, 1, 1))
        _draw_gains(gains, policies(table).set_index("policy"))
        _draw_shares(shares, table)
        _draw_registrations(photographs, registrations(table[table["policy"] == "pairs"]))
        return figure


def _draw_gains(axes: Axes, rows: pd.DataFrame) -> None:
    shown = [name for name in LABELS if name in rows.index]
    for at, name in enumerate(shown):
        row = 100 * rows.loc[name, ["gain", "gain_low", "gain_high"]].astype(float)
        color = VERMILION if name.startswith("pairs") else BLUE
        axes.plot(row.iloc[1:], [at, at], color=color, linewidth=2)
        axes.plot(row.iloc[0], at, "o", color=color)
        axes.annotate(f"{row.iloc[0]:+.1f}", (row.iloc[0], at), (0, 6), textcoords="offset points", ha="center")
    axes.axvline(0, color=INK, linewidth=0.8)
    axes.set_yticks(range(len(shown)), [LABELS[name] for name in shown])
    axes.set(
        xlabel="points more than the present map", title="views within 5 cm and 0.4°", ylim=(-0.5, len(shown) - 0.3)
    )


def _draw_shares(axes: Axes, table: pd.DataFrame) -> None:
    for name, label, color in (("none", "present map", GREY), ("pairs", "ten photographs more", VERMILION)):
        rows = table[table["policy"] == name]
        axes.plot(100 * rows["predicted"], 100 * rows["strict"], "o", color=color, label=label)
    axes.axline((0, 0), slope=1, color=INK, linewidth=0.8)
    axes.set(xlabel="predicted (%)", ylabel="measured (%)", title="share of views, one map each", aspect="equal")
    axes.legend(loc="upper left")


def _draw_registrations(axes: Axes, rows: pd.DataFrame) -> None:
    edges = np.linspace(0, 1, 6)
    groups = rows.groupby(np.clip(np.digitize(rows["p"], edges) - 1, 0, 4))
    means, counts = groups.mean(), groups.size()
    axes.plot(means["p"], means["registered"], "o-", color=VERMILION)
    for (_, row), count in zip(means.iterrows(), counts, strict=True):
        axes.annotate(str(count), (row["p"], row["registered"]), (-10, 7), textcoords="offset points")
    axes.axline((0, 0), slope=1, color=INK, linewidth=0.8)
    axes.set(xlabel="P registers", ylabel="share that registers", title="photographs, and their number")
    axes.set(xlim=(0, 1), ylim=(0, 1.02), aspect="equal")
