"""Figure of the network's input: visible landmarks, bins, channels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.style import context
from numpy.typing import NDArray

from wheretolook.figures.floor_plan import frame, new_figure
from wheretolook.geometry.poses import Float
from wheretolook.inputs.channels import PAPER_VARIANTS
from wheretolook_paper.figures.style import ORANGE, PRINT, TWO_COLUMNS_IN

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
