"""The paper's first figure: map, sampled viewpoints, ranked viewpoints, chosen camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.style import context
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from wheretolook.figures.floor_plan import BLUE, INK, VERMILION, frame, new_figure
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import Float
from wheretolook.view.drawing import frustum_corners, frustum_segments
from wheretolook_paper.figures.dollhouse import Dollhouse, draw_house, draw_points, draw_segments
from wheretolook_paper.figures.style import ONE_COLUMN_IN, ORANGE, PRINT, TWO_COLUMNS_IN


@dataclass(frozen=True, eq=False)
class Pipeline:
    """Data of `pipeline_figure`."""

    house: Dollhouse  # the scene from above
    landmarks: Float  # (N, 3) of the map, metres
    mapping_poses: Float  # cam_from_world (M, 3, 4) of the images that the map was made from
    camera: Camera  # intrinsics of all images
    locations: Float  # (L, 3) metres, the sampled locations that are shown
    n_locations: int  # in the whole scene
    n_directions: int  # at each location
    best_axes: Float  # (L, 3) unit optical axis of the best view of each location
    best_scores: Float  # (L,) its score, a probability
    chosen: Float  # cam_from_world (3, 4) of the camera that is chosen
    chosen_score: float
    seen: NDArray[np.bool_]  # (N,) whether it sees each landmark
    rgb: NDArray[np.uint8]  # (H, W, 3), its image
    outcome: str = ""  # how localizing it ended, in words; empty if not known


def pipeline_figure(pipeline: Pipeline) -> Figure:
    """Draw map, sampled viewpoints, ranked viewpoints and the chosen camera on the same picture of the scene.

    Landmarks on surfaces outside the picture, such as cut-off walls, are omitted.
    """
    with context(PRINT):
        top, bottom = _rows_drawn(pipeline.house)
        width = pipeline.house.rgb.shape[1]
        figure = new_figure(TWO_COLUMNS_IN, TWO_COLUMNS_IN * (bottom - top) / width + 0.6)
        panels = figure.subplots(2, 2).ravel()
        for panel, fade in zip(panels, (0.1, 0.15, 0.2, 0.0), strict=True):
            draw_house(panel, pipeline.house, fade)
            panel.set_ylim(bottom, top)
        _draw_map(panels[0], pipeline)
        _draw_samples(panels[1], pipeline)
        _draw_ranks(figure, panels[2], pipeline.house, pipeline.locations, pipeline.best_axes, pipeline.best_scores)
        panels[2].set_title("c  Ranked: the best view of each location", loc="left")
        _draw_choice(panels[3], pipeline)
        return figure


def _draw_map(axes: Axes, pipeline: Pipeline) -> None:
    shown = pipeline.landmarks[pipeline.house.shows(pipeline.landmarks)]
    draw_points(axes, pipeline.house, shown, s=0.9, color=ORANGE, rasterized=True)
    frusta = frustum_segments(pipeline.camera, pipeline.mapping_poses, 0.16)
    draw_segments(axes, pipeline.house, frusta, color="white", linewidth=1.3)
    draw_segments(axes, pipeline.house, frusta, color=BLUE, linewidth=0.6)
    axes.set_title(f"a  Map: {len(pipeline.landmarks):,} landmarks, {len(pipeline.mapping_poses)} cameras", loc="left")


def _draw_samples(axes: Axes, pipeline: Pipeline) -> None:
    spacing = _spacing(pipeline.locations)
    ends = pipeline.locations[:, None] + 0.42 * spacing * fibonacci_sphere(32)  # directions drawn of a location
    segments = np.stack([np.broadcast_to(pipeline.locations[:, None], ends.shape), ends], axis=-2)
    draw_segments(axes, pipeline.house, segments, color="white", linewidth=1.1)
    draw_segments(axes, pipeline.house, segments, color=BLUE, linewidth=0.5)
    draw_points(axes, pipeline.house, pipeline.locations, s=5, color=INK)
    part = f"{len(pipeline.locations)} of {pipeline.n_locations}"
    axes.set_title(f"b  Sampled: {part} locations × {pipeline.n_directions} directions", loc="left")


def ranked_figure(house: Dollhouse, locations: Float, best_axes: Float, best_scores: Float) -> Figure:
    """Draw the ranked viewpoints alone, one and a half columns wide; arguments as in `Pipeline`."""
    with context(PRINT):
        top, bottom = _rows_drawn(house)
        figure = new_figure(1.5 * ONE_COLUMN_IN, 1.5 * ONE_COLUMN_IN * (bottom - top) / house.rgb.shape[1])
        axes = figure.subplots()
        draw_house(axes, house, 0.5)
        axes.set_ylim(bottom, top)
        _draw_ranks(figure, axes, house, locations, best_axes, best_scores)
        return figure


def _draw_ranks(
    figure: Figure, axes: Axes, house: Dollhouse, locations: Float, best_axes: Float, best_scores: Float
) -> None:
    order = np.argsort(best_scores, kind="stable")
    at = locations[order]
    scores = best_scores[order]
    segments = np.stack([at, at + 0.8 * _spacing(locations) * best_axes[order]], axis=1)
    norm = Normalize(0, 1)
    draw_segments(axes, house, segments, color="white", linewidth=3.2)
    draw_segments(axes, house, segments, color=INK, linewidth=2.2)
    lines = draw_segments(axes, house, segments, array=scores, cmap="cividis", norm=norm, linewidth=1.5)
    draw_points(axes, house, at, s=15, c=scores, cmap="cividis", norm=norm, edgecolors=INK, linewidths=0.4, zorder=3)
    bar = figure.colorbar(lines, cax=axes.inset_axes((0.66, 0.04, 0.3, 0.025)), orientation="horizontal")
    bar.set_label("predicted probability", labelpad=1)
    bar.set_ticks([0, 0.5, 1], labels=["0", "0.5", "1"])


def _draw_choice(axes: Axes, pipeline: Pipeline) -> None:
    seen = pipeline.landmarks[pipeline.seen]
    seen = seen[pipeline.house.shows(seen)]
    draw_points(axes, pipeline.house, seen, s=1.2, color=ORANGE, rasterized=True)
    (corners,) = frustum_corners(pipeline.camera, pipeline.chosen, 0.7)
    pixels = pipeline.house.pixels(corners)
    axes.add_patch(Polygon(pixels[1:], facecolor=VERMILION, edgecolor="none", alpha=0.35))
    frustum = frustum_segments(pipeline.camera, pipeline.chosen, 0.7)
    draw_segments(axes, pipeline.house, frustum, color="white", linewidth=2.4)
    draw_segments(axes, pipeline.house, frustum, color=VERMILION, linewidth=1.2)
    draw_points(axes, pipeline.house, corners[:1], s=14, color=VERMILION, zorder=4)
    image = axes.inset_axes((0.6, 0.06, 0.4, 0.36))
    image.imshow(pipeline.rgb)
    image.set_anchor("SE")
    frame(image, VERMILION, 1.2)
    title = f"d  Chosen: {int(pipeline.seen.sum()):,} landmarks in view, score {pipeline.chosen_score:.2f}"
    axes.set_title(title, loc="left")
    axes.text(1.0, 0.04, pipeline.outcome, transform=axes.transAxes, fontsize=7, ha="right", va="top")


def _rows_drawn(house: Dollhouse) -> tuple[float, float]:
    """Return the first and last row of the picture with any surface, with a margin above."""
    rows = np.flatnonzero((house.depth_m > 0).any(1))
    height = len(house.depth_m)
    return max(0.0, float(rows[0]) - 0.07 * height), min(float(height), float(rows[-1]) + 0.02 * height)


def _spacing(locations: Float) -> float:
    """Return the median distance in metres from a location to its nearest neighbour."""
    if len(locations) < 2:
        return 0.5
    return float(np.median(cKDTree(locations).query(locations, k=2)[0][:, 1]))
