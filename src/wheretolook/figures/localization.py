"""Figure of a localized image or rig: matches in the images, and the pose with its rivals on the floor plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.style import context
from numpy.typing import NDArray

from wheretolook.figures.floor_plan import draw_floor_plan
from wheretolook.figures.style import BLUE, GREY, RC, VERMILION, frame, new_figure
from wheretolook.geometry.poses import Float

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
