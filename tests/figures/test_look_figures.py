"""A robot that looks twice, as a film and as a picture; and how many places several looks localize."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pandas as pd
import pytest
from PIL import Image

from box_scenes import furnished_room
from wheretolook.figures.animation import save_moving
from wheretolook.figures.dollhouse import dollhouse
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import camera_centers, poses_looking_along, rotation_angle_deg
from wheretolook.localization.estimation import PoseEstimator
from wheretolook.utils.errors import ConfigError, PoseError
from wheretolook_paper.figures.look_film import LookStory, film_frames, still_figure, tell_looks, turning_poses
from wheretolook_paper.figures.looks import looks_figure

CAMERA = PinholeCamera(160, 120, 80.0)
POSES = poses_looking_along([[0.5, 0.2, 1.2]] * 2, [[1.0, 0, 0], [0.3, 1.0, 0.1]])
IMAGES = np.stack([np.full((120, 160, 3), value, np.uint8) for value in (60, 160)])
SHIFT = np.array([-1.5, 0.0, 0.0])


def story() -> LookStory:
    """Two looks, of which the first finds a place 1.5 m off alone: what it sees, the map has twice."""
    rng = np.random.default_rng(0)
    first = rng.uniform((1, -1, 0), (3, 1, 2), (120, 3))
    second = rng.uniform((-1, 1.5, 0), (2, 3, 2), (200, 3))
    points = np.concatenate([first[:50], first + SHIFT, second])  # where it is, 50 points; where it is not, all of them
    sees = [np.concatenate([first[:50], first]), second]
    rows = [np.r_[0:50, 50:170], np.r_[170:370]]
    found = []
    for pose, landmarks, which in zip(POSES, sees, rows, strict=True):
        pixels = CAMERA.project(landmarks @ pose[:, :3].T + pose[:, 3])
        kept = CAMERA.in_image(pixels)
        matched = pixels[kept].astype(np.float32)
        found.append(SimpleNamespace(matched_pixels=matched, matched_rows=which[kept]))
    answers = iter(found)
    localizer = SimpleNamespace(estimator=PoseEstimator(points), localize=lambda image: next(answers))
    return tell_looks(localizer, CAMERA, POSES, IMAGES)  # type: ignore[arg-type]


def test_a_story_tells_what_each_look_finds_and_all_together() -> None:
    told = story()
    first, second = told.alone
    assert not first.right and abs(first.error_m - 1.5) < 0.05 and "wrong, 1.5 m off" in first.said
    assert second.right and told.together.right and "right" in told.together.said
    assert told.together.n_inliers > second.n_inliers
    with pytest.raises(PoseError, match="two of them"):
        tell_looks(SimpleNamespace(), CAMERA, POSES[:1], IMAGES[:1])  # type: ignore[arg-type]


def test_a_turn_keeps_the_place_and_goes_the_shortest_way() -> None:
    (turn,) = turning_poses(POSES, 3)
    np.testing.assert_allclose(camera_centers(turn), camera_centers(POSES[[0, 0, 0]]), atol=1e-9)
    whole = rotation_angle_deg(POSES[0, :, :3], POSES[1, :, :3])
    np.testing.assert_allclose(rotation_angle_deg(turn[:, :, :3], POSES[:1, :, :3]), whole * np.arange(1, 4) / 4)


def test_a_film_shows_each_look_each_turn_and_all_together(tmp_path: Path) -> None:
    told = story()
    house = dollhouse(furnished_room(), width_px=200)
    turn = turning_poses(POSES, 2)[0]
    frames = list(film_frames(told, house, [(turn, IMAGES)]))
    assert len(frames) == 2 + 2 + 1 and len({image.shape for image, _ in frames}) == 1
    assert len({image.tobytes() for image, _ in frames}) == 5
    for name in ("a.webp", "a.gif"):
        save_moving([image for image, _ in frames], [time for _, time in frames], tmp_path / name)
        with Image.open(tmp_path / name) as film:
            assert film.n_frames == 5
    save_moving([image for image, _ in frames], [time for _, time in frames], tmp_path / "a.mp4")
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    seconds = video.get(cv2.CAP_PROP_FRAME_COUNT) / video.get(cv2.CAP_PROP_FPS)
    assert seconds == pytest.approx(sum(time for _, time in frames) / 1000, abs=0.01)
    with pytest.raises(ConfigError, match=r"a\.png: a film is a \.webp, a \.gif or an \.mp4"):
        save_moving([], [], tmp_path / "a.png")
    titles = [axes.get_title() for axes in still_figure(told, house).axes if axes.get_title()]
    assert [title.split(":")[0] for title in titles] == ["look 1", "look 2", "together"]


def test_shares_of_places_over_the_number_of_looks() -> None:
    rows = [("together", 1, 0.7, 0.7), ("together", 2, 0.8, 0.85), ("random", 1, 0.3, 0.3), ("random", 2, 0.5, np.nan)]
    table = pd.DataFrame(rows, columns=["strategy", "n_looks", "good", "any_good"]).assign(n_locations=40)
    (axes,) = looks_figure(table).axes
    lines = {line.get_label(): line for line in axes.get_lines()}
    np.testing.assert_allclose(lines["chosen together"].get_ydata(), [70, 80])
    np.testing.assert_allclose(lines["drawn at random"].get_ydata(), [30, 50])
    np.testing.assert_allclose(lines["any of the 2 alone"].get_ydata(), 85)
    two = looks_figure(pd.concat([table.assign(split="val"), table.assign(split="test")])).axes
    assert [panel.get_title() for panel in two] == [
        "validation scenes, 40 places",
        "test scenes, some by others, 40 places",
    ]
