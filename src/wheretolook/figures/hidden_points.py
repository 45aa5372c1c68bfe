"""How hidden-point removal depends on its radius."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.style import context

from wheretolook.figures.style import INK, RC, new_figure

_THIN = "#8c8c8c"

_MEASURES = {
    "precision": ("precision", "#0072B2", (0, (5, 1.5)), "^"),
    "recall": ("recall", "#D55E00", (0, (1, 1)), "s"),
    "f1": ("F1", "#000000", "-", "o"),
}


def hidden_points_figure(curves: pd.DataFrame, default_radius: float | None = None) -> Figure:
    """Precision, recall and F1 of hidden-point removal against the mesh's occlusion, over the radius.

    Args:
        curves: one row for each scene and radius, with `scene`, `radius`, `precision`, `recall` and `f1`; every scene
            has the same radii.
        default_radius: marked by a vertical line.

    Returns:
        One panel with a logarithmic radius: the mean over scenes of each measure, and thin lines for the F1 of each
        scene, a ring at its greatest.
    """
    scenes = [scene.sort_values("radius") for _, scene in curves.groupby("scene")]
    with context(RC):
        figure = new_figure(6.4, 4.0)
        axes = figure.subplots()
        for number, scene in enumerate(scenes if len(scenes) > 1 else ()):
            best = int(scene["f1"].to_numpy().argmax())
            label = "" if number else "F1 of a scene, its best"
            axes.plot(scene["radius"], scene["f1"], color=_THIN, linewidth=0.9, marker="o", markevery=[best],
                      markersize=6, markerfacecolor="white", label=label)  # fmt: skip
        for measure, (label, color, dashes, marker) in _MEASURES.items():
            mean = curves.groupby("radius")[measure].mean()
            axes.plot(mean.index, mean, color=color, linestyle=dashes, marker=marker, markersize=4.5, label=label)
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.set(ylim=(0, 1.02), yticks=np.linspace(0, 1, 6))
        axes.set(xlabel="radius of the flip / distance of the farthest landmark", ylabel="agreement with the mesh")
        if default_radius is not None:
            axes.axvline(default_radius, color=INK, linewidth=1, zorder=0.9)
            axes.annotate(f"default {default_radius:g}", (default_radius, 0.03), xytext=(4, 0), fontsize=9,
                          textcoords="offset points")  # fmt: skip
        mean_of = f"mean of {len(scenes)} scenes" if len(scenes) > 1 else str(curves["scene"].iloc[0])
        figure.legend(loc="outside upper center", ncols=4, title=mean_of, title_fontsize=9, reverse=True)
        return figure
