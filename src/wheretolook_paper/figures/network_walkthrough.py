"""The paper's figure of the network with real values: a view, its bins, the hidden layers, the score."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch
from matplotlib.style import context

from wheretolook.figures.floor_plan import BLUE, INK, VERMILION, frame, new_figure
from wheretolook.geometry.poses import Float
from wheretolook_paper.figures.inputs import BinnedImage, draw_counts, draw_landmarks
from wheretolook_paper.figures.style import PRINT, TWO_COLUMNS_IN, Style

_COLUMNS = 12  # of a hidden layer's values
_WIDE = 10  # letters below the score


def learning_figure(image: BinnedImage, activations: Sequence[Float], channels: Sequence[str], outcome: str) -> Figure:
    """Draw the image with landmarks, landmarks by bin, standardized channels, hidden layers (dark: 0) and the score.

    `activations` are those of `wheretolook_paper.release.mlp_architecture.activations`; `outcome` is put below the score.
    """
    means, *hidden, score = activations
    ratios = [2.1, 2.1, 1.0, *(1.0 for _ in hidden), 0.75]
    with context(PRINT):
        figure = new_figure(TWO_COLUMNS_IN, 2.0)
        stages = figure.add_gridspec(1, len(ratios), width_ratios=ratios)
        picture = figure.add_subplot(stages[0])
        bins = figure.add_subplot(stages[1])
        draw_landmarks(picture, image)
        picture.set_title("a  pose and\nlandmarks in view", loc="left")
        picture.set_xlabel(f"{len(image.pixels):,} landmarks")
        draw_counts(bins, image)
        bins.set_title(f"b  image binning\n{len(image.counts)} × {len(image.counts)}", loc="left")
        bins.set_xlabel(f"{int((image.counts > 0).sum())} of {image.counts.size} filled")
        inner = stages[2].subgridspec(len(means), 1)
        inputs = [figure.add_subplot(inner[row]) for row in range(len(means))]
        for axes, values, name in zip(inputs, means, channels, strict=True):
            reach = float(np.abs(values).max()) or 1.0
            _grid(axes, values, "PuOr", -reach, reach)
            axes.set_ylabel(f"${name}$", rotation=0, ha="right", va="center", labelpad=2)
        inputs[-1].set_xlabel("standardized,\nempty: 0")
        inputs[0].set_title(f"c  input\n{means.size:,}", loc="left")
        layers = [figure.add_subplot(stages[3 + number]) for number in range(len(hidden))]
        for number, (axes, values) in enumerate(zip(layers, hidden, strict=True)):
            rows = -(-len(values) // _COLUMNS)
            cells = np.full(rows * _COLUMNS, np.nan)
            cells[: len(values)] = values
            _grid(axes, cells.reshape(rows, _COLUMNS), "cividis", 0, float(values.max()) or 1.0)
            axes.set_title(f"{chr(ord('d') + number)}  hidden {number + 1}\n{len(values)}", loc="left")
            axes.set_xlabel(f"{(values > 0).mean():.0%} active")
        last = figure.add_subplot(stages[-1])
        _draw_score(last, float(score[0]), outcome)
        last.set_title(f"{chr(ord('d') + len(hidden))}  score\n", loc="left")
        _connect(figure, [picture, bins], inputs, [*layers, last])
        return figure


def _connect(figure: Figure, before: list[Axes], inputs: list[Axes], after: list[Axes]) -> None:
    """Draw arrows from each panel to the next; the column of channels counts as one panel."""
    middle = inputs[len(inputs) // 2]
    at = 0.5 if len(inputs) % 2 else 1.0  # with an even number, the middle is between two panels
    arrow: Style = {
        "arrowstyle": "-|>",
        "mutation_scale": 7,
        "color": INK,
        "shrinkA": 2,
        "shrinkB": 2,
        "linewidth": 0.8,
    }
    ends: Style = {"coordsA": "axes fraction", "coordsB": "axes fraction"}
    for left, right in pairwise([*before, middle, *after]):
        start = (1.0, at if left is middle else 0.5)
        end = (-0.45, at) if right is middle else (0.0, 0.5)  # clear of the channel's name
        figure.add_artist(ConnectionPatch(start, end, axesA=left, axesB=right, **ends, **arrow))


def _grid(axes: Axes, values: Float, colors: str, low: float, high: float) -> None:
    axes.imshow(values, cmap=colors, vmin=low, vmax=high, interpolation="nearest")
    frame(axes)


def _draw_score(axes: Axes, score: float, outcome: str) -> None:
    axes.bar([0], [score], width=1.0, color=BLUE if score >= 0.5 else VERMILION)
    axes.set(xlim=(-0.5, 0.5), ylim=(0, 1), xticks=[], yticks=[0, 0.5, 1])
    axes.yaxis.tick_right()
    axes.spines[:].set_visible(True)
    inside = score >= 0.2  # the bar is long enough for its number
    place: Style = {"va": "top", "color": "white"} if inside else {"va": "bottom", "color": INK}
    axes.text(0, score - 0.03 if inside else score + 0.03, f"{score:.2f}", ha="center", fontsize=7, **place)
    axes.set_xlabel("\n".join(textwrap.wrap(outcome, _WIDE)))
