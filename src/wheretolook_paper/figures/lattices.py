"""Figure of the lattices of directions."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context
from scipy.spatial import ConvexHull, cKDTree

from wheretolook.figures.floor_plan import BLUE, INK, RC, VERMILION, new_figure
from wheretolook.geometry.lattices import azimuth_elevation_lattice, fibonacci_sphere, released_lattice
from wheretolook.geometry.poses import Float
from wheretolook_paper.figures.style import GREEN, GRID


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
