"""Film and figures of a planned path: camera view, position on the map, score along the path."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context
from numpy.typing import NDArray

from wheretolook.figures.floor_plan import INK, RC, frame, new_figure
from wheretolook.geometry.poses import Float
from wheretolook.geometry.views import Views
from wheretolook.planning.view_sequence import lengths_along
from wheretolook.utils.texts import counted, score_text
from wheretolook_paper.figures.animation import Pixels, pixels_of
from wheretolook_paper.figures.style import Style
from wheretolook_paper.styles import method_style

PATH = "#CC3311"
LANDMARKS = "#EE9900"
FRAME_MS = 125
N_STILLS = 5
N_ARROWS = 12

_STOP: Style = {"marker": "o", "color": "white", "markeredgecolor": PATH, "markeredgewidth": 1.6, "linestyle": "none"}
_ARROW: Style = {"arrowstyle": "-|>", "color": INK, "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 8}
_NUMBER: Style = {"boxstyle": "circle,pad=0.15", "facecolor": PATH, "edgecolor": "white"}


def film_frames(views: Views, landmarks: Float) -> Iterator[Pixels]:
    """Draw one frame (H, W, 3) per view: its image with visible landmarks, the map, and the score along the path.

    `landmarks` (N, 3) m are those of the map; there is at least one view.
    """
    with context(RC):
        for number in range(len(views)):
            figure = new_figure(9.6, 4.4)
            grid = figure.add_gridspec(2, 2, width_ratios=(1.5, 1.0), height_ratios=(1.7, 1.0))
            _draw_view(figure.add_subplot(grid[:, 0]), views, number)
            draw_path(figure.add_subplot(grid[0, 1]), views, landmarks, number)
            _draw_scores(figure.add_subplot(grid[1, 1]), views, number)
            yield pixels_of(figure)


def still_figure(views: Views, landmarks: Float, title: str = "") -> Figure:
    """Draw a path from above, its score, and some evenly spread views of it.

    `landmarks` (N, 3) m are those of the map; there is at least one view.
    """
    own = np.flatnonzero(views.rank == 1)
    shown = own[np.unique(np.linspace(0, len(own) - 1, N_STILLS).round().astype(int))].tolist()
    with context(RC):
        figure = new_figure(2.5 * max(4, len(shown)), 5.8)
        grid = figure.add_gridspec(2, 1, height_ratios=(1.6, 1.0))
        above = grid[0].subgridspec(1, 2, width_ratios=(1.1, 1.0))
        axes = figure.add_subplot(above[0])
        draw_path(axes, views, landmarks, None, shown)
        axes.set_title(title)
        _draw_scores(figure.add_subplot(above[1]), views, None, shown)
        cells = grid[1].subgridspec(1, len(shown))
        for column, number in enumerate(shown):
            _draw_view(figure.add_subplot(cells[column]), views, number, f"{column + 1}: ")
        return figure


def methods_figure(paths: Mapping[str, Views], landmarks: Float) -> Figure:
    """Draw the paths of several methods side by side from above, with viewing directions (paper, Sec. 4.3).

    `paths` maps the name of each method to the views along its path; `landmarks` (N, 3) m.
    """
    with context(RC):
        figure = new_figure(3.9 * len(paths), 4.2)
        for axes, (name, views) in zip(figure.subplots(1, len(paths), squeeze=False)[0], paths.items(), strict=True):
            draw_path(axes, views, landmarks)
            n_visible = np.mean([len(pixels) for pixels in views.pixels])
            axes.set_title(f"{method_style(name).label}\n{n_visible:,.0f} landmarks in view on average", fontsize=10)
        return figure


def _draw_view(axes: Axes, views: Views, number: int, prefix: str = "") -> None:
    assert views.camera is not None
    width, height = views.camera.width, views.camera.height
    pixels, score = views.pixels[number], views.score[number]
    if views.images is not None:
        axes.imshow(views.images[number], extent=(0, width, height, 0))
    axes.scatter(pixels[:, 0], pixels[:, 1], s=3, color=LANDMARKS, linewidths=0)
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal", anchor="N")
    frame(axes, linewidth=0.8)
    n_views = _views_there(views)[number]
    stop = f"view {views.rank[number]} of {n_views}: " if n_views > 1 else ""
    text = "" if np.isnan(score) else f", score {score_text(float(score))}"
    axes.set_title(f"{prefix}{stop}{counted(len(pixels), 'landmark')}{text}", fontsize=9)


def _views_there(views: Views) -> NDArray[np.int64]:
    """Return the number (V,) of views at each view's position."""
    return np.bincount(views.waypoint)[views.waypoint]


