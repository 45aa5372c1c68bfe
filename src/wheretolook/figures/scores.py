"""The score figure: methods against thresholds."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.style import context

from wheretolook.evaluation.config import threshold_label
from wheretolook.evaluation.report import threshold_keys
from wheretolook.evaluation.scores import ALL
from wheretolook.figures.style import INK, RC, method_style, new_figure


def score_figure(scores: pd.DataFrame) -> Figure:
    """Localization score of each method at each threshold, one panel for each N.

    Args:
        scores: a table of `wheretolook.evaluation.scores.score_table`; its rows over all scenes are drawn, those of the
            first occlusion model if there are several.

    Returns:
        Bars of the normalized share with bootstrap intervals, the oracle a line at 100 %; a dark line across each bar
        tells the raw share.
    """
    if "occlusion" in scores:
        scores = scores[scores["occlusion"] == scores["occlusion"].iloc[0]]
    pooled = scores[(scores["scene"] == ALL) & (scores["method"] != "oracle")]
    top_n, keys = list(pooled["top_n"].unique()), threshold_keys(scores)
    methods = list(dict.fromkeys(zip(pooled["method"], pooled["inputs"], strict=True)))
    rows = {(row["top_n"], row["method"], row["inputs"]): row for row in pooled.to_dict("records")}
    width = 0.84 / len(methods)
    with context(RC):
        figure = new_figure(9.5, 0.9 + 2.1 * len(top_n))
        panels = figure.subplots(len(top_n), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        for panel, n in zip(panels, top_n, strict=True):
            for slot, method in enumerate(methods):
                row = rows[(n, *method)]
                style = method_style(*method)
                x = np.arange(len(keys)) + (slot - (len(methods) - 1) / 2) * width
                value, low, high, raw = (
                    100 * np.array([row[f"{name}_{key}"] for key in keys])
                    for name in ("normalized", "normalized_low", "normalized_high", "raw")
                )
                panel.bar(x, value, 0.92 * width, color=style.color, hatch=style.hatch, edgecolor="white", linewidth=0,
                          label=style.label)  # fmt: skip
                panel.errorbar(x, value, np.clip(np.nan_to_num([value - low, high - value]), 0, None), fmt="none",
                               ecolor=INK, elinewidth=1, capsize=2)  # fmt: skip
                panel.hlines(raw, x - 0.46 * width, x + 0.46 * width, color=INK, linewidth=1.4)
            panel.axhline(100, color=INK, linewidth=1, linestyle="--")
            chosen = "best view" if n == 1 else f"best {n} views"
            panel.set_ylabel(f"{chosen}\n% of the oracle's")
            panel.set(xticks=np.arange(len(keys)), xticklabels=[f"within {threshold_label(key)}" for key in keys])
            panel.grid(axis="x", visible=False)
            panel.tick_params(axis="x", length=0)
            panel.set_ylim(0, 108)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=min(len(methods), 6), columnspacing=1.2,
                      handlelength=1.6)  # fmt: skip
        note = "whiskers: 95 % bootstrap interval over locations; dark line: share before division by the oracle's"
        panels[-1].annotate(note, (0, -0.24), xycoords="axes fraction", fontsize=8, color=INK)
        return figure
