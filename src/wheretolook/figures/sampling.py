"""Where viewpoints are sampled: free voxels, directions kept by what they see, and what hides landmarks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.style import context
from numpy.typing import NDArray

from wheretolook.figures.dollhouse import BLUE, ORANGE, SKY, VERMILION, draw_house, draw_points, draw_segments
from wheretolook.figures.house_image import Dollhouse
from wheretolook.figures.style import INK, PRINT, TWO_COLUMNS_IN, new_figure
from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.geometry.poses import Float

_SIGHT_LINES = 120
_MARGIN_PX = 0.04


@dataclass(frozen=True, eq=False)
class Sampling:
    """What the figure draws.

    Attributes:
        plan: the scene from straight above.
        grid: voxels of the scene.
        layer: ids of the voxels of one layer, (V,).
        free: (V,) whether a camera can be there.
        place: (3,) metres, the location that is looked at closely.
        directions: (D, 3) unit optical axes.
        n_visible: (D,) landmarks in view along each of them.
        kept: (D,) whether the direction is among the K that see most.
        landmarks: (N, 3) metres.
        unoccluded: (N,) whether nothing stands between the place and the landmark.
    """

    plan: Dollhouse
    grid: VoxelGrid
    layer: NDArray[np.int64]
    free: NDArray[np.bool_]
    place: Float
    directions: Float
    n_visible: NDArray[np.int64]
    kept: NDArray[np.bool_]
    landmarks: Float
    unoccluded: NDArray[np.bool_]


def sampling_figure(sampling: Sampling) -> Figure:
    """Locations, directions and occlusion.

    Returns:
        Three panels as wide as two columns. Left: one layer of voxels from above, the free ones shaded, the others
        hatched. Middle: the sphere of directions at one location (Hammer projection, equal area), the kept ones by the
        number of landmarks they see, the dropped ones open. Right: which landmarks have a free line of sight to it.
    """
    with context(PRINT):
        figure = new_figure(TWO_COLUMNS_IN, 2.7)
        grid = figure.add_gridspec(1, 3, width_ratios=(1.1, 1.2, 1.1))
        _draw_voxels(figure.add_subplot(grid[0]), sampling)
        _draw_directions(figure, figure.add_subplot(grid[1], projection="hammer"), sampling)
        _draw_occlusion(figure.add_subplot(grid[2]), sampling)
        return figure


def _draw_voxels(axes: Axes, sampling: Sampling) -> None:
    draw_house(axes, sampling.plan, fade=0.55)
    half = sampling.grid.voxel_m / 2
    centers = sampling.grid.centers()[sampling.layer]
    corners = sampling.plan.pixels(np.stack([centers - half, centers + half], axis=1))
    looks: tuple[tuple[NDArray[np.bool_], dict[str, Any]], ...] = (
        (sampling.free, {"facecolor": (*to_rgb(SKY), 0.45), "edgecolor": BLUE, "linewidth": 0.5}),
        (~sampling.free, {"facecolor": (1, 1, 1, 0.35), "edgecolor": "#777777", "linewidth": 0.3, "hatch": "/////"}),
    )
    for chosen, style in looks:
        squares = [Rectangle((float(a[0]), float(a[1])), *map(float, b - a)) for a, b in corners[chosen]]
        axes.add_collection(PatchCollection(squares, **style))
    draw_points(axes, sampling.plan, centers[sampling.free], s=2, color=BLUE)
    _mark_place(axes, sampling)
    low, high = corners.reshape(-1, 2).min(0), corners.reshape(-1, 2).max(0)
    margin = _MARGIN_PX * (high - low)
    axes.set(xlim=(low[0] - margin[0], high[0] + margin[0]), ylim=(high[1] + margin[1], low[1] - margin[1]))
    axes.set_anchor("N")
    axes.set_title("a  Locations", loc="left")
    free = Patch(facecolor=(*to_rgb(SKY), 0.45), edgecolor=BLUE, linewidth=0.5, label=f"{sampling.free.sum()} free")
    taken = Patch(facecolor="white", edgecolor="#777777", linewidth=0.3, hatch="/////",
                  label=f"{(~sampling.free).sum()} not")  # fmt: skip
    _legend_below(axes, [free, taken])


def _draw_directions(figure: Figure, axes: Axes, sampling: Sampling) -> None:
    azimuth = np.arctan2(sampling.directions[:, 1], sampling.directions[:, 0])
    elevation = np.arcsin(np.clip(sampling.directions[:, 2], -1, 1))
    kept, size = sampling.kept, 4500 / len(sampling.directions)
    axes.scatter(azimuth[~kept], elevation[~kept], s=0.6 * size, facecolors="none", edgecolors="#aaaaaa",
                 linewidths=0.5)  # fmt: skip
    dots = axes.scatter(azimuth[kept], elevation[kept], s=size, c=sampling.n_visible[kept], cmap="cividis", vmin=0,
                        edgecolors=INK, linewidths=0.3)  # fmt: skip
    axes.set(xticklabels=[], yticklabels=[], anchor="N")
    axes.set_title(f"b  Directions: {kept.sum()} of {len(kept)} kept", loc="left")
    bar = figure.colorbar(dots, cax=axes.inset_axes((0.12, -0.14, 0.76, 0.06)), orientation="horizontal")
    bar.set_label("landmarks in view (open: dropped)")


def _draw_occlusion(axes: Axes, sampling: Sampling) -> None:
    draw_house(axes, sampling.plan, fade=0.6)
    seen, hidden = sampling.landmarks[sampling.unoccluded], sampling.landmarks[~sampling.unoccluded]
    lines = seen[:: max(1, len(seen) // _SIGHT_LINES)]
    draw_segments(axes, sampling.plan, np.stack([np.broadcast_to(sampling.place, lines.shape), lines], axis=1),
                  color=ORANGE, linewidth=0.3, alpha=0.7)  # fmt: skip
    draw_points(axes, sampling.plan, hidden, s=1.0, color=BLUE, rasterized=True)
    draw_points(axes, sampling.plan, seen, s=1.0, color=ORANGE, rasterized=True)
    _mark_place(axes, sampling)
    axes.set_anchor("N")
    axes.set_title("c  Occlusion", loc="left")
    handles = [
        Line2D([], [], linestyle="none", marker="o", markersize=4, color=color, label=f"{len(points):,} {name}")
        for name, color, points in (("in sight", ORANGE, seen), ("hidden", BLUE, hidden))
    ]
    _legend_below(axes, handles)


def _mark_place(axes: Axes, sampling: Sampling) -> None:
    draw_points(axes, sampling.plan, sampling.place, s=75, marker="*", color=VERMILION, edgecolors="white",
                linewidths=0.6, zorder=4)  # fmt: skip


def _legend_below(axes: Axes, handles: list[Patch] | list[Line2D]) -> None:
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=2, columnspacing=1.0,
                handletextpad=0.4, borderaxespad=0.2)  # fmt: skip