def draw_path(axes: Axes, views: Views, landmarks: Float, number: int | None = None, shown: Sequence[int] = ()) -> None:
    """Draw landmarks (N, 2 or 3) and path from above, arrows along it or at view `number`, numbers at views `shown`."""
    positions = views.positions
    xy = positions[:, :2]
    low, high = np.percentile(landmarks[:, :2], (1, 99), axis=0)
    low = np.minimum(low, xy.min(0))
    high = np.maximum(high, xy.max(0))
    axes.scatter(landmarks[:, 0], landmarks[:, 1], s=0.5, color="#9a9a9a", linewidths=0, rasterized=True)
    axes.plot(*xy.T, color=PATH, linewidth=2.2, zorder=3)
    stops = xy[(views.rank == 1) & (_views_there(views) > 1)]
    axes.plot(*stops.T, markersize=7, zorder=3.5, **_STOP)
    along = lengths_along(positions)
    arrows = np.unique(np.searchsorted(along, np.linspace(0, along[-1], N_ARROWS) - 1e-9)).tolist()
    length = margin = 0.07 * float(np.max(high - low))
    if number is not None:
        arrows = [number]
        length *= 2
    for at in arrows:
        axes.annotate("", xy[at] + views.axes[at, :2] * length, xy[at], arrowprops=_ARROW, zorder=4)
    for label, at in enumerate(shown, 1):
        axes.annotate(str(label), xy[at], fontsize=9, color="white", ha="center", va="center", bbox=_NUMBER, zorder=5)
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin), aspect="equal")
    axes.set(xlabel="x (m)", ylabel="y (m)")


def _draw_scores(axes: Axes, views: Views, number: int | None, shown: Sequence[int] = ()) -> None:
    """Draw the score along the path, with a mark at view `number` and numbers at views `shown`."""
    along = lengths_along(views.positions)
    scores = views.score
    joint = np.where(_views_there(views) > 1, views.set_score, np.nan)
    own = views.rank == 1
    axes.plot(along[own], scores[own], color=PATH, linewidth=1.4)
    stops = own & np.isfinite(joint)
    if stops.any():
        axes.vlines(along[stops], scores[stops], joint[stops], color=PATH, linewidth=0.8, linestyle=":")
        axes.plot(along[stops], joint[stops], label="all views of a stop", markersize=6, **_STOP)
        axes.legend(loc="best", fontsize=8)
    if number is not None:
        axes.plot(along[number], scores[number], "o", color=INK, markersize=6)
    for label, at in enumerate(shown, 1):
        side = "left" if at == 0 else "right" if at == len(views) - 1 else "center"
        axes.annotate(str(label), (along[at], scores[at]), (0, 6), textcoords="offset points", ha=side)
    finite = np.concatenate([scores, joint])
    finite = finite[np.isfinite(finite)]
    lowest, highest = (finite.min(), finite.max()) if len(finite) else (0.0, 1.0)
    margin = max(0.25 * (highest - lowest), 0.02 * max(1.0, abs(highest)))  # a constant score is in the middle
    axes.set(xlim=(0, max(along[-1], 1e-6)), ylim=(lowest - margin, highest + margin))
    axes.set(xlabel="along the path (m)", ylabel="score")
