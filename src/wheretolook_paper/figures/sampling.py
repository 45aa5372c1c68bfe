"""Figures of viewpoint sampling: free voxels, directions with the most visible landmarks, occlusion, and lattices."""

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
from scipy.spatial import ConvexHull, cKDTree

from wheretolook.figures.floor_plan import BLUE, INK, RC, VERMILION, new_figure
from wheretolook.geometry.lattices import VoxelGrid, azimuth_elevation_lattice, fibonacci_sphere, released_lattice
from wheretolook.geometry.poses import Float, pan_tilt_angles
from wheretolook_paper.figures.dollhouse import Dollhouse, draw_house, draw_points, draw_segments
from wheretolook_paper.figures.style import GREEN, GRID, ORANGE, PRINT, SKY, TWO_COLUMNS_IN, Style


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
    margin = 0.04 * (high - low)
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
    ends = unoccluded[:: max(1, len(unoccluded) // 120)]
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


def covering_radius_deg(directions: Float) -> float:
    """Return the largest angle in degrees from any direction to the nearest of (n, 3) unit vectors.

    Exact: the farthest direction is the normal of a face of the convex hull. Not all vectors may be in one
    half-space.
    """
    return float(np.degrees(np.arccos(np.clip(-ConvexHull(directions).equations[:, 3].max(), -1, 1))))


def nearest_angles_deg(directions: Float) -> Float:
    """Return the angle (n,) in degrees from each of (n, 3) unit vectors to its nearest neighbour."""
    chord = cKDTree(directions).query(directions, k=2)[0][:, 1]
    return np.degrees(2 * np.arcsin(np.clip(chord / 2, 0, 1)))


def fibonacci_figure(n: int = 500) -> Figure:
    """Draw the spherical Fibonacci lattice, the azimuth-elevation lattice and that of the paper's released code.

    Each has about `n` directions and is drawn as a sphere seen from 25 degrees above the equator, directions on the far
    side pale.
    """
    lattices = (
        ("spherical Fibonacci", fibonacci_sphere(n), VERMILION),
        ("azimuth-elevation", azimuth_elevation_lattice(n), BLUE),
        ("released code of the paper", released_lattice(n), GREEN),
    )
    with context(RC):
        figure = new_figure(10.5, 4.2)
        for column, (name, directions, color) in enumerate(lattices):
            axes = figure.add_subplot(1, 3, column + 1)
            _draw_sphere(axes, directions, color)
            nearest = nearest_angles_deg(directions)
            axes.set_title(f"{name}, n = {len(directions)}")
            covering = f"covering radius {covering_radius_deg(directions):.1f}°"
            spread = f"nearest neighbours {nearest.min():.1f}° to {nearest.max():.1f}°"
            axes.text(0, -1.12, f"{covering}\n{spread}", ha="center", va="top")
        return figure


def _draw_sphere(axes: Axes, directions: Float, color: str) -> None:
    """Draw directions on a sphere, in orthographic projection."""
    tilt = np.radians(25)
    # rows: right, up and towards a viewer 25 degrees above the equator in the direction of -y
    view = np.array([[1, 0, 0], [0, np.sin(tilt), np.cos(tilt)], [0, -np.cos(tilt), np.sin(tilt)]])
    x, y, depth = view @ directions.T
    turn = np.linspace(0, 2 * np.pi, 200)
    axes.fill(np.cos(turn), np.sin(turn), color="#f7f7f7", zorder=0)
    axes.plot(np.cos(turn), np.sin(turn), color=INK, linewidth=0.8, zorder=0)
    for height in np.sin(np.radians([-60, -30, 0, 30, 60])):
        radius = np.sqrt(1 - height**2)
        _draw_arc(axes, view @ [radius * np.cos(turn), radius * np.sin(turn), np.full_like(turn, height)])
    for azimuth in np.radians(np.arange(0, 180, 30)):
        _draw_arc(axes, view @ [np.sin(turn) * np.cos(azimuth), np.sin(turn) * np.sin(azimuth), np.cos(turn)])
    front = depth > 0
    axes.scatter(x[~front], y[~front], s=5, color=color, alpha=0.18, linewidths=0)
    axes.scatter(x[front], y[front], s=13, color=color, linewidths=0)
    axes.set_aspect("equal")
    axes.set(xlim=(-1.05, 1.05), ylim=(-1.42, 1.05))
    axes.axis("off")


def _draw_arc(axes: Axes, points: Float) -> None:
    x, y, depth = points
    axes.plot(np.where(depth > 0, x, np.nan), y, color=GRID, linewidth=0.6, zorder=1)
