"""Figure of learning curves."""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.style import context

from wheretolook.figures.floor_plan import RC, new_figure
from wheretolook_paper.figures.style import Style
from wheretolook_paper.styles import method_style


def training_figure(histories: Mapping[str, pd.DataFrame]) -> Figure:
    """Draw loss and average precision over epochs (from 1), with a ring at the best validation average precision.

    `histories` have, for each method, a row for each epoch with `epoch`, `train_bce`, `val_bce`,
    `train_average_precision` and `val_average_precision`.
    """
    with context(RC):
        figure = new_figure(9, 3.4)
        panels = figure.subplots(1, 2)
        for method, history in histories.items():
            style = method_style(method)
            dotted: Style = {"linestyle": ":", "linewidth": 1.1, "label": f"{style.label}: training"}
            solid: Style = {"linestyle": "-", "label": f"{style.label}: validation"}
            for panel, name in zip(panels, ("bce", "average_precision"), strict=True):
                panel.plot(1 + history["epoch"], history[f"train_{name}"], color=style.color, **dotted)
                panel.plot(1 + history["epoch"], history[f"val_{name}"], color=style.color, **solid)
            best = history.iloc[int(history["val_average_precision"].to_numpy().argmax())]
            ring: Style = {"marker": "o", "markersize": 8, "markerfacecolor": "none", "color": style.color}
            panels[1].plot(1 + best["epoch"], best["val_average_precision"], linestyle="none", **ring)
        panels[0].set(xlabel="epoch (log)", ylabel="weighted cross-entropy")
        panels[1].set(xlabel="epoch (log)", ylabel="average precision")
        for panel in panels:  # some methods train for eight epochs, others for hundreds
            panel.set_xscale("log")
            panel.xaxis.set_major_formatter("{x:g}")
        handles, labels = panels[1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=max(1, len(histories)))
        return figure
