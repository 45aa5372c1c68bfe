"""Figures of the network: its input, a view on its way through it, and its scores over the sphere of directions."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import ConnectionPatch
from matplotlib.patheffects import withStroke
from matplotlib.style import context
from numpy.typing import ArrayLike, NDArray

from wheretolook.figures.floor_plan import BLUE, INK, VERMILION, frame, new_figure
from wheretolook.geometry.poses import Float, pan_tilt_angles
from wheretolook.inputs.channels import PAPER_VARIANTS
from wheretolook_paper.figures.overview import View
from wheretolook_paper.figures.style import ORANGE, PRINT, TWO_COLUMNS_IN, Style

_COLUMNS = 12  # of a hidden layer's values


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
    axes.set_xlabel("\n".join(textwrap.wrap(outcome, 10)))  # letters below the score


UNITS = {"u": "px", "v": "px", "x": "m", "y": "m", "z": "m"}

_EMPTY = "#e8e8e8"


@dataclass(frozen=True, eq=False)
class BinnedImage:
    """One view and its binned network input. Rows of bins go down the image, columns right.

    `means` (bins, bins) are those of each channel over a bin's landmarks, by the channel's name; NaN in empty bins.
    """

    rgb: NDArray[np.uint8]  # (H, W, 3), what the camera sees
    pixels: Float  # (K, 2) of the landmarks in view
    means: Mapping[str, Float]
    counts: NDArray[np.int32]  # (bins, bins) landmarks in each bin


def inputs_figure(image: BinnedImage) -> Figure:
    """Draw the image with its landmarks, their number in each bin, and the channels of each input variant.

    Right, a row for each of the paper's variants; empty bins are grey.
    """
    channels = [*dict.fromkeys(name for names in PAPER_VARIANTS.values() for name in names)]
    with context(PRINT):
        figure = new_figure(TWO_COLUMNS_IN, 0.55 + 1.05 * len(PAPER_VARIANTS))
        left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(0.42, 0.8))[0]
        picture, bins = left.subplots(2, 1)
        draw_landmarks(picture, image)
        picture.set_title(f"image, {len(image.pixels):,} landmarks in view")
        draw_counts(bins, image)
        bins.set_title(f"{int((image.counts > 0).sum())} of {image.counts.size} bins filled")
        grid = right.add_gridspec(len(PAPER_VARIANTS), len(channels))
        for row, (variant, names) in enumerate(PAPER_VARIANTS.items()):
            for column, name in enumerate(channels):
                axes = right.add_subplot(grid[row, column])
                if name in names:
                    draw_channel(axes, image, name)
                    if variant == next(other for other, inputs in PAPER_VARIANTS.items() if name in inputs):
                        axes.set_title(f"${name}$ ({UNITS.get(name, '')})")
                else:
                    axes.axis("off")
                if column == 0:
                    size = len(names) * image.counts.size
                    axes.set_ylabel(f"{variant.replace('+', ' + ')}\n{size:,} values")
        note = "Each bin holds the mean over its landmarks.\nEmpty bins, grey here, are zero to the network."
        right.text(0.99, 0.9, note, ha="right", va="top", fontsize=7)
        return figure


def draw_landmarks(axes: Axes, image: BinnedImage) -> None:
    """Draw the image with its landmarks."""
    height, width = image.rgb.shape[:2]
    axes.imshow(image.rgb, extent=(0, width, height, 0))
    axes.scatter(image.pixels[:, 0], image.pixels[:, 1], s=1.5, color=ORANGE, linewidths=0, rasterized=True)
    axes.set(xlim=(0, width), ylim=(height, 0))
    frame(axes)


def draw_counts(axes: Axes, image: BinnedImage) -> None:
    """Draw the number of landmarks in each bin, in logarithmic colours, over the pale image."""
    height, width = image.rgb.shape[:2]
    axes.imshow(255 - (255 - image.rgb) // 3, extent=(0, width, height, 0))
    counts = np.ma.masked_equal(image.counts, 0)
    axes.imshow(np.ma.log(counts), extent=(0, width, height, 0), cmap="cividis", interpolation="nearest", aspect="auto")
    bins = len(image.counts)
    axes.vlines(np.linspace(0, width, bins + 1), 0, height, color="white", linewidth=0.25)
    axes.hlines(np.linspace(0, height, bins + 1), 0, width, color="white", linewidth=0.25)
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal")
    frame(axes)


def draw_channel(axes: Axes, image: BinnedImage, name: str) -> None:
    """Draw one channel from dark (minimum) to light (maximum), with its range below."""
    values = np.ma.masked_invalid(np.asarray(image.means[name], dtype=np.float64))
    axes.set_facecolor(_EMPTY)
    low, high = (float(values.min()), float(values.max())) if values.count() else (0.0, 0.0)
    if name in ("x", "y") and low < 0 < high:  # right and left, down and up: white is straight ahead
        axes.imshow(values, cmap="PuOr", norm=TwoSlopeNorm(0, low, high), interpolation="nearest")
    else:
        axes.imshow(values, cmap="cividis", interpolation="nearest")
    digits = 0 if UNITS.get(name) == "px" else 1
    ends = " to ".join(dict.fromkeys(f"{end:.{digits}f}" for end in (low, high))).replace("-", "−")
    axes.set_xlabel(ends if values.count() else "no landmark", fontsize=6.5, labelpad=1)
    frame(axes)


def spread_extrema(
    directions: ArrayLike, scores: ArrayLike, n: int, apart_deg: float = 40.0, highest: bool = True
) -> NDArray[np.int64]:
    """Return rows of up to n unit directions (D, 3) with the highest (or lowest) scores, at least `apart_deg` apart."""
    axes = np.asarray(directions, dtype=np.float64)
    values = np.asarray(scores, dtype=np.float64)
    found: list[int] = []
    for row in np.argsort(-values if highest else values, kind="stable"):
        if all(axes[row] @ axes[other] <= np.cos(np.radians(apart_deg)) for other in found):
            found.append(int(row))
        if len(found) == n:
            break
    return np.array(found, dtype=np.int64)


def peaks_figure(
    directions: Float,
    scores: Float,
    peaks: Sequence[View],
    pits: Sequence[View],
    tried: tuple[Float, NDArray[np.bool_]] | None = None,
) -> Figure:
    """Draw the scores (D,) of unit axes (D, 3) at one location (Hammer projection, equal area), and views from there.

    `peaks` are views of high scores, the highest first, with numbers; `pits` of low scores, the lowest first, with
    letters; `tried` axes (B, 3) of labelled views and whether each of them localizes, (B,): rings if so, else crosses.
    """
    columns = max(len(peaks), len(pits))
    with context(PRINT):
        figure = new_figure(TWO_COLUMNS_IN, 2.9)
        left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(2.2, columns))[0]
        sphere = left.add_subplot(projection="hammer")
        _draw_sphere(left, sphere, directions, scores, tried)
        for row, (views, first, color) in enumerate(((peaks, "1", BLUE), (pits, "A", VERMILION))):
            for column, view in enumerate(views):
                mark = chr(ord(first) + column)
                axes = right.add_subplot(2, columns, columns * row + column + 1)
                axes.imshow(view.rgb)
                frame(axes, color, 1.4)
                axes.set_title(f"{mark}  predicted {view.score:.2f}", loc="left")
                axes.set_xlabel("\n".join(textwrap.wrap(view.outcome, 27)), labelpad=2)  # letters below a view
                azimuth, elevation = map(float, pan_tilt_angles(view.direction))
                look: Style = {"color": color, "fontsize": 8, "fontweight": "bold", "ha": "center", "va": "center"}
                disc = {"boxstyle": "circle,pad=0.18", "facecolor": "white", "edgecolor": color}
                sphere.text(azimuth, elevation, mark, zorder=5, bbox=disc, **look)
        return figure


def _draw_sphere(
    figure: SubFigure, axes: Axes, directions: Float, scores: Float, tried: tuple[Float, NDArray[np.bool_]] | None
) -> None:
    size = 6000 / len(directions)
    dots = axes.scatter(*pan_tilt_angles(directions), s=size, c=scores, cmap="cividis", vmin=0, vmax=1, linewidths=0)
    if tried is not None:
        looked, good = tried
        look: Style = {"linewidths": 0.7, "path_effects": [withStroke(linewidth=1.8, foreground="white")]}
        rings: Style = {"s": 1.1 * size, "facecolors": "none", "edgecolors": INK, "label": "localizes"}
        crosses: Style = {"s": 0.6 * size, "marker": "x", "color": INK, "label": "does not"}
        x, y = pan_tilt_angles(looked)
        axes.scatter(x[good], y[good], **rings, **look)
        axes.scatter(x[~good], y[~good], **crosses, **look)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.2), ncols=2, columnspacing=1.2, handletextpad=0.2)
    axes.set(xticklabels=[], yticklabels=[])
    bar = figure.colorbar(dots, ax=axes, orientation="horizontal", shrink=0.7, pad=0.08, aspect=25)
    bar.set_label("predicted probability of localization")
