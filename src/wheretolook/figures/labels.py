"""The figure of a dataset's labels."""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context
from matplotlib.ticker import MaxNLocator, NullLocator

from wheretolook.dataset.thresholds import ALL, THRESHOLDS, threshold_key, threshold_label
from wheretolook.figures.config import Look
from wheretolook.figures.style import INK, RC, new_figure, scene_label
from wheretolook.localization.report import POSITIVE, LabelSummary, threshold_sentence

SHADES = ("#08306b", "#86bcdc")
"""Colours of the finest and of the coarsest threshold, so that they can be told apart in greyscale."""

_ENDS = (0, -1)  # of the thresholds, those that are drawn
_NAMES = tuple(threshold_label(threshold_key(THRESHOLDS[end])) for end in _ENDS)
_FOUND = {"localized": ("pose believed", "#7a7a7a"), "disbelieved": ("pose with too few inliers", "#d9d9d9")}
_NO_POSE = ("no pose", "white")

_TICKS_M = {1e-4: "0.1 mm", 1e-3: "1 mm", 1e-2: "1 cm", 0.1: "10 cm", 1.0: "1 m", 10.0: "10 m"}


def label_figure(summary: LabelSummary) -> Figure:
    """How many views localize in each scene, and how far off their poses are, of the labels of a dataset.

    Left: share of the viewpoints of each scene and of all that localize, at the finest and at the coarsest threshold.
    Right: the position errors on a logarithmic axis, with both thresholds, and a bar for viewpoints without a pose:
    where few errors lie between the thresholds, it hardly matters which is taken. Rotation errors, and shares by height
    and by landmarks in view, stand in `labels.md`.
    """
    with context(RC):
        n_bars = int((summary.shares["scene"] != ALL).sum()) + 1
        figure = new_figure(11.0, max(4.2, 2.0 + 0.33 * n_bars))
        scenes, errors = figure.subplots(1, 2, width_ratios=(1.0, 1.25))
        _draw_scenes(scenes, summary.shares)
        _draw_errors(errors, summary.errors_m, summary.overall)
        figure.supxlabel("\n".join(textwrap.wrap(threshold_sentence(summary), 125)), fontsize=9)
        return figure


def _draw_scenes(axes: Axes, shares: pd.DataFrame) -> None:
    """A bar for each scene, grouped by split, and for all scenes at the bottom; the coarser includes the finer."""
    scenes = shares[shares["scene"] != ALL]
    order = [*dict.fromkeys(scenes["split"])]
    scenes = scenes.iloc[np.argsort([order.index(split) for split in scenes["split"]], kind="stable")]
    rows = pd.concat([scenes, shares.iloc[-1:]], ignore_index=True)
    gaps = rows["split"] != rows["split"].shift(fill_value=rows["split"].iloc[0])
    y = np.arange(len(rows)) + 0.4 * gaps.cumsum().to_numpy()
    for end in reversed(_ENDS):
        values = np.nan_to_num(100 * rows[POSITIVE[end]].to_numpy())
        axes.barh(y, values, 0.72, color=SHADES[end], label=f"within {_NAMES[end]}")
    for place, share in zip(y, values, strict=True):
        inside = share > 15
        axes.annotate(
            f"{share:.0f}", (share, place), (-4 if inside else 4, 0), textcoords="offset points", va="center",
            ha="right" if inside else "left", fontsize=9, color="white" if inside else INK,
        )  # fmt: skip
    names = [
        "all scenes" if split == ALL else f"{scene_label(scene)} ({split})"
        for scene, split in rows[["scene", "split"]].to_numpy()
    ]
    # at least six rows high, so that few scenes do not get thick bars
    axes.set(yticks=y, yticklabels=names, ylim=(max(y[-1] + 0.6, 5.4), -0.6), xlim=(0, 100))
    axes.set_xlabel("viewpoints that localize (%)")
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="y", length=0)
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles[::-1], labels[::-1], loc="lower left", bbox_to_anchor=(0, 1.01), ncols=2, columnspacing=1.4)


def _draw_errors(axes: Axes, errors: pd.DataFrame, row: Any) -> None:
    low = errors["low"].to_numpy()
    high = errors["high"].to_numpy()
    edges: Look = {"align": "edge", "edgecolor": INK, "linewidth": 0.5}
    below = np.zeros(len(errors))
    for column, (label, color) in _FOUND.items():
        share = 100 * errors[column].to_numpy() / row["n_views"]
        axes.bar(low, share, high - low, below, color=color, label=label, **edges)
        below += share
    step = high[-1] / low[-1]
    end = high[-1] * step**2  # the bar of viewpoints without a pose stands apart from the errors
    label, color = _NO_POSE
    axes.bar(end, 100 * row["without_pose"], end * (step**2 - 1), color=color, label=label, **edges)
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1.06), ncols=3, columnspacing=1.4)
    for shade, (limit, _) in zip(SHADES, (THRESHOLDS[end] for end in _ENDS), strict=True):
        axes.axvline(limit, color=shade, linewidth=1.6, linestyle="--")
        name = f"{100 * limit:g} cm" if limit < 0.5 else f"{limit:g} m"
        axes.annotate(
            name, (limit, 1), (0, 3), xycoords=("data", "axes fraction"), textcoords="offset points", ha="center",
            fontsize=9,
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set(xticks=[*_TICKS_M, end * step], xticklabels=[*_TICKS_M.values(), "none"], xlim=(low[0], end * step**2.5))
    axes.set(xlabel="position error of the pose found", ylabel="viewpoints (%)")
    axes.tick_params(axis="x", labelsize=8.5)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.grid(axis="x", visible=False)
