"""Floor plan of a map's landmarks and of views, from straight above."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context
from numpy.typing import NDArray

from wheretolook.figures.style import BLUE, GREY, INK, RC, VERMILION, frame, new_figure
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


HEIGHT_IN = 5.0
PLAN_IN = 6.5
COLUMNS = 2  # of images


@dataclass(frozen=True, eq=False)
class DrawnImage:
    """An image (H, W, 3) uint8, and in it matches (M, 2), of these the inliers (M,), and the strongest rival's inliers."""

    name: str
    rgb: NDArray[np.uint8]
    pixels: Float
    inliers: NDArray[np.bool_]
    rival_pixels: Float


def localization_figure(
    images: Sequence[DrawnImage], landmarks: Float, positions: Float, axes: Float, probabilities: Float
) -> Figure:
    """Draw images with their matches, and on a plan of landmarks (N, 3) the pose and its rivals (1 + R, 3), the pose first.

    `positions` and unit optical `axes` (1 + R, 3) are of the first image; z is up. Without a pose there are none.
    """
    columns = min(len(images), COLUMNS)
    rows = -(-len(images) // columns)
    widths = [HEIGHT_IN / rows * image.rgb.shape[1] / image.rgb.shape[0] for image in images[:columns]]
    widths += [PLAN_IN] if len(positions) else []
    with context(RC):
        figure = new_figure(sum(widths), HEIGHT_IN + 0.6 * rows)
        grid = figure.add_gridspec(rows, len(widths), width_ratios=widths)
        for n, image in enumerate(images):
            panel = figure.add_subplot(grid[divmod(n, columns)])
            panel.imshow(image.rgb)
            others = image.pixels[~image.inliers]
            for pixels, color, label in (
                (others, GREY, "other matches"),
                (image.rival_pixels, VERMILION, "inliers of the strongest rival"),
                (image.pixels[image.inliers], BLUE, "inliers"),
            ):
                if len(pixels):
                    panel.plot(*pixels.T, "o", color=color, markersize=2.5, label=f"{len(pixels)} {label}")
            panel.set_title(image.name)
            if len(image.pixels):
                panel.legend(loc="upper center", bbox_to_anchor=(0.5, -0.01), markerscale=2, fontsize=7)
            frame(panel)
        if len(positions):
            names = ["pose", *(f"rival {n}" for n in range(1, len(positions)))]
            plan = figure.add_subplot(grid[:, -1])
            draw_floor_plan(plan, landmarks, positions, axes, probabilities, names, "probability")
        return figure
