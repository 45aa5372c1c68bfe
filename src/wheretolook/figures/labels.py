"""The figure of a dataset's labels."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.style import context
from matplotlib.ticker import MaxNLocator, NullLocator
from numpy.typing import NDArray

from wheretolook.figures.config import Look
from wheretolook.figures.style import INK, RC, new_figure
from wheretolook.labelling.report import POSITIVE, LabelSummary, threshold_sentence
from wheretolook.viewpoints.thresholds import ALL, THRESHOLDS, threshold_key, threshold_label

SHADES = ("#08306b", "#2c7bb6", "#86bcdc", "#d3e4f1")
"""Colours of the thresholds, the finest darkest, so that they can be told apart in greyscale."""

_NAMES = tuple(threshold_label(threshold_key(threshold)) for threshold in THRESHOLDS)
_FOUND = {"localized": ("localized", "#7a7a7a", ""), "disbelieved": ("pose with too few inliers", "white", "////")}
_NO_POSE = ("no pose found", "white", "xxxx")

_TICKS_M = {1e-4: "0.1 mm", 1e-3: "1 mm", 1e-2: "1 cm", 0.1: "10 cm", 1.0: "1 m", 10.0: "10 m"}
_TICKS_DEG = {1e-3: "0.001°", 0.01: "0.01°", 0.1: "0.1°", 1.0: "1°", 10.0: "10°", 100.0: "100°"}


def label_figure(summary: LabelSummary) -> Figure:
    """Shares of positive labels and histograms of the errors, from `wheretolook.labelling.report.label_summary`.

    Left: share of positives of each scene and of all, at each threshold; a diamond is the share of locations with a
    positive viewpoint. Right: histograms of position and rotation errors on logarithmic axes, thresholds as lines,
    viewpoints without a pose as a bar of their own; then the share of positives by the camera's height and by the
    number of landmarks in view.
    """
    with context(RC):
        n_bars = int((summary.shares["scene"] != ALL).sum()) + 1
        figure = new_figure(12.5, max(6.8, 2.4 + 0.33 * n_bars))
        grid = figure.add_gridspec(2, 3, width_ratios=(1.0, 1.15, 1.15))
        scenes = figure.add_subplot(grid[:, 0])
        _draw_scenes(scenes, summary.shares)
        metres, degrees = zip(*THRESHOLDS, strict=True)
        names_m = [name.split(",")[0] for name in _NAMES]
        for column, errors, limits, names, ticks, name in (
            (1, summary.errors_m, metres, names_m, _TICKS_M, "position error"),
            (2, summary.errors_deg, degrees, [f"{limit:g}°" for limit in degrees], _TICKS_DEG, "rotation error"),
        ):
            axes = figure.add_subplot(grid[0, column])
            _draw_errors(axes, errors, summary.overall, limits, names, ticks)
            axes.set(xlabel=name, ylabel="viewpoints (%)")
        for column, bands, name in (
            (1, summary.by_height, "height above the scene's lowest location (m)"),
            (2, summary.by_visible, "visible landmarks"),
        ):
            axes = figure.add_subplot(grid[1, column])
            _draw_bands(axes, bands)
            axes.set_xlabel(name)
        _draw_legend(figure, scenes)
        figure.supxlabel("\n".join(textwrap.wrap(threshold_sentence(summary), 150)), fontsize=9)
        return figure


def _draw_scenes(axes: Axes, shares: pd.DataFrame) -> None:
    """A bar for each scene, grouped by split, and for all scenes at the bottom."""
    scenes = shares[shares["scene"] != ALL]
    order = [*dict.fromkeys(scenes["split"])]
    scenes = scenes.iloc[np.argsort([order.index(split) for split in scenes["split"]], kind="stable")]
    rows = pd.concat([scenes, shares.iloc[-1:]], ignore_index=True)
    gaps = rows["split"] != rows["split"].shift(fill_value=rows["split"].iloc[0])
    y = np.arange(len(rows)) + 0.4 * gaps.cumsum().to_numpy()
    _stack(axes.barh, y, rows, 0.72)
    mark: Look = {"color": "white", "markeredgecolor": INK, "markersize": 5, "clip_on": False}
    label = f"locations with a viewpoint\nwithin {_NAMES[0]}"
    axes.plot(100 * rows["locations_positive"], y, "D", label=label, **mark)
    names = [scene if split == ALL else f"{scene} ({split})" for scene, split in rows[["scene", "split"]].to_numpy()]
    # at least six rows high, so that few scenes do not get thick bars
    axes.set(yticks=y, yticklabels=names, ylim=(max(y[-1] + 0.6, 5.4), -0.6), xlim=(0, 100), xlabel="positive (%)")
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="y", length=0)


def _draw_bands(axes: Axes, bands: pd.DataFrame) -> None:
    """A bar for each band of values, between ticks at its ends, with its number of viewpoints above."""
    x = np.arange(len(bands))
    _stack(axes.bar, x, bands, 0.8)
    tops = np.nan_to_num(100 * bands[POSITIVE[-1]].to_numpy())
    for place, top, number in zip(x, tops, bands["n_views"], strict=True):
        axes.annotate(f"{number:,}", (place, top), (0, 2), textcoords="offset points", ha="center", fontsize=7.5)
    ends = [*bands["low"], bands["high"].iloc[-1]]
    axes.set_xticks(np.arange(len(ends)) - 0.5, ["∞" if np.isinf(end) else f"{end:,g}" for end in ends])
    axes.set(xlim=(-0.5, len(bands) - 0.5), ylim=(0, 108), yticks=range(0, 101, 20), ylabel="positive (%)")
    axes.tick_params(axis="x", labelsize=8.5)
    axes.set_title("above each bar: number of viewpoints", fontsize=8)
    axes.grid(axis="x", visible=False)


def _stack(bar, places: NDArray[Any], rows: pd.DataFrame, width: float) -> None:  # type: ignore[no-untyped-def]
    """Bars of the share of positives at each threshold, each drawn over the next coarser one, which includes it."""
    for name, shade in reversed(list(zip(POSITIVE, SHADES, strict=True))):
        bar(places, np.nan_to_num(100 * rows[name].to_numpy()), width, color=shade)


def _draw_errors(
    axes: Axes, errors: pd.DataFrame, row: Any, limits: Sequence[float], names: Sequence[str], ticks: dict[float, str]
) -> None:
    low, high = errors["low"].to_numpy(), errors["high"].to_numpy()
    edges: Look = {"align": "edge", "edgecolor": INK, "linewidth": 0.5}
    below = np.zeros(len(errors))
    for column, (_, color, hatch) in _FOUND.items():
        share = 100 * errors[column].to_numpy() / row["n_views"]
        axes.bar(low, share, high - low, below, color=color, hatch=hatch, **edges)
        below += share
    step = high[-1] / low[-1]
    end = high[-1] * step**2  # the bar of viewpoints without a pose stands apart from the errors
    _, color, hatch = _NO_POSE
    axes.bar(end, 100 * row["without_pose"], end * (step**2 - 1), color=color, hatch=hatch, **edges)
    beside: Look = {"textcoords": "offset points", "rotation": 90, "ha": "center", "va": "bottom", "fontsize": 8}
    for limit, name, shade in zip(limits, names, SHADES, strict=True):
        axes.axvline(limit, color=INK, linewidth=1, linestyle=":")
        axes.annotate(name, (limit, 1), (0, 6), xycoords=("data", "axes fraction"), **beside)
        axes.plot(limit, 1, "s", color=shade, transform=axes.get_xaxis_transform(), clip_on=False, markersize=4)
    axes.set_xscale("log")
    axes.set(xticks=[*ticks, end * step], xticklabels=[*ticks.values(), "no\npose"], xlim=(low[0], end * step**2.5))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.tick_params(axis="x", labelsize=8.5)
    axes.grid(axis="x", visible=False)


def _draw_legend(figure: Figure, scenes: Axes) -> None:
    handles = [Patch(color=shade, label=f"positive within {name}") for name, shade in zip(_NAMES, SHADES, strict=True)]
    handles += [
        Patch(facecolor=color, hatch=hatch, edgecolor=INK, linewidth=0.5, label=label)
        for label, color, hatch in (*_FOUND.values(), _NO_POSE)
    ]
    handles_of_scenes = scenes.get_legend_handles_labels()[0]
    figure.legend(handles=[*handles, *handles_of_scenes], loc="outside upper center", ncols=4, columnspacing=1.6)
