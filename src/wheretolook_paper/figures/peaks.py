"""Figure of a scorer over the sphere of directions, and the views with its highest and lowest scores."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.patheffects import withStroke
from matplotlib.style import context
from numpy.typing import ArrayLike, NDArray

from wheretolook.figures.floor_plan import BLUE, INK, VERMILION, frame, new_figure
from wheretolook.geometry.poses import Float, pan_tilt_angles
from wheretolook_paper.figures.overview import View
from wheretolook_paper.figures.style import PRINT, TWO_COLUMNS_IN, Style

_WIDE = 27  # letters below a view


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
                axes.set_xlabel("\n".join(textwrap.wrap(view.outcome, _WIDE)), labelpad=2)
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
