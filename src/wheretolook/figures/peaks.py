"""What a network looks at: its score over the sphere of directions, and the views behind its peaks and its pits."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.patheffects import withStroke
from matplotlib.style import context
from numpy.typing import ArrayLike, NDArray

from wheretolook.figures.dollhouse import BLUE, VERMILION
from wheretolook.figures.overview import View
from wheretolook.figures.style import INK, PRINT, TWO_COLUMNS_IN, new_figure
from wheretolook.geometry.poses import Float

_WIDE = 27  # letters below a view


def spread_extrema(
    directions: ArrayLike, scores: ArrayLike, n: int, apart_deg: float = 40.0, highest: bool = True
) -> NDArray[np.int64]:
    """Rows of the n highest scores (or lowest), in order, none nearer than an angle to one before it.

    Args:
        directions: (D, 3) unit vectors.
        scores: (D,).
        n: how many at most.
        apart_deg: least angle between two of them.
        highest: whether peaks or pits are asked for.
    """
    axes, values = np.asarray(directions, dtype=np.float64), np.asarray(scores, dtype=np.float64)
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
    """The sphere of scores at one location, and views from there.

    Args:
        directions: (D, 3) unit optical axes, world frame.
        scores: (D,) predicted probabilities.
        peaks: views of high scores, the highest first; they are numbered.
        pits: views of low scores, the lowest first; they have letters.
        tried: axes (B, 3) of the views that were localized, and whether each one came within the limits, (B,): rings
            where it did, crosses where it did not.

    Returns:
        As wide as two columns. Left: Hammer projection (equal area; azimuth to the right, elevation up) of the scores.
        Right: peaks above pits; below each one what came of localizing it.
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
                axes.set(xticks=[], yticks=[])
                axes.grid(False)
                axes.spines[:].set(visible=True, color=color, linewidth=1.4)
                axes.set_title(f"{mark}  predicted {view.score:.2f}", loc="left")
                axes.set_xlabel("\n".join(textwrap.wrap(view.outcome, _WIDE)), labelpad=2)
                azimuth, elevation = _angles(view.direction)
                text = sphere.text(float(azimuth), float(elevation), mark, color=color, fontsize=9, fontweight="bold",
                                   ha="center", va="center", zorder=5)  # fmt: skip
                text.set_path_effects([withStroke(linewidth=2.5, foreground="white")])
        return figure


def _draw_sphere(
    figure: SubFigure, axes: Axes, directions: Float, scores: Float, tried: tuple[Float, NDArray[np.bool_]] | None
) -> None:
    size = 6000 / len(directions)
    dots = axes.scatter(*_angles(directions), s=size, c=scores, cmap="cividis", vmin=0, vmax=1, linewidths=0)
    if tried is not None:
        looked, good = tried
        halo = [withStroke(linewidth=1.8, foreground="white")]
        axes.scatter(*_angles(looked[good]), s=1.1 * size, facecolors="none", edgecolors=INK, linewidths=0.7,
                     label="localizes", path_effects=halo)  # fmt: skip
        axes.scatter(*_angles(looked[~good]), s=0.6 * size, marker="x", color=INK, linewidths=0.7, label="does not",
                     path_effects=halo)  # fmt: skip
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.2), ncols=2, columnspacing=1.2, handletextpad=0.2)
    axes.set(xticklabels=[], yticklabels=[])
    bar = figure.colorbar(dots, ax=axes, orientation="horizontal", shrink=0.7, pad=0.08, aspect=25)
    bar.set_label("predicted probability to localize")


def _angles(directions: Float) -> tuple[Float, Float]:
    """Azimuth and elevation in radians of unit vectors (..., 3)."""
    return np.arctan2(directions[..., 1], directions[..., 0]), np.arcsin(np.clip(directions[..., 2], -1, 1))
