"""Figure of the share of views along planned paths that localize."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.style import context

from wheretolook.dataset.config import ALL
from wheretolook.figures.floor_plan import INK, RC, new_figure
from wheretolook_paper.figures.style import Style, scene_label
from wheretolook_paper.styles import method_style

FILLED = {"greedy": "full", "with stops": "left"}
"""Fill of markers by the suffix of a method's name."""

TITLES = {"planned": "each method plans places and views", "given": "each method turns the camera along given paths"}
NAMES = {"forward": "looking ahead", "greedy": "by ActLoc's greedy rule"}
"""Labels that differ from tables: of methods and of suffixes."""


def paths_figure(summary: pd.DataFrame) -> Figure:
    """Draw the share of views along paths that localize, from the table of `summarize_paths`.

    A panel for each task has a row for each scene, all scenes first, and a marker for each method with its 95 %
    interval: open for views chosen by ActLoc's rule, half filled for jointly localized views.
    """
    with context(RC):
        tasks = list(dict.fromkeys(summary["task"]))
        scenes = sorted(dict.fromkeys(summary["scene"]), key=lambda name: name != ALL)
        figure = new_figure(2.0 + 4.0 * len(tasks), 1.3 + 0.55 * len(scenes))
        panels = figure.subplots(1, len(tasks), sharex=True, sharey=True, squeeze=False)[0]
        for axes, task in zip(panels, tasks, strict=True):
            rows = summary[summary["task"] == task]
            methods = list(dict.fromkeys(rows["method"]))
            for number, method in enumerate(methods):
                of_method = rows[rows["method"] == method].set_index("scene").reindex(scenes)
                at = np.arange(len(scenes)) + 0.7 * ((number + 0.5) / len(methods) - 0.5)
                name, _, rule = method.partition(" ")
                style = method_style(name)
                value, low, high = (100 * of_method[f"localized{end}"].to_numpy() for end in ("", "_low", "_high"))
                axes.hlines(at, low, high, color=style.color, linewidth=1.2)
                fill = FILLED.get(rule, "bottom" if rule else "full")
                face = "white" if rule == "greedy" else style.color
                look: Style = {"markersize": 6, "fillstyle": fill, "markerfacecolor": face}
                look["markerfacecoloralt"] = "white"
                label = NAMES.get(name, style.label)
                label += f", {NAMES.get(rule, rule)}" if rule else ""
                axes.plot(value, at, style.marker, color=style.color, label=label, **look)
            axes.set_title(TITLES.get(task, task))
            axes.set_xlabel("views along the paths that localize (%)")
            axes.axhline(0.5, color=INK, linewidth=0.8)
            axes.grid(axis="y", visible=False)
            axes.tick_params(axis="y", length=0)
        names = ["all scenes" if name == ALL else scene_label(name) for name in scenes]
        panels[0].set_yticks(np.arange(len(scenes)), names)
        panels[0].set(ylim=(len(scenes) - 0.5, -0.5), xlim=(None, 101))
        named: dict[str, Any] = {}
        for axes in panels:
            handles, labels = axes.get_legend_handles_labels()
            named |= dict(zip(labels, handles, strict=True))
        figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=3, frameon=False)
        return figure
