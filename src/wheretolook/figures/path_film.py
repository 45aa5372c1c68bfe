"""A planned path as a film: what the camera sees, where it is, and the score of its view."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context
from numpy.typing import NDArray

from wheretolook.figures.animation import Pixels, pixels_of
from wheretolook.figures.config import Look
from wheretolook.figures.style import INK, RC, new_figure
from wheretolook.geometry.poses import Float
from wheretolook.planning.routes import PathView
from wheretolook.planning.view_sequence import lengths_along
from wheretolook.scorers.styles import method_style

PATH = "#CC3311"
SEEN = "#EE9900"
FRAME_MS = 125  # how long a view stands
STILLS = 5
ARROWS = 12


def film_frames(views: Sequence[PathView], landmarks: Float) -> Iterator[Pixels]:
    """Frames (H, W, 3) uint8, one for each view: its image with the landmarks in view, the map from above, the score
    along the path.

    There must be a view; `landmarks` are those of the map, (N, 3) metres.
    """
    with context(RC):
        for number in range(len(views)):
            figure = new_figure(9.6, 4.4)
            grid = figure.add_gridspec(2, 2, width_ratios=(1.5, 1.0), height_ratios=(1.7, 1.0))
            _draw_view(figure.add_subplot(grid[:, 0]), views[number])
            _draw_map(figure.add_subplot(grid[0, 1]), views, landmarks, number)
            _draw_scores(figure.add_subplot(grid[1, 1]), views, number)
            yield pixels_of(figure)


def still_figure(views: Sequence[PathView], landmarks: Float, title: str = "") -> Figure:
    """The path in one picture: map from above, score along it, and some views evenly spread over it.

    There must be a view; `landmarks` are those of the map, (N, 3) metres; the title stands over the map.
    """
    own = np.array([number for number, view in enumerate(views) if view.look == 1])  # not further looks of stops
    shown = own[np.unique(np.linspace(0, len(own) - 1, STILLS).round().astype(int))]
    with context(RC):
        figure = new_figure(2.5 * max(4, len(shown)), 5.8)
        grid = figure.add_gridspec(2, 1, height_ratios=(1.6, 1.0))
        above = grid[0].subgridspec(1, 2, width_ratios=(1.1, 1.0))
        axes = figure.add_subplot(above[0])
        _draw_map(axes, views, landmarks, None, shown)
        axes.set_title(title)
        _draw_scores(figure.add_subplot(above[1]), views, None, shown)
        for column, number in enumerate(shown):
            axes = figure.add_subplot(grid[1].subgridspec(1, len(shown))[column])
            _draw_view(axes, views[number], f"{column + 1}: ")
        return figure


def methods_figure(paths: Mapping[str, Sequence[PathView]], landmarks: Float) -> Figure:
    """The paths of several methods side by side, from above, with where the camera looks (paper, Sec. 4.3).

    `paths` holds the views along the path of each method, by its name on the command line; `landmarks` (N, 3) metres.
    """
    with context(RC):
        figure = new_figure(3.9 * len(paths), 4.2)
        for axes, (name, views) in zip(figure.subplots(1, len(paths), squeeze=False)[0], paths.items(), strict=True):
            _draw_map(axes, views, landmarks, None)
            n_seen = np.mean([len(view.pixels) for view in views])
            axes.set_title(f"{method_style(name).label}\n{n_seen:,.0f} landmarks in view on average", fontsize=10)
        return figure


def score_text(score: float) -> str:
    """A score in few digits: of a probability two decimals; scores of other methods may be of any size."""
    return f"{score:.2f}" if abs(score) < 10 else f"{score:.3g}"


def _draw_view(axes: Axes, view: PathView, before: str = "") -> None:
    width, height = view.size_px
    if view.rgb is not None:
        axes.imshow(view.rgb, extent=(0, width, height, 0))
    axes.scatter(view.pixels[:, 0], view.pixels[:, 1], s=3, color=SEEN, linewidths=0)
    score = "" if np.isnan(view.score) else f", score {score_text(view.score)}"
    axes.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[], aspect="equal", anchor="N")
    stop = f"look {view.look} of {view.n_looks}: " if view.n_looks > 1 else ""
    axes.set_title(f"{before}{stop}{len(view.pixels):,} landmarks{score}", fontsize=9)
    axes.grid(False)
    axes.spines[:].set_visible(True)


def _draw_map(
    axes: Axes, views: Sequence[PathView], landmarks: Float, number: int | None, shown: NDArray[np.int64] | None = None
) -> None:
    positions = np.array([view.position for view in views])
    low, high = np.percentile(landmarks[:, :2], (1, 99), axis=0)
    low = np.minimum(low, positions[:, :2].min(0))
    high = np.maximum(high, positions[:, :2].max(0))
    axes.scatter(landmarks[:, 0], landmarks[:, 1], s=0.5, color="#9a9a9a", linewidths=0, rasterized=True)
    axes.plot(*positions[:, :2].T, color=PATH, linewidth=2.2, zorder=3)
    stops = positions[[view.look == 1 < view.n_looks for view in views], :2]
    if len(stops):
        axes.plot(*stops.T, "o", color="white", markeredgecolor=PATH, markeredgewidth=1.6, markersize=7, zorder=3.5)
    xy = [(float(x), float(y)) for x, y in positions[:, :2]]
    reach = 0.07 * float(np.max(high - low))
    arrow: Look = {"arrowstyle": "-|>", "color": INK, "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 8}
    along = lengths_along(positions)
    apart = np.linspace(0, along[-1], ARROWS)  # evenly, and so few that they do not hide the path
    for at in [number] if number is not None else np.unique(np.searchsorted(along, apart - 1e-9)):
        x, y = positions[at, :2] + views[at].axis[:2] * (2 if number is not None else 1) * reach
        axes.annotate("", (float(x), float(y)), xy[at], arrowprops=arrow, zorder=4)
    disc: Look = {"boxstyle": "circle,pad=0.15", "facecolor": PATH, "edgecolor": "white"}
    for column, at in enumerate(() if shown is None else shown, 1):
        axes.annotate(str(column), xy[at], fontsize=9, color="white", ha="center", va="center", bbox=disc)
    axes.set(xlim=(low[0] - 0.3, high[0] + 0.3), ylim=(low[1] - 0.3, high[1] + 0.3), aspect="equal")
    axes.set(xlabel="x (m)", ylabel="y (m)")


def _draw_scores(
    axes: Axes, views: Sequence[PathView], number: int | None, shown: NDArray[np.int64] | None = None
) -> None:
    positions = np.array([view.position for view in views])
    along = lengths_along(positions)
    scores = np.array([view.score for view in views])
    own = np.array([view.look == 1 for view in views])
    axes.plot(along[own], scores[own], color=PATH, linewidth=1.4)
    together = np.array([view.together for view in views])
    if np.isfinite(together).any():
        stops = own & np.isfinite(together)
        look: Look = {"color": "white", "markeredgecolor": PATH, "markeredgewidth": 1.6, "markersize": 6}
        axes.vlines(along[stops], scores[stops], together[stops], color=PATH, linewidth=0.8, linestyle=":")
        axes.plot(along[stops], together[stops], "o", label="all looks of a stop", **look)
        axes.legend(loc="best", fontsize=8)
    if number is not None:
        axes.plot(along[number], scores[number], "o", color=INK, markersize=6)
    for column, at in enumerate(() if shown is None else shown, 1):
        side = "left" if at == 0 else "right" if at == len(views) - 1 else "center"
        axes.annotate(str(column), (along[at], scores[at]), (0, 6), textcoords="offset points", ha=side)
    known = np.concatenate([scores, together])
    known = known[np.isfinite(known)]
    lowest, highest = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    room = max(0.25 * (highest - lowest), 0.02 * max(1.0, abs(highest)))  # a flat score stays in the middle
    axes.set(xlim=(0, max(along[-1], 1e-6)), ylim=(lowest - room, highest + room))
    axes.set(xlabel="along the path (m)", ylabel="score")
