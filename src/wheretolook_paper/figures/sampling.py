"""Figure of viewpoint sampling: free voxels, directions with the most visible landmarks, and occlusion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.style import context
from numpy.typing import NDArray

from wheretolook.figures.floor_plan import BLUE, INK, VERMILION, new_figure
from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.geometry.poses import Float, pan_tilt_angles
from wheretolook_paper.figures.dollhouse import Dollhouse, draw_house, draw_points, draw_segments
from wheretolook_paper.figures.style import ORANGE, PRINT, SKY, TWO_COLUMNS_IN, Style

_SIGHT_LINES = 120
_MARGIN_PX = 0.04


@dataclass(frozen=True, eq=False)
class Sampling:
    """Data of `sampling_figure`."""

    plan: Dollhouse  # the scene from straight above
    grid: VoxelGrid  # of the scene
    layer: NDArray[np.int64]  # ids of the voxels of one layer, (V,)
    free: NDArray[np.bool_]  # (V,) whether a camera can be there
    place: Float  # (3,) metres, the location whose directions and occlusion are drawn
    directions: Float  # (D, 3) unit optical axes
    n_visible: NDArray[np.int64]  # (D,) landmarks in view along each of them
    kept: NDArray[np.bool_]  # (D,) whether the direction is among the K that see most
    landmarks: Float  # (N, 3) metres
    unoccluded: NDArray[np.bool_]  # (N,) whether the landmark is unoccluded from the place


def sampling_figure(sampling: Sampling) -> Figure:
    """Draw locations, directions and occlusion.

    Left: one layer of voxels from above, the free ones shaded, the others hatched. Middle: the sphere of directions at
    one location (Hammer projection, equal area), the kept ones coloured by their number of landmarks in view. Right:
    which landmarks are unoccluded from the location.
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
    free_look: Style = {"facecolor": (*to_rgb(SKY), 0.45), "edgecolor": BLUE, "linewidth": 0.5}
    blocked_look: Style = {"edgecolor": "#777777", "linewidth": 0.3, "hatch": "/////"}
    for chosen, look in ((sampling.free, free_look), (~sampling.free, {"facecolor": (1, 1, 1, 0.35), **blocked_look})):
        squares = [Rectangle((float(a[0]), float(a[1])), *map(float, b - a)) for a, b in corners[chosen]]
        axes.add_collection(PatchCollection(squares, **look))
    draw_points(axes, sampling.plan, centers[sampling.free], s=2, color=BLUE)
    _mark_location(axes, sampling)
    low = corners.reshape(-1, 2).min(0)
    high = corners.reshape(-1, 2).max(0)
    margin = _MARGIN_PX * (high - low)
    axes.set(xlim=(low[0] - margin[0], high[0] + margin[0]), ylim=(high[1] + margin[1], low[1] - margin[1]))
    axes.set_anchor("N")
    axes.set_title("a  Locations", loc="left")
    free = Patch(label=f"{sampling.free.sum()} free", **free_look)
    blocked = Patch(label=f"{(~sampling.free).sum()} not", facecolor="white", **blocked_look)
    _legend_below(axes, [free, blocked])


def _draw_directions(figure: Figure, axes: Axes, sampling: Sampling) -> None:
    kept = sampling.kept
    size = 4500 / len(sampling.directions)
    dropped_at, kept_at = (pan_tilt_angles(sampling.directions[rows]) for rows in (~kept, kept))
    axes.scatter(*dropped_at, s=0.6 * size, facecolors="none", edgecolors="#aaaaaa", linewidths=0.5)
    colors: Style = {"c": sampling.n_visible[kept], "cmap": "cividis", "vmin": 0, "edgecolors": INK}
    dots = axes.scatter(*kept_at, s=size, linewidths=0.3, **colors)
    axes.set(xticklabels=[], yticklabels=[], anchor="N")
    axes.set_title(f"b  Directions: {kept.sum()} of {len(kept)} kept", loc="left")
    bar = figure.colorbar(dots, cax=axes.inset_axes((0.12, -0.14, 0.76, 0.06)), orientation="horizontal")
    bar.set_label("landmarks in view (open: dropped)")


def _draw_occlusion(axes: Axes, sampling: Sampling) -> None:
    draw_house(axes, sampling.plan, fade=0.6)
    unoccluded = sampling.landmarks[sampling.unoccluded]
    hidden = sampling.landmarks[~sampling.unoccluded]
    ends = unoccluded[:: max(1, len(unoccluded) // _SIGHT_LINES)]
    lines = np.stack([np.broadcast_to(sampling.place, ends.shape), ends], axis=1)
    draw_segments(axes, sampling.plan, lines, color=ORANGE, linewidth=0.3, alpha=0.7)
    draw_points(axes, sampling.plan, hidden, s=1.0, color=BLUE, rasterized=True)
    draw_points(axes, sampling.plan, unoccluded, s=1.0, color=ORANGE, rasterized=True)
    _mark_location(axes, sampling)
    axes.set_anchor("N")
    axes.set_title("c  Occlusion", loc="left")
    handles = []
    for name, color, points in (("in sight", ORANGE, unoccluded), ("hidden", BLUE, hidden)):
        dot: Style = {"linestyle": "none", "marker": "o", "markersize": 4, "color": color}
        handles.append(Line2D([], [], label=f"{len(points):,} {name}", **dot))
    _legend_below(axes, handles)


def _mark_location(axes: Axes, sampling: Sampling) -> None:
    star: Style = {"s": 75, "marker": "*", "color": VERMILION, "edgecolors": "white", "linewidths": 0.6}
    draw_points(axes, sampling.plan, sampling.place, zorder=4, **star)


def _legend_below(axes: Axes, handles: list[Patch] | list[Line2D]) -> None:
    padding: Style = {"columnspacing": 1.0, "handletextpad": 0.4, "borderaxespad": 0.2}
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=2, **padding)
