"""Figures of several views from one location: shares by selection strategy, and what each localizes alone and jointly."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context
from numpy.typing import ArrayLike

from wheretolook.dataset.config import THRESHOLDS
from wheretolook.figures.floor_plan import BLUE, GREY, INK, RC, VERMILION, new_figure
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float, pose_error
from wheretolook.localization.localizer import Localizer
from wheretolook.localization.rig import Look, rig_of
from wheretolook.localization.rig_localization import JointLocalization, JointLocalizer
from wheretolook.utils.errors import PoseError
from wheretolook.view.drawing import frustum_segments
from wheretolook_paper.evaluation.label_report import length_text
from wheretolook_paper.evaluation.looks import TOGETHER
from wheretolook_paper.figures.animation import Pixels, pixels_of
from wheretolook_paper.figures.dollhouse import Dollhouse, draw_house, draw_segments
from wheretolook_paper.figures.style import GREEN, ORANGE, PURPLE, SKY, Style

_STYLES: dict[str, tuple[str, str, str]] = {
    TOGETHER: ("chosen jointly", BLUE, "o"),
    "one-by-one": ("one by one, 40° apart", ORANGE, "s"),
    "fisher": ("Fisher information of all", GREEN, "^"),
    "visible": ("most landmarks in view", PURPLE, "D"),
    "even": ("evenly spread", SKY, "v"),
    "random": ("drawn at random", GREY, "x"),
}
"""Label, colour and marker of the drawn strategies."""

_TITLES = {"val": "validation scenes", "test": "test scenes, some by others"}


def looks_figure(table: pd.DataFrame) -> Figure:
    """Draw the share of locations localized jointly over the number of views, a panel for each split.

    `table` has the columns of `look_table`, of which `strategy`, `n_looks`, `n_locations`, `good` and `any_good` are
    drawn, `split` if there are several, and the interval of the product's strategy if present. The dashed line is the
    share of locations at which any view of the largest sets localizes alone, an upper bound for choosing one of them.
    """
    splits = [(_TITLES.get(str(name), str(name)), rows) for name, rows in table.groupby("split", sort=False)] \
        if "split" in table else [("", table)]  # fmt: skip
    with context(RC):
        figure = new_figure(3.9 * len(splits) + 2.4, 3.6)
        panels = figure.subplots(1, len(splits), sharey=True, squeeze=False)[0]
        for axes, (title, rows) in zip(panels, splits, strict=True):
            _draw(axes, rows)
            axes.set(title=f"{title}, {rows['n_locations'].iloc[0]} locations" if title else "", xlabel="views")
        panels[0].set_ylabel("locations localized jointly (%)")
        shown = {text: line for axes in panels for line, text in zip(*axes.get_legend_handles_labels(), strict=True)}
        figure.legend(shown.values(), shown.keys(), loc="outside right center")
        return figure


def _draw(axes: Axes, table: pd.DataFrame) -> None:
    for name, (label, color, marker) in _STYLES.items():
        rows = table[table["strategy"] == name].sort_values("n_looks")
        if rows.empty:
            continue
        look: dict[str, Any] = {"color": color, "marker": marker, "markersize": 5}
        look |= {"linewidth": 2.4, "zorder": 4} if name == TOGETHER else {"linewidth": 1.2}
        axes.plot(rows["n_looks"], 100 * rows["good"], label=label, **look)
        if name == TOGETHER:
            if "good_low" in rows:
                low = 100 * rows["good_low"]
                high = 100 * rows["good_high"]
                axes.fill_between(rows["n_looks"], low, high, color=color, alpha=0.15, linewidth=0)
            most = rows.dropna(subset="any_good").nlargest(1, "n_looks")
            for n, value in zip(most["n_looks"], 100 * most["any_good"], strict=True):
                axes.axhline(value, color=INK, linestyle="--", linewidth=1, label=f"any of the {n} alone")
            one = rows[rows["n_looks"] == 1]
            for value in 100 * one["good"]:
                axes.axhline(value, color=VERMILION, linewidth=0.9, linestyle=":", label="one view")
    axes.set_xticks(sorted(table["n_looks"].unique()))


MAX_ERROR_M, MAX_ERROR_DEG = THRESHOLDS[0]
FRAME_MS = 2200
LAST_MS = 4000  # the frame of all views


@dataclass(frozen=True, eq=False)
class Estimate:
    """The result of localizing one view, or several jointly.

    Attributes:
        cams_from_world: (N, 3, 4) estimated poses; None without one.
        pixels: N arrays (I_k, 2) of the inliers' pixels.
        probability: that the pose is within 5 cm and 0.4 degrees.
        error_m: of the worst view; infinite without a pose.
        error_deg: likewise.
    """

    cams_from_world: Float | None
    pixels: tuple[Float, ...]
    probability: float
    error_m: float
    error_deg: float

    @property
    def is_good(self) -> bool:
        """Whether the pose is within 5 cm and 0.4 degrees."""
        return self.error_m <= MAX_ERROR_M and self.error_deg <= MAX_ERROR_DEG

    @property
    def color(self) -> str:
        """Color of the result in figures."""
        return GREEN if self.is_good else VERMILION

    @property
    def summary(self) -> str:
        """The result in a few words."""
        if self.cams_from_world is None:
            return "no pose estimated"
        n_inliers = sum(map(len, self.pixels))
        if self.is_good:
            return f"{n_inliers} inliers, correct, {length_text(self.error_m)} off"
        off = length_text(self.error_m) if self.error_m > MAX_ERROR_M else f"{self.error_deg:.1f}°"
        return f"{n_inliers} inliers, wrong, {off} off"


Result = tuple[str, list[int], Estimate]
"""A result: its label, the rows of its views, and the estimate."""


@dataclass(frozen=True, eq=False)
class LookStory:
    """N views of a camera at one location, the result of each, and of all jointly."""

    camera: Camera
    cam_from_world: Float  # (N, 3, 4), true
    images: Pixels  # (N, H, W, 3)
    single: tuple[Estimate, ...]
    joint: Estimate
    steps: tuple[Result, ...] = ()  # if they are taken one after another: the result after each

    @property
    def results(self) -> list[Result]:
        """The result of each view, then of all jointly; or after each view."""
        if self.steps:
            return [*self.steps]
        single = [(f"view {k + 1}", [k], estimate) for k, estimate in enumerate(self.single)]
        return [*single, ("all views", [*range(len(self.single))], self.joint)]


def localize_views(localizer: Localizer, camera: Camera, cam_from_world: ArrayLike, images: Pixels) -> LookStory:
    """Localize images (N, H, W, 3) of views (N, 3, 4) at one location, each alone and all jointly.

    Raises a PoseError if there are fewer than two views, or they are at different locations.
    """
    true = np.asarray(cam_from_world, dtype=np.float64)
    if len(true) < 2:
        raise PoseError("a story of views needs at least two", value=len(true))
    joint = JointLocalizer(localizer.estimator)
    single = [localizer.localize(image) for image in images]
    views = [
        Look(cam_from_rig, one.matched_pixels.astype(np.float64), one.matched_rows, camera)
        for cam_from_rig, one in zip(rig_of(true), single, strict=True)
    ]
    estimates = tuple(
        _estimate(joint.localize(views[k : k + 1]), views[k : k + 1], true[k : k + 1]) for k in range(len(views))
    )
    return LookStory(camera, true, images, estimates, _estimate(joint.localize(views), views, true))


def _estimate(pose: JointLocalization, views: Sequence[Look], true: Float) -> Estimate:
    pixels = tuple(view.pixels[inliers] for view, inliers in zip(views, pose.inliers, strict=True))
    if pose.cams_from_world is None:
        return Estimate(None, pixels, 0.0, np.inf, np.inf)
    error_m, error_deg = pose_error(pose.cams_from_world, true)
    probability = pose.probability()
    return Estimate(pose.cams_from_world, pixels, probability, float(error_m.max()), float(error_deg.max()))


def story_of_steps(
    camera: Camera, cam_from_world: Float, images: Pixels, localizations: Sequence[JointLocalization]
) -> LookStory:
    """Build the story of N views that are added one after another: true poses (N, 3, 4), with the results of the first N."""
    estimates = [_estimate(pose, pose.looks, cam_from_world[: len(pose.looks)]) for pose in localizations]
    names = ["first view", *(f"{n} views" for n in range(2, len(estimates) + 1))]
    steps = [(name, [*range(n + 1)], estimate) for n, (name, estimate) in enumerate(zip(names, estimates, strict=True))]
    return LookStory(camera, cam_from_world, images, (), estimates[-1], tuple(steps))


def story_figure(story: LookStory, house: Dollhouse) -> Figure:
    """Draw a column for each view, and one for all of them jointly: the estimated pose from above, and the inliers."""
    with context(RC):
        columns = len(story.results)
        figure = new_figure(4.2 * columns, 4.6)
        grid = figure.add_gridspec(2, columns, height_ratios=(1.5, 1.0))
        for column, result in enumerate(story.results):
            images = grid[1, column].subgridspec(1, len(result[1]))
            _draw_result(figure, story, house, result, grid[0, column], images)
        return figure


def film_frames(story: LookStory, house: Dollhouse) -> Iterator[tuple[Pixels, int]]:
    """Yield frames (H, W, 3) and their durations in ms: each view with its estimate, then all views jointly."""
    for result in story.results:
        views = result[1]
        with context(RC):
            figure = new_figure(8.4, 4.2)
            grid = figure.add_gridspec(1, 2, width_ratios=(1.5, 1.0))
            _draw_result(figure, story, house, result, grid[0], grid[1].subgridspec(len(views), 1))
            yield pixels_of(figure), FRAME_MS if len(views) == 1 else LAST_MS


def _draw_result(figure: Figure, story: LookStory, house: Dollhouse, result: Result, plan: Any, images: Any) -> None:
    """Draw a result into cells of grids."""
    name, views, estimate = result
    above = figure.add_subplot(plan)
    _draw_plan(above, story.camera, house, story.cam_from_world[views], estimate)
    sure = f", confidence {100 * estimate.probability:.0f} %" if story.steps else ""
    above.set_title(f"{name}: {estimate.summary}{sure}", color=estimate.color, fontsize=10)
    for k, view in enumerate(views):
        _draw_image(figure.add_subplot(images[k]), story.images[view], estimate.pixels[k], estimate.color)


def _draw_plan(axes: Axes, camera: Camera, house: Dollhouse, poses: Float, estimate: Estimate) -> None:
    """Draw the scene from above with the true cameras (N, 3, 4) and the estimated ones."""
    draw_house(axes, house, 0.45)
    width_m = house.rgb.shape[1] / house.camera.fx * float(np.median(house.depth_m[house.depth_m > 0]))
    depth_m = 0.09 * width_m
    labels = [("true pose", BLUE)]
    if estimate.cams_from_world is not None:
        edges = frustum_segments(camera, estimate.cams_from_world, depth_m)
        if estimate.is_good:  # the true camera is drawn inside its lines
            draw_segments(axes, house, edges, colors=estimate.color, linewidths=5.5)
        else:
            draw_segments(axes, house, edges, colors="white", linewidths=3.5)
            draw_segments(axes, house, edges, colors=estimate.color, linewidths=1.8, linestyles=(0, (4, 2)))
        labels.append(("estimated pose", estimate.color))
    edges = frustum_segments(camera, poses, depth_m)
    draw_segments(axes, house, edges, colors="white", linewidths=3.2)
    draw_segments(axes, house, edges, colors=BLUE, linewidths=1.8)
    place: Style = {"transform": axes.transAxes, "ha": "left", "va": "top"}
    for row, (text, color) in enumerate(labels):
        axes.text(0.0, -0.02 - 0.07 * row, text, color=color, fontsize=9, **place)


def _draw_image(axes: Axes, image: Pixels, pixels: Float, color: str) -> None:
    height, width = image.shape[:2]
    axes.imshow(image)
    axes.scatter(pixels[:, 0], pixels[:, 1], s=4, color=color, linewidths=0)
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal", xticks=[], yticks=[])
    axes.grid(False)
    axes.spines[:].set(visible=True, color=color, linewidth=3)
