"""A film of two recorded paths: the cameras' images side by side, and both on the map."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.style import context
from tqdm.auto import tqdm

from wheretolook.figures.floor_plan import BLUE, RC, VERMILION, frame, new_figure
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.views import Views
from wheretolook.planning.config import FORWARD
from wheretolook.utils.errors import ConfigError
from wheretolook.view import drawing
from wheretolook.view.drawing import VisibleLandmarks, frustum_segments
from wheretolook.view.state import ViewState
from wheretolook.view.viewed_map import ViewedMap
from wheretolook_paper.figures.animation import pixels_of, save_moving
from wheretolook_paper.figures.dollhouse import Dollhouse, dollhouse, draw_house, draw_segments
from wheretolook_paper.figures.style import GREEN, Style

FRAME_MS = 220
LAST_MS = 2500  # the last frame
MIN_PROBABILITY = 0.3  # of drawn landmarks; all visible ones would cover the image


def film(viewed: ViewedMap, path: Path, state: ViewState = ViewState()) -> int:
    """Write a film (.webp or .gif) of the first and the last of the paths; return its number of frames.

    A view is good if it localized, or, for paths that were not localized, if its score reaches the threshold. Raises
    ConfigError without a mesh or with fewer than two paths.
    """
    if viewed.mesh is None:
        fix = "Leave --film out for the page in the browser, or give --record FILE.rrd for a recording."
        raise ConfigError("a film shows a mesh, and there is none here", path=path, value=viewed.name, fix=fix)
    if len(viewed.paths) < 2:
        raise ConfigError("a film compares two paths", path=path, value=[*viewed.paths], fix="Give --path.")
    frames = list(_frames(viewed, viewed.complete(state)))
    save_moving(frames, FRAME_MS, path, LAST_MS)
    return len(frames)


def _frames(viewed: ViewedMap, state: ViewState) -> Iterator[drawing.Rgb]:
    assert viewed.mesh is not None
    scorer = viewed.selector(state.method, state.occlusion).scorer
    named = list(viewed.paths.items())
    paths = []
    for name, path in (named[0], named[-1]):
        scores = scorer.score(path.cam_from_world)
        good = scores >= state.threshold if path.good is None else path.good
        paths.append(replace(path, method=name, good=good))
    heights = paths[1].positions[:, 2]
    house = dollhouse(viewed.mesh, elevation_deg=62, cut_m=float(heights.max()) + 0.3, width_px=700)
    n_frames = min(max(len(filmed) for filmed in paths), 60)
    for share in tqdm(np.linspace(0, 1, n_frames), desc="film", unit="frame"):
        with context(RC):
            figure = new_figure(7.6, 4.3)
            figure.set_dpi(100)
            grid = figure.add_gridspec(2, 2, width_ratios=(1.6, 1.0))
            above = figure.add_subplot(grid[:, 0])
            draw_house(above, house, 0.35)
            for row, filmed in enumerate(paths):
                at = round(share * (len(filmed) - 1))
                pose = filmed.cam_from_world[at]
                _draw_path(above, house, filmed, at, viewed.camera, viewed.marker_m)
                visible = viewed.visible_landmarks(state.method, state.occlusion, pose)
                likely = np.nan_to_num(visible.probabilities) >= MIN_PROBABILITY
                shown = (visible.points[likely], visible.pixels[likely], visible.probabilities[likely])
                image, _ = viewed.picture(pose, VisibleLandmarks(*shown))
                _draw_view(figure.add_subplot(grid[row, 1]), image, filmed, at)
            yield pixels_of(figure)


def _color(filmed: Views) -> str:
    return VERMILION if filmed.method == FORWARD else BLUE


def _draw_path(axes: Axes, house: Dollhouse, filmed: Views, at: int, camera: Camera, marker_m: float) -> None:
    """Draw the path so far, green where views localize, the rest thin, and the camera."""
    poses = filmed.cam_from_world
    centers = filmed.positions
    pairs = np.stack([centers[:-1], centers[1:]], axis=1)
    draw_segments(axes, house, pairs, colors=_color(filmed), linewidths=1.0, alpha=0.5)
    if at:
        colors = [GREEN if good else "#BBBBBB" for good in filmed.good[1 : at + 1]]
        draw_segments(axes, house, pairs[:at], colors="white", linewidths=5)
        draw_segments(axes, house, pairs[:at], colors=colors, linewidths=3)
    edges = frustum_segments(camera, poses[at : at + 1], 2.5 * marker_m)
    draw_segments(axes, house, edges, colors="white", linewidths=3.5)
    draw_segments(axes, house, edges, colors=_color(filmed), linewidths=1.8)


def _draw_view(axes: Axes, image: drawing.Rgb, filmed: Views, at: int) -> None:
    good = bool(filmed.good[at])
    color = GREEN if good else VERMILION
    axes.imshow(image)
    frame(axes, color, 4)
    title = "looks ahead" if filmed.method == FORWARD else "selected views"
    axes.set_title(title, fontsize=11, color=_color(filmed), fontweight="bold", loc="left")
    share = f"{100 * np.mean(filmed.good[: at + 1]):.0f} % so far"
    verdict = f"localized: {share}" if good else f"LOST, localized: {share}"
    box = {"boxstyle": "square,pad=0.3", "facecolor": color, "edgecolor": "none"}
    place: Style = {"transform": axes.transAxes, "ha": "left", "va": "bottom"}
    axes.text(0.03, 0.04, verdict, fontsize=10, color="white", fontweight="bold", bbox=box, **place)
