"""The figure of planned paths: how much of each localizes."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.style import context

from wheretolook.figures.style import INK, RC, new_figure
from wheretolook.methods.styles import method_style

TITLES = {"planned": "places and views planned", "given": "views along a given path"}


def paths_figure(summary: pd.DataFrame) -> Figure:
    """Share of the views along paths that localize.

    Args:
        summary: of `wheretolook.planning.path_report.summarize_paths`.

    Returns:
        A panel for each task; in it, a group of bars for each scene, and for all of them, a bar for each method, with
        95 % intervals. Views chosen by ActLoc's rule are hatched.
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
                axes.bar(
                    at, value, 0.92 * width, color=style.color, hatch="////" if rule else "", edgecolor="white",
                    linewidth=0.4, label=f"{style.label}{', greedy' if rule else ''}",
                )  # fmt: skip
                # a share may lie outside its interval of few resamples
                axes.errorbar(
                    at, value, np.maximum(0, [value - low, high - value]), fmt="none", ecolor=INK, elinewidth=0.9
                )
            axes.set_title(TITLES.get(task, task))
            axes.set_ylabel("views that localize (%)")
            axes.set_ylim(0, 100)
            axes.set_xticks(np.arange(len(scenes)), [name.replace("_", "\n", 1) for name in scenes])
            axes.grid(axis="x", visible=False)
        named = {
            label: handle for axes in panels for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=3, frameon=False)
        return figure
