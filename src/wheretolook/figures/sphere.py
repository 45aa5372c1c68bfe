"""What each method thinks of every direction at one location."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.style import context
from numpy.typing import NDArray

from wheretolook.figures.style import INK, RC, new_figure
from wheretolook.geometry.poses import Float
from wheretolook.methods.styles import method_style


def viewpoint_sphere_figure(
    directions: Float, scores: Mapping[str, Float], good: NDArray[np.bool_] | None = None
) -> Figure:
    """Scores over the directions at one location, one map of the sphere of directions for each method.

    Args:
        directions: (D, 3) unit vectors the camera looks along, world frame.
        scores: (D,) by method.
        good: (D,) whether a view localizes; such directions get a dark ring.

    Returns:
        Hammer projections (equal area; azimuth to the right, elevation up). Colours show the rank of a direction among
        all of the location, from dark (worst) to light (best); the best one wears a star.
    """
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    elevation = np.arcsin(np.clip(directions[:, 2], -1, 1))
    size = 20000 / len(directions)
    with context(RC):
        figure = new_figure(5.2 * len(scores), 3.3)
        for column, (method, values) in enumerate(scores.items()):
            axes = figure.add_subplot(1, len(scores), column + 1, projection="hammer")
            rank = np.argsort(np.argsort(values, kind="stable"), kind="stable") / max(1, len(values) - 1)
            axes.scatter(azimuth, elevation, s=size, c=rank, cmap="cividis", vmin=0, vmax=1, linewidths=0)
            if good is not None:
                axes.scatter(azimuth[good], elevation[good], s=size, facecolors="none", edgecolors=INK, linewidths=1.0)
            best = int(np.argmax(values))
            axes.plot(azimuth[best], elevation[best], "*", markersize=17, color="#D55E00", markeredgecolor="white")
            axes.set(xticklabels=[], yticklabels=[], title=method_style(method).label)
        return figure
