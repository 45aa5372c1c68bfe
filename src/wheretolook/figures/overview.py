"""The idea in one picture: a map, the score of every direction at one place, its best and its worst view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.style import context
from numpy.typing import NDArray

from wheretolook.figures.config import Look
from wheretolook.figures.dollhouse import Dollhouse, draw_house
from wheretolook.figures.style import BLUE, INK, RC, VERMILION, new_figure
from wheretolook.geometry.camera_turns import pan_tilt_angles
from wheretolook.geometry.poses import Float
from wheretolook_paper.figures.inputs import frame


@dataclass(frozen=True, eq=False)
class View:
    """The image (H, W, 3) uint8 of a viewpoint, its unit axis (3,) in the world, its score (the predicted probability
    that it localizes), and how localizing it ended, in words."""

    rgb: NDArray[np.uint8]
    direction: Float
    score: float
    outcome: str


@dataclass(frozen=True, eq=False)
class Overview:
    """What `overview_figure` draws."""

    scene: str  # its name for people
    method: str  # the name for people of what scores
    plan: Dollhouse  # the scene from straight above
    locations: Float  # (L, 3) metres, labelled locations, none above another
    share_good: Float  # (L,) share of each one's viewpoints that localize
    place: Float  # (3,) metres, one of them
    directions: Float  # (D, 3) unit axes at the place
    scores: Float  # (D,) their predicted probabilities to localize
    best: View  # the labelled view there with the highest score
    worst: View  # and the level one with the lowest


def overview_figure(overview: Overview) -> Figure:
    """Draw a scene's labels from above, the scores of all directions at one place, and what a good and a bad one see.

    Columns: the plan, with the share of views that localized at each location; the sphere of directions around the
    ringed place; two of its views, with what came of localizing them.
    """
    with context(RC):
        figure = new_figure(13.5, 4.7)
        left, middle, right = figure.subfigures(1, 3, squeeze=False, width_ratios=(1.1, 1.45, 0.8))[0]
        axes = left.add_subplot()
        points = _draw_plan(axes, overview)
        axes.set_title(f"{overview.scene}, from above", loc="left")
        bar = left.colorbar(points, ax=axes, orientation="horizontal", shrink=0.8, pad=0.03, aspect=28)
        bar.set_label("share of a place's views that localize", color=INK)
        axes = middle.add_subplot(projection="hammer")
        points = _draw_sphere(axes, overview)
        axes.set_title(f'every direction from the ringed place,\nscored by "{overview.method}"', loc="left")
        bar = middle.colorbar(points, ax=axes, orientation="horizontal", shrink=0.8, pad=0.06, aspect=28)
        bar.set_label("predicted probability to localize", color=INK)
        pictures = right.subplots(2, 1)
        for axes, name, view, color in zip(
            pictures, ("best view", "worst level view"), (overview.best, overview.worst), (BLUE, VERMILION), strict=True
        ):
            axes.imshow(view.rgb)
            frame(axes, color, 2.0)
            axes.set_title(f"{name}: predicted {view.score:.2f}", loc="left", fontsize=10)
            axes.set_xlabel(view.outcome, fontsize=9)
        return figure


def _draw_plan(axes: Axes, overview: Overview):  # type: ignore[no-untyped-def]
    plan = overview.plan
    draw_house(axes, plan, 0.2)
    pixels = plan.pixels(overview.locations)
    place = plan.pixels(overview.place)
    order = np.argsort(overview.share_good, kind="stable")
    look: Look = {"s": 46, "cmap": "cividis", "vmin": 0, "vmax": 1, "edgecolors": "white", "linewidths": 0.8}
    x, y = pixels[order].T
    points = axes.scatter(x, y, c=overview.share_good[order], zorder=2, **look)
    ring: Look = {"markersize": 14, "markerfacecolor": "none", "markeredgecolor": VERMILION, "markeredgewidth": 2.4}
    axes.plot(*place, "o", zorder=3, path_effects=[withStroke(linewidth=4.5, foreground="white")], **ring)
    low, high = plan.pixels(np.stack([overview.place, overview.place + np.array([1.0, 0.0, 0.0])]))
    metre_px = float(high[0] - low[0])
    (width, height) = (plan.rgb.shape[1], plan.rgb.shape[0])
    axes.plot([width - metre_px, width], [height * 1.03] * 2, color=INK, linewidth=2, clip_on=False)
    axes.text(width - 1.1 * metre_px, height * 1.03, "1 m", ha="right", va="center")
    return points


def _draw_sphere(axes: Axes, overview: Overview):  # type: ignore[no-untyped-def]
    azimuth, elevation = pan_tilt_angles(overview.directions)
    look: Look = {
        "s": 20_000 / max(len(azimuth), 1),
        "c": overview.scores,
        "cmap": "cividis",
        "vmin": 0,
        "vmax": 1,
        "linewidths": 0,
    }
    points = axes.scatter(azimuth, elevation, **look)
    for view, name, color in ((overview.best, "best", BLUE), (overview.worst, "worst", VERMILION)):
        x, y = (float(angle) for angle in pan_tilt_angles(view.direction))
        disc: Look = {"boxstyle": "round,pad=0.25", "facecolor": "white", "edgecolor": color}
        axes.text(x, y, name, color=color, fontsize=9, fontweight="bold", ha="center", va="center", bbox=disc, zorder=4)
    axes.set(xticklabels=[], yticklabels=[])
    axes.grid(False)
    return points
