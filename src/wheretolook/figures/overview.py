"""The idea in one picture: a map, the score of every direction at one place, its best and its worst view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.style import context
from numpy.typing import NDArray

from wheretolook.figures.config import Look
from wheretolook.figures.style import INK, RC, VERMILION, new_figure
from wheretolook.geometry.poses import Float
from wheretolook.planning.turns import pan_tilt_angles

STAR = VERMILION


@dataclass(frozen=True, eq=False)
class View:
    """The image (H, W, 3) uint8 of a viewpoint, its unit axis (3,) in the world, its score (the predicted probability
    that it localizes), and how localizing it ended, in words."""

    rgb: NDArray[np.uint8]
    direction: Float
    score: float
    outcome: str


def overview_figure(
    landmarks: Float,
    locations: Float,
    share_good: Float,
    place: Float,
    directions: Float,
    scores: Float,
    best: View,
    worst: View,
) -> Figure:
    """Draw a scene's map, the scores of all directions at one place, and the views they favour and avoid.

    There are landmarks (N, 3) m; labelled locations (L, 3) m, and the share of each one's viewpoints that localize; one
    of them, `place`, and the predicted probabilities (D,) of unit directions (D, 3) there; and the labelled views there
    with the highest and the lowest score.
    """
    with context(RC):
        figure = new_figure(14.0, 3.9)
        grid = figure.add_gridspec(1, 4, width_ratios=(1.05, 1.5, 1.25, 1.25), wspace=0.1)
        _draw_map(figure, figure.add_subplot(grid[0]), landmarks, locations, share_good, place)
        axes = figure.add_subplot(grid[1], projection="hammer")
        _draw_sphere(figure, axes, directions, scores, best, worst)
        for column, (title, view, mark) in enumerate((("best", best, "*"), ("worst", worst, "X")), 2):
            axes = figure.add_subplot(grid[column])
            axes.imshow(view.rgb)
            axes.plot(0.06, 0.92, mark, transform=axes.transAxes, markersize=14, color=STAR, markeredgecolor="white")
            axes.set_title(f"{title} view: predicted {view.score:.2f}")
            axes.set_xlabel(view.outcome)
            axes.set(xticks=[], yticks=[], anchor="N")
            axes.grid(False)
        return figure


def _draw_map(figure: Figure, axes: Axes, landmarks: Float, locations: Float, share_good: Float, place: Float) -> None:
    low, high = np.percentile(landmarks[:, :2], (0.5, 99.5), axis=0)
    axes.scatter(landmarks[:, 0], landmarks[:, 1], s=0.6, color="#9a9a9a", linewidths=0, rasterized=True)
    order = np.argsort(share_good, kind="stable")
    look: Look = {"s": 34, "cmap": "cividis", "vmin": 0, "vmax": 1, "edgecolors": "white", "linewidths": 0.6}
    points = axes.scatter(locations[order, 0], locations[order, 1], c=share_good[order], **look)
    axes.plot(*place[:2], "o", markersize=11, markerfacecolor="none", markeredgecolor=STAR, markeredgewidth=2)
    axes.set_aspect("equal")
    axes.set(xlim=(low[0] - 0.3, high[0] + 0.3), ylim=(low[1] - 0.3, high[1] + 0.3), xlabel="x (m)", ylabel="y (m)")
    axes.set_title("map from above, sampled locations")
    bar = figure.colorbar(points, ax=axes, shrink=0.9, pad=0.17, orientation="horizontal")
    bar.set_label("share of views that localize", color=INK)


def _draw_sphere(figure: Figure, axes: Axes, directions: Float, scores: Float, best: View, worst: View) -> None:
    azimuth, elevation = pan_tilt_angles(directions)
    points = axes.scatter(azimuth, elevation, s=30, c=scores, cmap="cividis", norm=Normalize(0, 1), linewidths=0)
    for view, mark in ((best, "*"), (worst, "X")):
        axes.plot(*pan_tilt_angles(view.direction), mark, markersize=15, color=STAR, markeredgecolor="white")
    axes.set(xticklabels=[], yticklabels=[], anchor="N")
    axes.set_title("every direction from the ringed place")
    bar = figure.colorbar(points, ax=axes, shrink=0.6, pad=0.06, orientation="horizontal")
    bar.set_label("predicted probability to localize", color=INK)
