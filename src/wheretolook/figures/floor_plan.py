"""Floor plan of a map's landmarks and of views, from straight above."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context

from wheretolook.figures.style import GREY, INK, RC, new_figure
from wheretolook.geometry.poses import Float

MAX_LANDMARKS = 30_000  # drawn
MAX_NAMES = 30  # with more locations, none is named
OUTLIERS = 0.01  # share of the landmarks left out at each end
ARROW = 0.06  # length over that of the plan


def floor_plan_figure(landmarks: Float, positions: Float, axes: Float, scores: Float, names: Sequence[str]) -> Figure:
    """Draw landmarks (N, 3), and views as arrows coloured by score (V,).

    Views have positions (V, 3), unit optical axes (V, 3) and names of their locations; z is up.
    """
    low, high = _extent(landmarks, positions)
    with context(RC):
        width, height = (high - low) / (high - low).max()
        figure = new_figure(2 + 7 * max(width, 0.3), 1 + 7 * max(height, 0.3))
        draw_floor_plan(figure.add_subplot(), landmarks, positions, axes, scores, names, "score")
        return figure


def draw_floor_plan(
    plan: Axes, landmarks: Float, positions: Float, axes: Float, scores: Float, names: Sequence[str], label: str
) -> None:
    """Draw what `floor_plan_figure` takes, with a colour bar of the given label."""
    low, high = _extent(landmarks, positions)
    inside = landmarks[((landmarks[:, :2] >= low) & (landmarks[:, :2] <= high)).all(axis=1)]
    drawn = inside[:: len(inside) // MAX_LANDMARKS + 1]
    arrows = ARROW * float(np.linalg.norm(high - low)) * axes[:, :2]
    order = np.argsort(scores, kind="stable")  # the best on top
    plan.scatter(drawn[:, 0], drawn[:, 1], s=1.5, color=GREY, alpha=0.4, linewidths=0, label="landmarks")
    shown = plan.quiver(
        *positions[order, :2].T,
        *arrows[order].T,
        scores[order],
        cmap="cividis",
        clim=(0, 1) if scores.max() <= 1 else None,
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.005,
    )
    plan.plot(*positions[:, :2].T, "o", color=INK, markersize=3)
    places = dict(zip(names, positions[:, :2], strict=True))
    for name, place in places.items() if len(places) <= MAX_NAMES else ():
        plan.annotate(name, place, (3, 3), textcoords="offset points", fontsize=8)
    plan.set(xlabel="x, map unit", ylabel="y, map unit", aspect="equal")
    plan.figure.colorbar(shown, ax=plan, shrink=0.7, label=label)


def _extent(landmarks: Float, positions: Float) -> tuple[Float, Float]:
    """Return the lowest and highest x and y, (2,) each, of the plan."""
    low, high = np.quantile(landmarks[:, :2], (OUTLIERS, 1 - OUTLIERS), axis=0)
    return np.minimum(low, positions[:, :2].min(axis=0)), np.maximum(high, positions[:, :2].max(axis=0))
