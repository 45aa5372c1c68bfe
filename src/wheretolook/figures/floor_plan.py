"""Figures: floor plans with views, images with matches, and the style and files of all figures."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context
from numpy.typing import NDArray

from wheretolook.figures import KINDS
from wheretolook.geometry.poses import Float
from wheretolook.mapping.map_frame import IDENTITY, MapFrame
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import write_bytes

INK = "#333333"
GREY = "#7a7a7a"
BLUE = "#0072B2"
VERMILION = "#D55E00"
"""Colours; the last two of the colour-blind-safe palette of Okabe and Ito (2008)."""

RC: dict[str, Any] = {
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "grid.color": "#d9d9d9",
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.labelsize": 10,
    "legend.fontsize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.6,
    "hatch.linewidth": 0.7,
    "legend.frameon": False,
    "figure.dpi": 100,
    "savefig.dpi": 160,
    "savefig.bbox": "tight",
    "svg.hashsalt": "wheretolook",
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
}
"""Matplotlib parameters of figures on screen."""


def new_figure(width_in: float, height_in: float) -> Figure:
    """Create an empty figure independent of pyplot. Draw into it within `with context(RC):`."""
    with context(RC):
        return Figure(figsize=(width_in, height_in), layout="constrained")


def frame(axes: Axes, color: str = INK, linewidth: float = 0.5) -> None:
    """Draw a frame around the axes of an image, without ticks and grid."""
    axes.set(xticks=[], yticks=[])
    axes.grid(False)
    axes.spines[:].set(visible=True, linewidth=linewidth, color=color)


def save_figure(figure: Figure, path: Path, note: str = "") -> None:
    """Write a figure to `path` (.png, .pdf or .svg) atomically; equal figures give equal bytes.

    `note`, such as the runs that the figure shows, is stored in the file's metadata. Raises ConfigError for another
    format.
    """
    kind = path.suffix[1:].lower()
    if kind not in KINDS:
        raise ConfigError("unsupported figure format", path=path, fix=f"Use {', '.join(KINDS)}.")
    # The field of a file's metadata that holds the note, and fields without dates and versions.
    field, metadata = {
        "png": ("Description", {"Software": None}),
        "pdf": ("Subject", {"CreationDate": None, "Creator": None}),
        "svg": ("Description", {"Date": None}),
    }[kind]
    buffer = io.BytesIO()  # the PDF writer does not report the cause of a failed write
    with context(RC):
        figure.savefig(buffer, format=kind, metadata=metadata | ({field: note} if note else {}))
    write_bytes(path, buffer.getvalue())


def floor_plan_figure(
    landmarks: Float, positions: Float, axes: Float, scores: Float, names: Sequence[str], of: MapFrame = IDENTITY
) -> Figure:
    """Draw landmarks (N, 3), and views as arrows coloured by score (V,).

    Views have positions (V, 3), unit optical axes (V, 3) and names of their locations; z is up. The axes are labelled as
    those `of` the map's own frame, which these are turned from and in whose unit they are.
    """
    low, high = plan_extent(landmarks, positions)
    with context(RC):
        width, height = (high - low) / (high - low).max()
        figure = new_figure(2 + 7 * max(width, 0.3), 1 + 7 * max(height, 0.3))
        draw_floor_plan(figure.add_subplot(), landmarks, positions, axes, scores, names, "score", of)
        return figure


def draw_floor_plan(
    plan: Axes,
    landmarks: Float,
    positions: Float,
    axes: Float,
    scores: Float,
    names: Sequence[str],
    label: str,
    of: MapFrame = IDENTITY,
) -> None:
    """Draw what `floor_plan_figure` takes, with a colour bar of the given label."""
    low, high = plan_extent(landmarks, positions)
    inside = landmarks[((landmarks[:, :2] >= low) & (landmarks[:, :2] <= high)).all(axis=1)]
    drawn = inside[:: len(inside) // 30_000 + 1]
    arrows = 0.06 * float(np.linalg.norm(high - low)) * axes[:, :2]
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
    if len(places) <= 30:  # names of more would hide each other
        for name, place in places.items():
            plan.annotate(name, place, (3, 3), textcoords="offset points", fontsize=8)
    plan.set(aspect="equal")
    label_plan(plan, of, low, float((high - low).max()))
    plan.figure.colorbar(shown, ax=plan, shrink=0.7, label=label)


def label_plan(plan: Axes, of: MapFrame, corner: Float, size: float) -> None:
    """Label the axes of a plan; draw those of a map that is turned upright from a corner (2,) of a plan of that size."""
    if not of.is_turned:
        plan.set(xlabel=f"x ({of.unit})", ylabel=f"y ({of.unit})")
        return
    length = float(f"{size / 4:.0e}")
    directions = length * of.world_from_map.rotation[:2].T
    start = corner - directions.min(axis=0)
    for name, direction in zip("xyz", directions, strict=True):
        plan.annotate(name, tuple(start), tuple(start + direction), arrowprops={"arrowstyle": "<-", "color": INK})
    text = f"the map's own axes, {length:g} {of.unit} long; it is turned upright here only"
    plan.set(xticks=[], yticks=[], xlabel=text)


def plan_extent(landmarks: Float, positions: Float) -> tuple[Float, Float]:
    """Return the lowest and highest x and y, (2,) each, of a plan of positions and of the landmarks that are not far out."""
    low, first, third, high = np.quantile(landmarks[:, :2], (0.01, 0.25, 0.75, 0.99), axis=0)
    fence = 3 * (third - first).max()  # beyond it values are far out (Tukey 1977)
    low = np.maximum(low, first - fence)
    high = np.minimum(high, third + fence)
    return np.minimum(low, positions[:, :2].min(axis=0)), np.maximum(high, positions[:, :2].max(axis=0))


@dataclass(frozen=True, eq=False)
class DrawnImage:
    """An image (H, W, 3) uint8, and in it matches (M, 2), of these the inliers (M,), and the strongest rival's inliers."""

    name: str
    rgb: NDArray[np.uint8]
    pixels: Float
    inliers: NDArray[np.bool_]
    rival_pixels: Float


def localization_figure(
    images: Sequence[DrawnImage],
    landmarks: Float,
    positions: Float,
    axes: Float,
    probabilities: Float,
    of: MapFrame = IDENTITY,
) -> Figure:
    """Draw images with their matches, and on a plan of landmarks (N, 3) the pose and its rivals (1 + R, 3), the pose first.

    `positions` and unit optical `axes` (1 + R, 3) are of the first image; z is up. Without a pose there are none.
    """
    columns = min(len(images), 2)
    rows = -(-len(images) // columns)
    height_in = 5.0
    widths = [height_in / rows * image.rgb.shape[1] / image.rgb.shape[0] for image in images[:columns]]
    widths += [6.5] if len(positions) else []
    with context(RC):
        figure = new_figure(sum(widths), height_in + 0.6 * rows)
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
            draw_floor_plan(plan, landmarks, positions, axes, probabilities, names, "probability", of)
        return figure
