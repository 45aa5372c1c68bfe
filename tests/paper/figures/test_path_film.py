"""Film and figures of a path."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.geometry.views import Views
from wheretolook.utils.errors import ConfigError
from wheretolook_paper.figures.animation import save_moving
from wheretolook_paper.figures.paths import FRAME_MS, film_frames, still_figure

RNG = np.random.default_rng(1)
LANDMARKS = RNG.uniform((0, 0, 0), (4, 3, 2), (300, 3))
AXIS = np.array([1.0, 0, 0])


def some_views(n: int, scale: float = 1.0) -> Views:
    at = np.column_stack([0.5 * np.arange(n), np.ones(n), np.full(n, 1.4)])
    images = np.broadcast_to(20 * np.arange(n, dtype=np.uint8)[:, None, None, None], (n, 60, 80, 3))
    pixels = tuple(RNG.uniform(0, 60, (7 + number, 2)) for number in range(n))
    score = scale * np.arange(n) / n
    return Views(
        poses_looking_along(at, AXIS),
        PinholeCamera(80, 60, 40.0),
        waypoint=np.arange(n),
        rank=np.ones(n, dtype=np.int64),
        score=score,
        set_score=score,
        pixels=pixels,
        images=images,
    )


def test_films_have_a_frame_per_view(tmp_path):
    frames = list(film_frames(some_views(4), LANDMARKS))
    save_moving(frames, FRAME_MS, tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as film:
        assert film.n_frames == 4 and film.info["duration"] == 120
    save_moving(frames, FRAME_MS, tmp_path / "a.mp4", 2 * FRAME_MS)
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert (video.get(cv2.CAP_PROP_FPS), video.get(cv2.CAP_PROP_FRAME_COUNT)) == (8, 5)
    with pytest.raises(ConfigError):
        save_moving(frames, FRAME_MS, tmp_path / "a.avi")


@pytest.mark.parametrize("scale", [1.0, -3e4])
def test_still_figure_draws_scores_and_landmarks(scale):
    views = some_views(9, scale)
    figure = still_figure(views, LANDMARKS, "room")
    counts = [title.split()[1] for axes in figure.axes if "landmarks" in (title := axes.get_title())]
    assert counts == [str(len(views.pixels[number])) for number in (0, 2, 4, 6, 8)]
    axes = next(axes for axes in figure.axes if axes.get_ylabel() == "score")
    drawn = np.arange(9)[:, None] * (0.5, scale / 9)
    np.testing.assert_allclose(axes.lines[0].get_xydata(), drawn)
    low, high = axes.get_ylim()
    assert (low <= views.score).all() and (views.score <= high).all()


def test_stops_are_marked_with_their_joint_score() -> None:
    views = some_views(6)[np.array([0, 1, 2, 2, 2, 3, 4, 5])]
    at_stop = views.waypoint == 2
    rank = np.where(at_stop, np.cumsum(at_stop), 1)
    figure = still_figure(replace(views, rank=rank, set_score=np.where(at_stop, 0.9, views.score)), LANDMARKS)
    scores = next(axes for axes in figure.axes if axes.get_ylabel() == "score")
    np.testing.assert_allclose(scores.lines[0].get_ydata(), np.arange(6) / 6)  # without further views
    (mark,) = (line for line in scores.lines if line.get_label() == "all views of a stop")
    assert (mark.get_xdata(), mark.get_ydata()) == ([1.0], [0.9])
