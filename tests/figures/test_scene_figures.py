"""The figures of one scene hold what they are given: points where they lie, counts, scores, outcomes."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection, PathCollection
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from box_scenes import ROOM, furnished_room
from wheretolook.dataset.viewpoint_table import pose_columns
from wheretolook.figures.dollhouse import dollhouse, frustum_corners, frustum_segments
from wheretolook.figures.overview import Overview, View, overview_figure
from wheretolook.figures.style import TWO_COLUMNS_IN, save_figure
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.camera_turns import pan_tilt_angles
from wheretolook.geometry.lattices import VoxelGrid, fibonacci_sphere
from wheretolook.geometry.poses import poses_looking_along, transform
from wheretolook.stages.demo import _ends
from wheretolook_paper.figures.inputs import BinnedImage, inputs_figure
from wheretolook_paper.figures.network_walkthrough import learning_figure
from wheretolook_paper.figures.peaks import peaks_figure, spread_extrema
from wheretolook_paper.figures.pipeline import Pipeline, pipeline_figure, ranked_figure
from wheretolook_paper.figures.sampling import Sampling, sampling_figure

CAMERA = PinholeCamera(64, 48, 32.0)
HOUSE = dollhouse(furnished_room(), width_px=240)


@pytest.fixture
def pipeline() -> Pipeline:
    rng = np.random.default_rng(0)
    landmarks = rng.uniform((0, 4.9, 0), ROOM, (200, 3))  # on the far wall, and so in sight
    locations = np.stack(np.meshgrid([1.0, 2.0, 3.0], [2.0, 3.0], [1.4], indexing="ij"), -1).reshape(-1, 3)
    axes = fibonacci_sphere(len(locations))
    scores = np.array([0.1, 0.9, 0.5, 0.3, 0.8, 0.2])
    poses = poses_looking_along(locations[:4], axes[:4])
    seen = np.arange(200) < 40
    return Pipeline(HOUSE, landmarks, poses, CAMERA, locations, 17, 500, axes, scores, poses[1], 0.93, seen,
                    np.full((48, 64, 3), 90, np.uint8), "pose found, 0.5 cm and 0.10° off")  # fmt: skip


def test_frusta_hold_what_their_cameras_see() -> None:
    poses = poses_looking_along([[1.0, 2.0, 3.0]] * 2, [[1.0, 0, 0], [0.3, -1, 0.2]])
    corners = frustum_corners(CAMERA, poses, 0.5)
    np.testing.assert_allclose(corners[:, 0], [[1, 2, 3]] * 2)
    for pose, four in zip(poses, corners[:, 1:], strict=True):
        in_camera = transform(pose, four)
        np.testing.assert_allclose(in_camera[:, 2], 0.5)
        np.testing.assert_allclose(CAMERA.project(in_camera), [[0, 0], [64, 0], [64, 48], [0, 48]], atol=1e-9)
    assert frustum_segments(CAMERA, poses, 0.5).shape == (2, 8, 2, 3)


def test_pipeline_figure_draws_map_samples_ranks_and_choice(pipeline: Pipeline, tmp_path: Path) -> None:
    figure = pipeline_figure(pipeline)
    a, b, c, d = figure.axes[:4]
    titles = [axes.get_title(loc="left") for axes in (a, b, c, d)]
    assert titles == [
        "a  Map: 200 landmarks, 4 cameras", "b  Sampled: 6 of 17 locations × 500 directions",
        "c  Ranked: the best view of each location", "d  Chosen: 40 landmarks in view, score 0.93",
    ]  # fmt: skip
    (drawn,) = _dots(a)
    shown = pipeline.landmarks[HOUSE.shows(pipeline.landmarks)]
    assert len(shown) > 100 and len(drawn) == len(shown)
    np.testing.assert_allclose(drawn, HOUSE.pixels(shown))
    assert len(_lines(a)[0].get_segments()) == 4 * 8
    np.testing.assert_allclose(_dots(b)[0], HOUSE.pixels(pipeline.locations))
    # bad ones first, so that good ones lie on top
    order = np.argsort(pipeline.best_scores)
    np.testing.assert_allclose(_dots(c)[0], HOUSE.pixels(pipeline.locations[order]))
    coloured = next(lines for lines in _lines(c) if lines.get_array() is not None)
    np.testing.assert_allclose(coloured.get_array(), pipeline.best_scores[order])
    starts, ends = np.moveaxis(np.array(coloured.get_segments()), 1, 0)
    tips = pipeline.locations[order] + 0.8 * 1.0 * pipeline.best_axes[order]  # neighbours are 1 m apart
    np.testing.assert_allclose(starts, HOUSE.pixels(pipeline.locations[order]))
    np.testing.assert_allclose(ends, HOUSE.pixels(tips))
    seen = pipeline.landmarks[pipeline.seen]
    np.testing.assert_allclose(_dots(d)[0], HOUSE.pixels(seen[HOUSE.shows(seen)]))
    assert pipeline.outcome in [text.get_text() for text in d.texts]
    _assert_draws(figure, tmp_path)


def test_pipeline_figure_comes_out_the_same_and_without_an_outcome(pipeline: Pipeline, tmp_path: Path) -> None:
    for name in ("one", "two"):
        save_figure(pipeline_figure(pipeline), tmp_path / f"{name}.png")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    none = replace(pipeline, outcome="", mapping_poses=np.zeros((0, 3, 4)))
    assert "0 cameras" in pipeline_figure(none).axes[0].get_title(loc="left")


def test_ranked_figure_of_one_location(pipeline: Pipeline, tmp_path: Path) -> None:
    figure = ranked_figure(HOUSE, pipeline.locations[:1], pipeline.best_axes[:1], pipeline.best_scores[:1])
    assert len(_dots(figure.axes[0])[0]) == 1
    _assert_draws(figure, tmp_path)


def test_sampling_figure_draws_voxels_directions_and_occlusion(tmp_path: Path) -> None:
    plan = dollhouse(furnished_room(), elevation_deg=90, width_px=200)
    grid = VoxelGrid((0, 0, 0), ROOM, (4, 3, 2))
    layer = np.arange(len(grid))[::2]
    free = np.arange(len(layer)) % 3 > 0
    directions = fibonacci_sphere(50)
    landmarks = np.random.default_rng(0).uniform((0, 0, 0), ROOM, (60, 3))
    kept = np.arange(50) < 12
    unoccluded = np.arange(60) < 25
    n_visible = 10 * np.arange(50)[::-1]
    sampling = Sampling(plan, grid, layer, free, grid.centers()[layer[1]], directions, n_visible, kept, landmarks,
                        unoccluded)  # fmt: skip
    figure = sampling_figure(sampling)
    voxels, sphere, sight = figure.axes[:3]
    patches = [one for one in voxels.collections if isinstance(one, PatchCollection)]
    assert [len(one.get_paths()) for one in patches] == [free.sum(), (~free).sum()]
    square = patches[0].get_paths()[0].get_extents()
    center = plan.pixels(grid.centers()[layer[free][0]])
    np.testing.assert_allclose([(square.x0 + square.x1) / 2, (square.y0 + square.y1) / 2], center, atol=0.5)
    assert _legend(voxels) == ["8 free", "4 not"]
    assert sphere.get_title(loc="left") == "b  Directions: 12 of 50 kept"
    assert [len(dots) for dots in _dots(sphere)] == [38, 12]
    coloured = next(one for one in sphere.collections if one.get_array() is not None)
    np.testing.assert_array_equal(coloured.get_array(), n_visible[kept])
    assert _legend(sight) == ["25 in sight", "35 hidden"]
    hidden, seen, place = _dots(sight)
    np.testing.assert_allclose(hidden, plan.pixels(landmarks[~unoccluded]))
    np.testing.assert_allclose(seen, plan.pixels(landmarks[unoccluded]))
    for start, end in _lines(sight)[0].get_segments():
        np.testing.assert_allclose(start, place[0])
        assert np.abs(seen - end).max(1).min() < 1e-9
    _assert_draws(figure, tmp_path)


@pytest.fixture
def image() -> BinnedImage:
    pixels = np.array([[5.0, 5.0], [6.0, 6.0], [60.0, 40.0]])
    counts = np.zeros((6, 6), np.int32)
    counts[0, 0] = 2
    counts[5, 5] = 1
    means = {}
    for number, name in enumerate("uvxyz"):
        means[name] = np.full((6, 6), np.nan)
        means[name][0, 0] = -1.25 - number
        means[name][5, 5] = 2.0 + number
    return BinnedImage(np.full((48, 64, 3), 120, np.uint8), pixels, means, counts)


def test_inputs_figure_has_the_channels_of_each_variant(image: BinnedImage, tmp_path: Path) -> None:
    figure = inputs_figure(image)
    picture, bins, *channels = figure.axes
    assert picture.get_title() == "image, 3 landmarks in view" and bins.get_title() == "2 of 36 bins filled"
    np.testing.assert_allclose(_dots(picture)[0], image.pixels)
    np.testing.assert_allclose(bins.images[-1].get_array(), np.ma.log(np.ma.masked_equal(image.counts, 0)))
    rows = np.array(channels).reshape(3, 5)
    names = ("u", "v", "z", "x", "y")
    for row, n_channels in zip(rows, (2, 3, 5), strict=True):
        assert [len(axes.images) for axes in row] == [1] * n_channels + [0] * (5 - n_channels)
        for axes, name in zip(row[:n_channels], names, strict=False):
            drawn = axes.images[0].get_array()
            np.testing.assert_allclose(drawn.compressed(), [image.means[name][0, 0], image.means[name][5, 5]])
            assert (~drawn.mask == (image.counts > 0)).all()
    assert [row[0].get_ylabel().split("\n")[1] for row in rows] == ["72 values", "108 values", "180 values"]
    assert rows[2, 3].get_xlabel() == "−3.2 to 4.0"  # x in metres
    _assert_draws(figure, tmp_path)


def test_inputs_figure_of_a_view_of_nothing(image: BinnedImage, tmp_path: Path) -> None:
    empty = {name: np.full((6, 6), np.nan) for name in image.means}
    nothing = BinnedImage(image.rgb, np.zeros((0, 2)), empty, np.zeros((6, 6), np.int32))
    figure = inputs_figure(nothing, {"2d": ("u", "v")})
    assert figure.axes[2].get_xlabel() == "no landmark"
    _assert_draws(figure, tmp_path)


@pytest.mark.parametrize("channels", ["uv", "uvz"])
def test_learning_figure_draws_what_passes_through(image: BinnedImage, channels: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    means = rng.normal(size=(len(channels), 6, 6))
    hidden = [np.maximum(rng.normal(size=n), 0) for n in (30, 24)]
    figure = learning_figure(image, [means, *hidden, np.array([0.87])], channels, "0.4 cm, 0.10° off")
    picture, _, *inputs, first, second, score = figure.axes
    assert picture.get_xlabel() == "3 landmarks"
    for axes, values in zip(inputs, means, strict=True):
        np.testing.assert_allclose(axes.images[0].get_array(), values)
    for axes, values in zip((first, second), hidden, strict=True):
        np.testing.assert_allclose(axes.images[0].get_array().compressed(), values)
        assert axes.get_xlabel() == f"{(values > 0).mean():.0%} active"
    (bar,) = score.patches
    assert bar.get_height() == 0.87 and [text.get_text() for text in score.texts] == ["0.87"]
    assert score.get_xlabel().replace("\n", " ") == "0.4 cm, 0.10° off"
    assert len(figure.artists) == 5  # arrows between six panels, the channels counted as one
    _assert_draws(figure, tmp_path)


def test_extrema_are_spread() -> None:
    directions = fibonacci_sphere(300)
    scores = directions @ (0, 0, 1.0)
    peaks = spread_extrema(directions, scores, 4, 40.0)
    pits = spread_extrema(directions, scores, 4, 40.0, False)
    assert peaks[0] == 0 and pits[0] == 299
    for found in (peaks, pits):
        cosines = directions[found] @ directions[found].T
        assert cosines[~np.eye(len(found), dtype=bool)].max() <= np.cos(np.radians(40)) + 1e-12
    assert np.all(np.diff(scores[peaks]) <= 0) and np.all(np.diff(scores[pits]) >= 0)
    assert len(spread_extrema(directions, scores, 4, 179.0)) <= 2
    assert spread_extrema(directions, np.zeros(300), 1).tolist() == [0]  # of equals the first


def test_peaks_figure_marks_views_where_they_look(tmp_path: Path) -> None:
    directions = fibonacci_sphere(80)
    scores = np.linspace(0, 1, 80)
    rgb = np.full((48, 64, 3), 120, np.uint8)
    peaks = [View(rgb, directions[row], float(scores[row]), "0.2 cm, 0.05° off") for row in (79, 60)]
    pits = [View(rgb, directions[row], float(scores[row]), "too few matches") for row in (0, 20, 30)]
    good = np.arange(30) < 20
    figure = peaks_figure(directions, scores, peaks, pits, (directions[:30], good))
    sphere, *views = [axes for axes in figure.axes if axes.get_label() != "<colorbar>"]
    np.testing.assert_allclose(sphere.collections[0].get_array(), scores)
    assert [len(dots) for dots in _dots(sphere)] == [80, 20, 10]
    marks = {text.get_text(): text.get_position() for text in sphere.texts}
    assert list(marks) == ["1", "2", "A", "B", "C"]
    for mark, view in zip(marks, [*peaks, *pits], strict=True):
        azimuth, elevation = marks[mark]
        looks = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        np.testing.assert_allclose(looks, view.direction, atol=1e-9)
    titles = [axes.get_title(loc="left") for axes in views]
    assert titles == [f"{mark}  predicted {view.score:.2f}" for mark, view in zip(marks, [*peaks, *pits], strict=True)]
    assert [axes.get_xlabel() for axes in views] == ["0.2 cm, 0.05° off"] * 2 + ["too few matches"] * 3
    _assert_draws(figure, tmp_path)
    assert len(peaks_figure(directions, scores, peaks[:1], pits[:1]).axes) == 4  # nothing is known of what came of them


def test_overview_draws_places_scores_and_both_views(tmp_path: Path) -> None:
    plan = dollhouse(furnished_room(), elevation_deg=90, cut_m=1.5, one_sided=False, width_px=240)
    locations = np.array([[1.0, 2.0, 1.4], [2.0, 3.0, 1.4], [3.0, 1.0, 1.4]])
    directions = fibonacci_sphere(80)
    scores = np.linspace(0, 1, 80)
    shares = np.array([0.2, 0.9, 0.5])
    rgb = np.full((48, 64, 3), 90, np.uint8)
    best, worst = (View(rgb, directions[row], float(scores[row]), f"outcome {row}") for row in (79, 30))
    what = Overview(
        "a room", "set of landmarks", plan, locations, shares, locations[1], directions, scores, best, worst
    )
    figure = overview_figure(what)
    above = figure.axes[0]
    sphere = next(axes for axes in figure.axes if axes.name == "hammer")
    (dots,) = [one for one in above.collections if isinstance(one, PathCollection)]
    order = np.argsort(shares)
    np.testing.assert_allclose(dots.get_offsets(), plan.pixels(locations)[order])  # good ones lie on top
    np.testing.assert_allclose(dots.get_array(), shares[order])
    ring = next(line for line in above.lines if line.get_marker() == "o")
    np.testing.assert_allclose(np.ravel(ring.get_xydata()), plan.pixels(locations[1]))
    metre = next(line for line in above.lines if line.get_marker() == "None")
    apart = plan.pixels(np.array([[1.0, 1, 1.4], [2.0, 1, 1.4]]))
    assert np.ptp(metre.get_xdata()) == pytest.approx(np.ptp(apart[:, 0]))
    assert "set of landmarks" in sphere.get_title(loc="left") and "a room" in above.get_title(loc="left")
    np.testing.assert_allclose(_dots(sphere)[0], np.transpose(pan_tilt_angles(directions)))
    for text, view in zip(sphere.texts, (best, worst), strict=True):
        np.testing.assert_allclose(text.get_position(), np.ravel(pan_tilt_angles(view.direction)))
    labels = [axes.get_xlabel() for axes in figure.axes]
    assert "outcome 79" in labels and "outcome 30" in labels
    save_figure(figure, tmp_path / "figure.png")


def test_the_worst_view_shown_is_a_level_one() -> None:
    """Not the bare ceiling, which is nearly always the worst."""
    axes = np.array([[0, 0.1, 1.0], [1, 0, 0.2], [0, 1, -0.3], [1, 1, 0.0]])
    looked = poses_looking_along(np.zeros((4, 3)), axes / np.linalg.norm(axes, axis=1, keepdims=True))
    table = pd.DataFrame(pose_columns(looked))
    scores = np.array([0.0, 0.6, 0.2, 0.9])
    rows, ends = _ends(table, scores)
    assert [*rows.index] == [3, 2] and [*ends] == [0.9, 0.2]
    rows, ends = _ends(table.iloc[:1], scores[:1])  # where all look up, one of these
    assert [*rows.index] == [0, 0]


def _dots(axes: Axes) -> list[np.ndarray]:
    return [np.asarray(one.get_offsets()) for one in axes.collections if isinstance(one, PathCollection)]


def _lines(axes: Axes) -> list[LineCollection]:
    return [one for one in axes.collections if isinstance(one, LineCollection)]


def _legend(axes: Axes) -> list[str]:
    legend = axes.get_legend()
    assert legend is not None
    return [text.get_text() for text in legend.get_texts()]


def _assert_draws(figure: Figure, folder: Path) -> None:
    """It is as wide as it should be, no title or label lies on another one, and none is cut off."""
    save_figure(figure, folder / "figure.png")
    assert figure.get_figwidth() <= TWO_COLUMNS_IN
    figure.draw_without_rendering()
    boxes: dict[str, Bbox] = {}
    for number, axes in enumerate(figure.axes):
        texts = [axes.title, axes._left_title, axes.xaxis.label, *axes.texts]  # type: ignore[attr-defined]
        boxes |= {f"{number} {text.get_text()}": text.get_window_extent() for text in texts if text.get_text()}
    for one, other in combinations(boxes, 2):
        assert not _overlap(boxes[one], boxes[other]), (one, other)
    for name, box in boxes.items():
        assert box.x0 > -0.05 * figure.bbox.width and box.x1 < 1.05 * figure.bbox.width, name


def _overlap(one: Bbox, other: Bbox) -> bool:
    return min(one.x1, other.x1) - max(one.x0, other.x0) > 1 and min(one.y1, other.y1) - max(one.y0, other.y0) > 1
