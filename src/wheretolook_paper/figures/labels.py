"""Figure of a dataset's localization labels."""

from __future__ import annotations

import textwrap

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context
from matplotlib.ticker import MaxNLocator, NullLocator

from wheretolook.dataset.config import ALL, THRESHOLDS, threshold_key, threshold_label
from wheretolook.dataset.viewpoint_table import POSITIVE
from wheretolook.figures.floor_plan import INK, RC, new_figure
from wheretolook_paper.evaluation.label_report import LabelSummary, threshold_sentence
from wheretolook_paper.figures.style import Style, scene_label

SHADES = ("#08306b", "#86bcdc")
"""Colours of the finest and the coarsest threshold, distinct in greyscale."""

_ENDS = (0, -1)  # the finest and the coarsest threshold
_OUTCOMES = {"localized": ("pose accepted", "#7a7a7a"), "disbelieved": ("pose with too few inliers", "#d9d9d9")}
_TICKS_M = {1e-4: "0.1 mm", 1e-3: "1 mm", 1e-2: "1 cm", 0.1: "10 cm", 1.0: "1 m", 10.0: "10 m"}


def label_figure(summary: LabelSummary) -> Figure:
    """Draw the share of viewpoints that localize per scene, and the distribution of position errors.

    Left: shares within the finest and the coarsest threshold. Right: position errors on a logarithmic axis with both
    thresholds, and a bar of viewpoints without a pose. Rotation errors and shares by height and visible landmarks are
    in `labels.md`.
    """
    with context(RC):
        n_bars = int((summary.shares["scene"] != ALL).sum()) + 1
        figure = new_figure(11.0, max(4.2, 2.0 + 0.33 * n_bars))
        scenes, errors = figure.subplots(1, 2, width_ratios=(1.0, 1.25))
        _draw_scenes(scenes, summary.shares)
        _draw_errors(errors, summary)
        figure.supxlabel("\n".join(textwrap.wrap(threshold_sentence(summary), 125)), fontsize=9)
        return figure


def _draw_scenes(axes: Axes, shares: pd.DataFrame) -> None:
    """Draw one bar per scene, grouped by split, and one for all scenes at the bottom."""
    scenes = shares[shares["scene"] != ALL]
    groups = [scenes[scenes["split"] == split] for split in scenes["split"].unique()]
    rows = pd.concat([*groups, shares.iloc[-1:]], ignore_index=True)
    gaps = rows["split"] != rows["split"].shift(fill_value=rows["split"].iloc[0])
    y = np.arange(len(rows)) + 0.4 * gaps.cumsum().to_numpy()
    for end in reversed(_ENDS):  # the finer over the coarser, which includes it
        values = np.nan_to_num(100 * rows[POSITIVE[end]].to_numpy())
        axes.barh(y, values, 0.72, color=SHADES[end], label=f"within {threshold_label(threshold_key(THRESHOLDS[end]))}")
    for height, share in zip(y, values, strict=True):
        at: Style = {"xytext": (-4, 0), "ha": "right", "color": "white"}
        if share <= 15:
            at = {"xytext": (4, 0), "ha": "left", "color": INK}
        axes.annotate(f"{share:.0f}", (share, height), textcoords="offset points", va="center", fontsize=9, **at)
    names = [f"{scene_label(row.scene)} ({row.split})" for row in rows[:-1].itertuples()]
    # at least six rows high: a few scenes do not get thick bars
    axes.set(yticks=y, yticklabels=[*names, "all scenes"], ylim=(max(y[-1] + 0.6, 5.4), -0.6), xlim=(0, 100))
    axes.set_xlabel("viewpoints that localize (%)")
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="y", length=0)
    axes.legend(reverse=True, loc="lower left", bbox_to_anchor=(0, 1.01), ncols=2, columnspacing=1.4)


def _draw_errors(axes: Axes, summary: LabelSummary) -> None:
    """Draw the histogram of position errors, and a bar of viewpoints without a pose, set apart from it."""
    errors = summary.errors_m
    low = errors["low"].to_numpy()
    high = errors["high"].to_numpy()
    edges: Style = {"align": "edge", "edgecolor": INK, "linewidth": 0.5}
    bottom = np.zeros(len(errors))
    for column, (label, color) in _OUTCOMES.items():
        share = 100 * errors[column].to_numpy() / summary.overall["n_views"]
        axes.bar(low, share, high - low, bottom, color=color, label=label, **edges)
        bottom += share
    step = high[-1] / low[-1]
    end = high[-1] * step**2
    axes.bar(end, 100 * summary.overall["without_pose"], end * (step**2 - 1), color="white", label="no pose", **edges)
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1.06), ncols=3, columnspacing=1.4)
    for shade, threshold in zip(SHADES, _ENDS, strict=True):
        limit = THRESHOLDS[threshold][0]
        axes.axvline(limit, color=shade, linewidth=1.6, linestyle="--")
        name = threshold_label(threshold_key(THRESHOLDS[threshold])).partition(",")[0]
        at: Style = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points", "ha": "center"}
        axes.annotate(name, (limit, 1), (0, 3), fontsize=9, **at)
    axes.set_xscale("log")
    axes.set(xticks=[*_TICKS_M, end * step], xticklabels=[*_TICKS_M.values(), "none"], xlim=(low[0], end * step**2.5))
    axes.set(xlabel="position error of the estimated pose", ylabel="viewpoints (%)")
    axes.tick_params(axis="x", labelsize=8.5)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.grid(axis="x", visible=False)
