"""A path as a film and as one picture."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from wheretolook.figures.animation import save_moving
from wheretolook.figures.path_film import FRAME_MS, film_frames, methods_figure, still_figure
from wheretolook.planning.routes import PathView
from wheretolook.utils.errors import ConfigError


def some_views(n: int, images: bool = True) -> list[PathView]:
    rng = np.random.default_rng(0)
    return [
        PathView(
            np.array([0.5 * number, 1.0, 1.4]),
            np.array([1.0, 0, 0]),
            number / n,
            rng.uniform(0, 60, (7 + number, 2)),
            (80, 60),
            np.full((60, 80, 3), 20 * number, np.uint8) if images else None,
        )
        for number in range(n)
    ]


LANDMARKS = np.random.default_rng(1).uniform((0, 0, 0), (4, 3, 2), (300, 3))


@pytest.mark.parametrize("images", [True, False])
def test_frames_show_each_view(images: bool) -> None:
    frames = list(film_frames(some_views(4, images), LANDMARKS))
    assert len(frames) == 4 and len({frame.shape for frame in frames}) == 1
    assert all(not np.array_equal(a, b) for a, b in itertools.pairwise(frames))


def test_films_can_be_played(tmp_path: Path) -> None:
    views = some_views(5)
    save_moving(film_frames(views, LANDMARKS), FRAME_MS, tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as film:
        assert film.n_frames == 5 and film.info["duration"] == 120
    save_moving(film_frames(views, LANDMARKS), FRAME_MS, tmp_path / "a.mp4")
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert video.get(cv2.CAP_PROP_FPS) == 8
    count = 0
    while video.read()[0]:
        count += 1
    assert count == 5
    with pytest.raises(ConfigError, match=r"a\.avi"):
        save_moving(iter(()), FRAME_MS, tmp_path / "a.avi")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.gif", "a.mp4"]


def test_the_picture_tells_scores_and_landmarks() -> None:
    views = some_views(9)
    figure = still_figure(views, LANDMARKS, "room")
    titles = [axes.get_title() for axes in figure.axes]
    assert titles[0] == "room"
    assert [title for title in titles if "landmarks" in title] == [
        f"{column}: {len(views[at].pixels)} landmarks, score {at / 9:.2f}"
        for column, at in enumerate((0, 2, 4, 6, 8), 1)
    ]
    line = next(axes for axes in figure.axes if axes.get_ylabel() == "score").lines[0]
    np.testing.assert_allclose(line.get_xdata(), 0.5 * np.arange(9))
    np.testing.assert_allclose(line.get_ydata(), np.arange(9) / 9)


def test_scores_of_any_size_fit_into_the_picture() -> None:
    """Only some methods' scores are probabilities."""
    for size in (-3e4, 3e4):
        views = [replace(view, score=size * view.score) for view in some_views(9)]
        axes = next(axes for axes in still_figure(views, LANDMARKS).axes if axes.get_ylabel() == "score")
        low, high = axes.get_ylim()
        assert all(low <= view.score <= high for view in views)


def test_methods_stand_side_by_side() -> None:
    views = some_views(6)
    figure = methods_figure({"forward": views[:3], "set": views}, LANDMARKS)
    assert [axes.get_title().split("\n")[0] for axes in figure.axes] == ["forward", "set of landmarks"]
    for axes, shown in zip(figure.axes, (views[:3], views), strict=True):
        np.testing.assert_allclose(axes.lines[0].get_xydata(), [view.position[:2] for view in shown])
        assert f"{np.mean([len(view.pixels) for view in shown]):,.0f} landmarks" in axes.get_title()


def test_stops_are_seen_in_film_and_picture() -> None:
    views = some_views(6)
    stop = replace(views[2], n_looks=3, together=0.9)
    further = [replace(stop, look=look, axis=np.array([0.0, 1.0, 0.0])) for look in (2, 3)]
    stopping = [*views[:2], stop, *further, *views[3:]]
    assert len(list(film_frames([stop, *further], LANDMARKS))) == 3
    figure = still_figure(stopping, LANDMARKS)
    titles = [axes.get_title() for axes in figure.axes if "landmarks" in axes.get_title()]
    assert len(titles) == 5 and sum("look 1 of 3" in title for title in titles) == 1
    scores = next(axes for axes in figure.axes if axes.get_ylabel() == "score")
    np.testing.assert_allclose(scores.lines[0].get_ydata(), np.arange(6) / 6)  # not those of further looks
    (mark,) = (line for line in scores.lines if line.get_label() == "all looks of a stop")
    assert (mark.get_xdata(), mark.get_ydata()) == ([1.0], [0.9])
    assert scores.get_ylim()[1] > 0.9
    above = next(axes for axes in figure.axes if axes.get_ylabel() == "y (m)")
    assert any(line.get_marker() == "o" and list(line.get_xdata()) == [1.0] for line in above.lines)
    plain = next(axes for axes in still_figure(views, LANDMARKS).axes if axes.get_ylabel() == "score")
    assert plain.get_legend() is None
