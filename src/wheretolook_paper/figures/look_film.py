"""A robot that looks twice: what one look finds, what another finds, and what both find together, as a film."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context
from numpy.typing import ArrayLike

from wheretolook.dataset.thresholds import THRESHOLDS
from wheretolook.figures.animation import Pixels, pixels_of
from wheretolook.figures.dollhouse import Dollhouse, draw_house, draw_segments, frustum_segments
from wheretolook.figures.style import BLUE, GREEN, INK, RC, VERMILION, Style, new_figure
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float, camera_centers, pose_error
from wheretolook.localization.confidence import ConfidenceModel
from wheretolook.localization.localizer import Localizer
from wheretolook.localization.rig import Look, rig_of
from wheretolook.localization.rig_localization import JointLocalization, JointLocalizer
from wheretolook.utils.errors import PoseError

MAX_ERROR_M, MAX_ERROR_DEG = THRESHOLDS[0]

TURNED = 5
"""Pictures between two looks, while the camera turns."""

LOOK_MS = 2200
TURN_MS = 140
LAST_MS = 4000
"""How long a look, a picture of a turn, and what all find together stand."""


@dataclass(frozen=True, eq=False)
class Found:
    """What one look or several found: where the looks seem to be, which pixels agree, and how sure that is.

    Attributes:
        cams_from_world: (N, 3, 4) as found; None if no pose was.
        pixels: N arrays (I_k, 2) of the matches that agree.
        chance: the probability that the pose is within 5 cm and 0.4 degrees.
        error_m: of the worst look; infinite if there is no pose.
        error_deg: likewise.
    """

    cams_from_world: Float | None
    pixels: tuple[Float, ...]
    chance: float
    error_m: float
    error_deg: float

    @property
    def right(self) -> bool:
        """Whether it is within 5 cm and 0.4 degrees."""
        return self.error_m <= MAX_ERROR_M and self.error_deg <= MAX_ERROR_DEG

    @property
    def n_inliers(self) -> int:
        """Matches that agree."""
        return sum(map(len, self.pixels))

    @property
    def said(self) -> str:
        """In few words."""
        if self.cams_from_world is None:
            return "no pose found"
        where = f"right, {100 * self.error_m:.1f} cm off" if self.right else f"wrong, {off(self)} off"
        return f"{self.n_inliers} inliers, {where}"


@dataclass(frozen=True, eq=False)
class LookStory:
    """N looks of a camera from one place: what it saw, and what it found by each alone and by all together."""

    camera: Camera
    cam_from_world: Float  # (N, 3, 4), true
    images: Pixels  # (N, H, W, 3)
    alone: tuple[Found, ...]
    together: Found


def off(found: Found) -> str:
    """How far off a pose is, by what tells more."""
    if found.error_m > MAX_ERROR_M:
        return f"{found.error_m:.1f} m" if found.error_m >= 1 else f"{100 * found.error_m:.0f} cm"
    return f"{found.error_deg:.1f}°"


def tell_looks(
    localizer: Localizer,
    camera: Camera,
    cam_from_world: ArrayLike,
    images: Pixels,
    confidence: ConfidenceModel | None = None,
) -> LookStory:
    """Localize images (N, H, W, 3) of looks (N, 3, 4) from one place, each alone and all together.

    Raises a PoseError if there are fewer than two, or they are not of one place.
    """
    true = np.asarray(cam_from_world, dtype=np.float64)
    if len(true) < 2:
        raise PoseError("a story of looks needs two of them", value=len(true))
    sure = confidence or ConfidenceModel.bundled()
    joint = JointLocalizer(localizer.estimator)
    found = [localizer.localize(image) for image in images]
    looks = [
        Look(mount, one.matched_pixels.astype(np.float64), one.matched_rows, camera)
        for mount, one in zip(rig_of(true), found, strict=True)
    ]
    alone = tuple(
        _found(joint.localize(looks[k : k + 1]), looks[k : k + 1], true[k : k + 1], sure) for k in range(len(looks))
    )
    return LookStory(camera, true, images, alone, _found(joint.localize_together(looks), looks, true, sure))


def _found(pose: JointLocalization, looks: Sequence[Look], true: Float, confidence: ConfidenceModel) -> Found:
    pixels = tuple(look.pixels[kept] for look, kept in zip(looks, pose.inliers, strict=True))
    if pose.cams_from_world is None:
        return Found(None, pixels, 0.0, np.inf, np.inf)
    error_m, error_deg = pose_error(pose.cams_from_world, true)
    chance = float(confidence.of(pose))
    return Found(pose.cams_from_world, pixels, chance, float(error_m.max()), float(error_deg.max()))


def film_frames(
    story: LookStory, house: Dollhouse, turns: Sequence[tuple[Float, Pixels]] = ()
) -> Iterator[tuple[Pixels, int]]:
    """Frames (H, W, 3) and how long each stands (ms): every look, the turn to the next, and all together.

    `turns` are what the camera sees while it turns from each look to the next: N - 1 pairs of `turning_poses`
    (T, 3, 4) and their images (T, H, W, 3).
    """
    with context(RC):
        for number in range(len(story.alone)):
            yield pixels_of(_look_frame(story, house, number)), LOOK_MS
            if number < len(turns):
                for pose, image in zip(*turns[number], strict=True):
                    yield pixels_of(_turn_frame(story, house, number, pose, image)), TURN_MS
        yield pixels_of(_look_frame(story, house, None)), LAST_MS


def turning_poses(cam_from_world: Float, steps: int = TURNED) -> list[Float]:
    """Poses (steps, 3, 4) between each look (N, 3, 4) and the next, evenly spread over the shortest turn."""
    from scipy.spatial.transform import Rotation, Slerp

    between = []
    centers = camera_centers(cam_from_world)
    for one, other, center in zip(cam_from_world[:-1], cam_from_world[1:], centers[:-1], strict=True):
        path = Slerp([0, 1], Rotation.from_matrix(np.stack([one[:, :3], other[:, :3]])))
        turned = path(np.linspace(0, 1, steps + 2)[1:-1]).as_matrix()
        between.append(np.concatenate([turned, -(turned @ center)[..., None]], axis=2))
    return between


def still_figure(story: LookStory, house: Dollhouse) -> Figure:
    """The whole story in one picture: a column for each look, and one for all of them together."""
    with context(RC):
        n = len(story.alone)
        figure = new_figure(4.2 * (n + 1), 4.6)
        grid = figure.add_gridspec(2, n + 1, height_ratios=(1.5, 1.0))
        for column, found in enumerate((*story.alone, story.together)):
            above = figure.add_subplot(grid[0, column])
            shown = slice(column, column + 1) if column < n else slice(None)
            _draw_plan(above, story.camera, house, story.cam_from_world[shown], found)
            name = f"look {column + 1}" if column < n else "together"
            above.set_title(f"{name}: {found.said}", color=_color(found), fontsize=10)
            below = grid[1, column].subgridspec(1, 1 if column < n else n)
            for k, number in enumerate(range(n)[shown]):
                _draw_image(figure.add_subplot(below[k]), story.images[number], found.pixels[k], _color(found))
        return figure


def _look_frame(story: LookStory, house: Dollhouse, number: int | None) -> Figure:
    """What one look found, under those before it; or, for None, what all found together."""
    found = story.together if number is None else story.alone[number]
    name = "together" if number is None else f"look {number + 1}"
    poses = story.cam_from_world if number is None else story.cam_from_world[number : number + 1]
    figure, above, rows = _empty_frame(story)
    _draw_plan(above, story.camera, house, poses, found)
    above.set_title(f"{name}: {found.said}", color=_color(found), fontweight="bold", loc="left")
    for k, axes in enumerate(rows[: len(rows) if number is None else number + 1]):
        own, pixels = (found, found.pixels[k]) if number is None else (story.alone[k], story.alone[k].pixels[0])
        _draw_image(axes, story.images[k], pixels, _color(own))
    return figure


def _turn_frame(story: LookStory, house: Dollhouse, number: int, pose: Float, image: Pixels) -> Figure:
    """The camera on its way from a look to the next."""
    figure, above, rows = _empty_frame(story)
    _draw_plan(above, story.camera, house, pose[None], None)
    above.set_title("the camera turns", color=INK, fontweight="bold", loc="left")
    for axes, seen, found in zip(rows, story.images, story.alone[: number + 1], strict=False):
        _draw_image(axes, seen, found.pixels[0], _color(found))
    _draw_image(rows[number + 1], image, np.zeros((0, 2)), INK)
    return figure


def _empty_frame(story: LookStory) -> tuple[Figure, Axes, list[Axes]]:
    """A figure with a place for the scene from above, and one for each look."""
    n = len(story.alone)
    figure = new_figure(8.4, 4.2)
    grid = figure.add_gridspec(n, 2, width_ratios=(1.5, 1.0))
    rows = [figure.add_subplot(grid[k, 1]) for k in range(n)]
    height, width = story.images.shape[1:3]
    for k, axes in enumerate(rows):
        axes.set(xticks=[], yticks=[], xlim=(0, width), ylim=(height, 0), aspect="equal")
        axes.set_ylabel(f"look {k + 1}", fontsize=9)
        axes.spines[:].set_visible(False)
    return figure, figure.add_subplot(grid[:, 0]), rows


def _color(found: Found) -> str:
    return GREEN if found.right else VERMILION


def _draw_plan(axes: Axes, camera: Camera, house: Dollhouse, poses: Float, found: Found | None) -> None:
    """The scene from above: where the camera is (N, 3, 4), and where it believes to be."""
    draw_house(axes, house, 0.45)
    reach = 0.09 * _width_m(house)
    told = [("where it is", BLUE), ("", INK)]
    if found is not None and found.cams_from_world is not None:
        edges = frustum_segments(camera, found.cams_from_world, reach)
        if found.right:  # where it is lies within its lines
            draw_segments(axes, house, edges, colors=_color(found), linewidths=5.5)
        else:
            draw_segments(axes, house, edges, colors="white", linewidths=3.5)
            draw_segments(axes, house, edges, colors=_color(found), linewidths=1.8, linestyles=(0, (4, 2)))
        told[1] = ("where it believes to be", _color(found))
    edges = frustum_segments(camera, poses, reach)
    draw_segments(axes, house, edges, colors="white", linewidths=3.2)
    draw_segments(axes, house, edges, colors=BLUE, linewidths=1.8)
    place: Style = {"transform": axes.transAxes, "ha": "left", "va": "top"}
    for row, (text, color) in enumerate(told):
        axes.text(0.0, -0.02 - 0.07 * row, text or " ", color=color, fontsize=9, **place)


def _width_m(house: Dollhouse) -> float:
    """About how many metres the picture is wide."""
    return house.rgb.shape[1] / house.camera.fx * float(np.median(house.depth_m[house.depth_m > 0]))


def _draw_image(axes: Axes, image: Pixels, pixels: Float, color: str) -> None:
    height, width = image.shape[:2]
    axes.imshow(image)
    axes.scatter(pixels[:, 0], pixels[:, 1], s=4, color=color, linewidths=0)
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal", xticks=[], yticks=[])
    axes.grid(False)
    axes.spines[:].set(visible=True, color=color, linewidth=3)
