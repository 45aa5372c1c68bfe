"""The figure of planned paths: how much of each localizes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.style import context

from wheretolook.figures.config import Look
from wheretolook.figures.style import INK, RC, new_figure
from wheretolook.methods.styles import method_style

TITLES = {"planned": "places and views planned", "given": "views along a given path"}


def paths_figure(summary: pd.DataFrame) -> Figure:
    """Share of the views along paths that localize, from `wheretolook.planning.path_report.summarize_paths`.

    A panel for each task, in it a bar for each scene (and all of them) and method, with 95 % intervals; hatched where
    views were chosen by ActLoc's rule.
    """
    with context(RC):
        tasks = list(dict.fromkeys(summary["task"]))
        scenes = list(dict.fromkeys(summary["scene"]))
        figure = new_figure(max(7.0, 1.5 + 1.1 * len(scenes)), 3.1 * len(tasks))
        panels = figure.subplots(len(tasks), 1, sharex=True, squeeze=False)[:, 0]
        for axes, task in zip(panels, tasks, strict=True):
            rows = summary[summary["task"] == task]
            methods = list(dict.fromkeys(rows["method"]))
            width = 0.8 / len(methods)
            for number, method in enumerate(methods):
                of_method = rows[rows["method"] == method].set_index("scene").reindex(scenes)
                at = np.arange(len(scenes)) + (number - (len(methods) - 1) / 2) * width
                name, _, rule = method.partition(" ")
                style = method_style(name)
                value, low, high = (100 * of_method[f"localized{end}"].to_numpy() for end in ("", "_low", "_high"))
                label, hatch = (f"{style.label}, greedy", "////") if rule else (style.label, "")
                look: Look = {"color": style.color, "hatch": hatch, "edgecolor": "white", "linewidth": 0.4}
                axes.bar(at, value, 0.92 * width, label=label, **look)
                whiskers = np.maximum(0, [value - low, high - value])  # few resamples may not enclose the share
                axes.errorbar(at, value, whiskers, fmt="none", ecolor=INK, elinewidth=0.9)
            axes.set(title=TITLES.get(task, task), ylabel="views that localize (%)", ylim=(0, 100))
            axes.set_xticks(np.arange(len(scenes)), [name.replace("_", "\n", 1) for name in scenes])
            axes.grid(axis="x", visible=False)
        named: dict[str, Any] = {}
        for axes in panels:
            handles, labels = axes.get_legend_handles_labels()
            named |= dict(zip(labels, handles, strict=True))
        figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=3, frameon=False)
        return figure
