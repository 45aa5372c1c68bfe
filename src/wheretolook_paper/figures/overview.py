"""Overview figure: a map, the scores of all directions at one location, and its best and worst view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.style import context
from numpy.typing import NDArray

from wheretolook.dataset.viewpoint_table import LOCALIZED, UNLABELLED, is_good, poses
from wheretolook.figures.floor_plan import BLUE, INK, RC, VERMILION, frame, new_figure
from wheretolook.geometry.poses import Float, pan_tilt_angles
from wheretolook_paper.evaluation.label_report import length_text
from wheretolook_paper.figures.dollhouse import Dollhouse, draw_house
from wheretolook_paper.figures.style import Style

if TYPE_CHECKING:
    import pandas as pd

    from wheretolook.dataset.scene import Scene

SCORE_COLORS: Style = {"cmap": "cividis", "vmin": 0, "vmax": 1}


def shares_good(table: pd.DataFrame) -> tuple[NDArray[np.int64], Float]:
    """Ids (L,) of a table's locations, ascending, and the share of each one's viewpoints that localize, (L,)."""
    ids, rows = np.unique(table["location_id"].to_numpy(np.int64), return_inverse=True)
    return ids, np.bincount(rows, weights=is_good(table)) / np.bincount(rows)


def instructive_location(table: pd.DataFrame) -> int:
    """The first location whose share of viewpoints that localize is nearest to 0.5: where to look matters there."""
    ids, shares = shares_good(table)
    return int(ids[np.argmin(np.abs(shares - 0.5))])


def outcome_in_words(label: pd.Series, brief: bool = False) -> str:
    """The result of localizing a row of a table, in words; `brief` gives only the pose's error, if one was found.

    Empty if it was not tried.
    """
    status = str(label["status"])
    if status == UNLABELLED:
        return ""
    if status != LOCALIZED:
        return status.replace("_", " ")
    error_m = float(label["error_m"])  # a row may hold it in single precision
    right = error_m < 1
    error = f"{length_text(error_m)}, {label['error_deg']:.{2 if right else 0}f}° off"
    return error if brief else f"{'pose' if right else 'wrong pose'} found, {error}"


@dataclass(frozen=True, eq=False)
class View:
    """Image of a viewpoint, its optical axis, predicted probability to localize, and localization outcome."""

    rgb: NDArray[np.uint8]  # (H, W, 3)
    direction: Float  # (3,) unit axis in the world
    score: float
    outcome: str  # in words


def rendered_views(
    scene: Scene, rows: pd.DataFrame, scores: Float, words: Callable[[pd.Series], str]
) -> tuple[View, ...]:
    """Render B labelled viewpoints (rows of the viewpoint table) with scores (B,) and outcomes described by `words`."""
    cam_from_world = poses(rows)
    images = scene.renderer.render(scene.camera, cam_from_world).rgb
    outcomes = [words(rows.iloc[row]) for row in range(len(rows))]  # iterrows would change types
    return tuple(map(View, images, cam_from_world[:, 2, :3], scores.tolist(), outcomes))


@dataclass(frozen=True, eq=False)
class Overview:
    """Content of `overview_figure`."""

    scene: str  # display name
    method: str  # display name of the scoring method
    plan: Dollhouse  # the scene from straight above
    locations: Float  # (L, 3) m, labelled locations, none above another
    share_good: Float  # (L,) share of viewpoints that localize at each location
    place: Float  # (3,) m, one of the locations
    directions: Float  # (D, 3) unit axes at the location
    scores: Float  # (D,) predicted probabilities to localize
    best: View  # labelled view at the location with the highest score
    worst: View  # level view there with the lowest score


def overview_figure(overview: Overview) -> Figure:
    """Draw a plan of the labels, the sphere of scores at the ringed location, and two of its views with outcomes."""
    views = (("best", "best view", overview.best, BLUE), ("worst", "worst level view", overview.worst, VERMILION))
    with context(RC):
        figure = new_figure(13.5, 4.7)
        left, middle, right = figure.subfigures(1, 3, squeeze=False, width_ratios=(1.1, 1.45, 0.8))[0]
        plan = left.add_subplot()
        points = _draw_plan(plan, overview)
        plan.set_title(f"{overview.scene}, from above", loc="left")
        bar = left.colorbar(points, ax=plan, orientation="horizontal", shrink=0.8, pad=0.03, aspect=28)
        bar.set_label("share of a location's views that localize", color=INK)
        sphere = middle.add_subplot(projection="hammer")
        azimuth, elevation = pan_tilt_angles(overview.directions)
        size = 20_000 / max(len(azimuth), 1)
        points = sphere.scatter(azimuth, elevation, size, c=overview.scores, linewidths=0, **SCORE_COLORS)
        sphere.set(xticklabels=[], yticklabels=[])
        sphere.grid(False)
        sphere.set_title(f'every direction from the ringed location,\nscored by "{overview.method}"', loc="left")
        bar = middle.colorbar(points, ax=sphere, orientation="horizontal", shrink=0.8, pad=0.06, aspect=28)
        bar.set_label("predicted probability to localize", color=INK)
        text: Style = {"fontsize": 9, "fontweight": "bold", "ha": "center", "va": "center", "zorder": 4}
        for axes, (name, title, view, color) in zip(right.subplots(2, 1), views, strict=True):
            box: Style = {"boxstyle": "round,pad=0.25", "facecolor": "white", "edgecolor": color}
            sphere.text(*map(float, pan_tilt_angles(view.direction)), name, color=color, bbox=box, **text)
            axes.imshow(view.rgb)
            frame(axes, color, 2.0)
            axes.set_title(f"{title}: predicted {view.score:.2f}", loc="left", fontsize=10)
            axes.set_xlabel(view.outcome, fontsize=9)
        return figure


def _draw_plan(axes: Axes, overview: Overview) -> PathCollection:
    """Draw the scene from above with labelled locations, the ringed one and a scale."""
    plan = overview.plan
    draw_house(axes, plan, 0.2)
    order = np.argsort(overview.share_good, kind="stable")
    x, y = plan.pixels(overview.locations)[order].T
    dots: Style = {"s": 46, "edgecolors": "white", "linewidths": 0.8}
    points = axes.scatter(x, y, c=overview.share_good[order], zorder=2, **dots, **SCORE_COLORS)
    ring: Style = {"markersize": 14, "markerfacecolor": "none", "markeredgecolor": VERMILION, "markeredgewidth": 2.4}
    outline = withStroke(linewidth=4.5, foreground="white")
    axes.plot(*plan.pixels(overview.place), "o", zorder=3, path_effects=[outline], **ring)
    start, end = plan.pixels(overview.place + np.eye(2, 3, -1))
    metre_px = float(end[0] - start[0])
    height, width = plan.rgb.shape[:2]
    axes.plot([width - metre_px, width], [height * 1.03] * 2, color=INK, linewidth=2, clip_on=False)
    axes.text(width - 1.1 * metre_px, height * 1.03, "1 m", ha="right", va="center")
    return points
