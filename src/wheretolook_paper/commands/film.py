"""A moving picture of a path: a camera that looks ahead beside one that looks where it was told, and where both are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.style import context
from tqdm.auto import tqdm

from wheretolook.figures.animation import pixels_of, save_moving
from wheretolook.figures.dollhouse import Dollhouse, dollhouse, draw_house, draw_segments, frustum_segments
from wheretolook.figures.style import BLUE, GREEN, RC, VERMILION, Style, new_figure
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.utils.errors import ConfigError
from wheretolook.view import drawing
from wheretolook.view.paths import FORWARD, RecordedPath
from wheretolook.view.scores import VisibleLandmarks, visible_landmarks
from wheretolook.view.shared import Shared
from wheretolook.view.state import ViewState

SIZE_IN = (7.6, 4.3)
DPI = 100
FRAME_MS = 220  # how long a picture stands, and the last
LAST_MS = 2500
MOST_FRAMES = 60
COLORS = {FORWARD: VERMILION}


def film(shared: Shared, path: Path, state: ViewState = ViewState()) -> int:
    """Write a film of the first and the last of the paths, .webp or .gif, in one step. Returns its number of pictures.

    Each view says whether it localized, if that was tried, or else whether its score is at least the threshold. Raises
    ConfigError without a mesh or with fewer than two paths.
    """
    try:
        if shared.viewed.mesh is None or len(shared.paths) < 2:
            fix = "Give --path of a scene with a mesh."
            raise ConfigError("a film needs a mesh, and two paths to compare", path=path, fix=fix)
        state = replace(
            state,
            method=state.method or shared.viewed.methods[0],
            occlusion=state.occlusion or shared.viewed.occlusions[0],
        )
        frames = list(_frames(shared, state))
    finally:
        shared.worker.stop()
    save_moving(frames, [FRAME_MS] * (len(frames) - 1) + [LAST_MS], path)
    return len(frames)


def _frames(shared: Shared, state: ViewState) -> Iterator[drawing.Rgb]:
    mesh = shared.viewed.mesh
    viewed = shared.viewed
    assert mesh is not None
    (first, ahead), *_, (second, told) = shared.paths.items()
    look = shared.selector(state.method, state.occlusion)
    verdicts = [_localized(played, look.scorer.score(played.cam_from_world), state) for played in (ahead, told)]
    heights = camera_centers(told.cam_from_world)[:, 2]
    house = dollhouse(mesh, elevation_deg=62, cut_m=float(heights.max()) + 0.3, width_px=700)
    for number in tqdm(_steps(max(len(ahead), len(told))), desc="film", unit="picture"):
        with context(RC):
            figure = new_figure(*SIZE_IN)
            figure.set_dpi(DPI)
            grid = figure.add_gridspec(2, 2, width_ratios=(1.6, 1.0))
            above = figure.add_subplot(grid[:, 0])
            draw_house(above, house, 0.35)
            for row, (name, played, good) in enumerate(zip((first, second), (ahead, told), verdicts, strict=True)):
                at = min(round(number * (len(played) - 1)), len(played) - 1)
                color = COLORS.get(name, BLUE)
                _draw_way(above, house, played.cam_from_world, good, at, color, viewed.camera, shared.marker_m)
                seen = visible_landmarks(
                    look.scorer, played.cam_from_world[at], shared.landmark_scorer(state.occlusion)
                )
                image, _ = viewed.picture(played.cam_from_world[at], VisibleLandmarks(*_marked(seen)))
                _draw_view(figure.add_subplot(grid[row, 1]), image, name, bool(good[at]), good[: at + 1], color)
            yield pixels_of(figure)


def _marked(seen: VisibleLandmarks) -> tuple[Float, Float, Float]:
    """The landmarks likely to be found: a dot for each one in view would hide the picture."""
    likely = np.nan_to_num(seen.probabilities) >= 0.3
    return seen.points[likely], seen.pixels[likely], seen.probabilities[likely]


def _steps(n: int) -> Float:
    """Shares of the way (K,), from 0 to 1, as many as there are views but not too many."""
    return np.linspace(0, 1, min(n, MOST_FRAMES))


def _localized(played: RecordedPath, scores: Float, state: ViewState) -> np.ndarray:
    return scores >= state.threshold if played.localized is None else played.localized


def _draw_way(
    axes: Axes, house: Dollhouse, poses: Float, good: np.ndarray, at: int, color: str, camera: Camera, mark_m: float
) -> None:
    """The way so far, green where the view localized; the rest of it thin; the camera."""
    centers = camera_centers(poses)
    pairs = np.stack([centers[:-1], centers[1:]], axis=1)
    draw_segments(axes, house, pairs, colors=color, linewidths=1.0, alpha=0.5)
    if at:
        ways = [GREEN if found else "#BBBBBB" for found in good[1 : at + 1]]
        draw_segments(axes, house, pairs[:at], colors="white", linewidths=5)
        draw_segments(axes, house, pairs[:at], colors=ways, linewidths=3)
    edges = frustum_segments(camera, poses[at : at + 1], 2.5 * mark_m)
    draw_segments(axes, house, edges, colors="white", linewidths=3.5)
    draw_segments(axes, house, edges, colors=color, linewidths=1.8)


def _draw_view(axes: Axes, image: drawing.Rgb, name: str, good: bool, so_far: np.ndarray, color: str) -> None:
    axes.imshow(image)
    axes.set(xticks=[], yticks=[])
    axes.grid(False)
    axes.spines[:].set(visible=True, color=GREEN if good else VERMILION, linewidth=4)
    title = "looks ahead" if name == FORWARD else "looks where it was told"
    axes.set_title(title, fontsize=11, color=color, fontweight="bold", loc="left")
    share = f"{100 * np.mean(so_far):.0f} % so far"
    verdict = f"localized: {share}" if good else f"LOST, localized: {share}"
    box = {"boxstyle": "square,pad=0.3", "facecolor": GREEN if good else VERMILION, "edgecolor": "none"}
    place: Style = {"transform": axes.transAxes, "ha": "left", "va": "bottom"}
    axes.text(0.03, 0.04, verdict, fontsize=10, color="white", fontweight="bold", bbox=box, **place)
