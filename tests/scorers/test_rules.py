"""Methods by a rule of thumb: the heading, and the benchmark's most visible landmarks."""

from __future__ import annotations

import numpy as np
import pytest

from synthetic_dataset import make_landmarks
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import axes_of_angles, fibonacci_sphere, yaw_pitch_angles
from wheretolook.geometry.poses import Float, poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.scorers.forward import ForwardScorer
from wheretolook.scorers.registry import make_scorer
from wheretolook_paper.scorers.max_visibility import VIEWS_AT_ONCE, MaxVisibilityScorer, SwappedMaxVisibilityScorer

CAMERA = PinholeCamera(320, 320, 277.0)


@pytest.fixture
def localization_map() -> LocalizationMap:
    return LocalizationMap(make_landmarks(np.random.default_rng(0), 400), CAMERA)


def count_of_the_benchmark(pose: Float, points: Float) -> int:
    """Points at a depth of 0 to 3 m that are projected into the image, whatever stands before them."""
    count = 0
    for x, y, z in points @ pose[:, :3].T + pose[:, 3]:
        if 0 < z < 3:
            u = 277 * x / z + 160
            v = 277 * y / z + 160
            count += 0 <= u < 320 and 0 <= v < 320
    return count


def test_max_visibility_counts_as_the_benchmark(localization_map: LocalizationMap, device: str) -> None:
    rng = np.random.default_rng(1)
    points = localization_map.landmarks.points
    poses = poses_looking_along(rng.uniform((-2, -2, 0.5), (2, 2, 2), (60, 3)), rng.normal(size=(60, 3)))
    expected = [count_of_the_benchmark(pose, points) for pose in poses]
    scorer = MaxVisibilityScorer(LocalizationMap(localization_map.landmarks, CAMERA, device=device))
    np.testing.assert_allclose(scorer.score(poses) * len(points), expected, atol=1e-9)
    assert max(expected) > 50 and min(expected) == 0
    behind_3_m = [np.sum((points @ pose[2, :3] + pose[2, 3]) >= 3) for pose in poses]
    assert sum(behind_3_m) > 100


def test_more_views_than_are_counted_at_once(localization_map: LocalizationMap) -> None:
    n = VIEWS_AT_ONCE + 50
    poses = poses_looking_along(np.tile([0.5, 0.5, 1.0], (n, 1)), fibonacci_sphere(n))
    scorer = MaxVisibilityScorer(localization_map)
    np.testing.assert_array_equal(
        scorer.score(poses), np.concatenate([scorer.score(poses[:7]), scorer.score(poses[7:])])
    )


def test_the_swapped_one_looks_at_yaw_for_pitch_and_pitch_for_yaw(localization_map: LocalizationMap) -> None:
    angles = yaw_pitch_angles()
    points = localization_map.landmarks.points
    scorer = SwappedMaxVisibilityScorer(localization_map)
    for location in ((0.3, 1.4, 1.0), (1.5, 1.0, 1.5)):
        poses = poses_looking_along(np.tile(location, (len(angles), 1)), axes_of_angles(angles))
        yaw, pitch = angles[np.argmax([count_of_the_benchmark(pose, points) for pose in poses])]
        assert yaw != pitch
        returned = np.array([np.cos(np.radians(yaw)) * np.cos(np.radians(pitch)),
                             np.cos(np.radians(yaw)) * np.sin(np.radians(pitch)), np.sin(np.radians(yaw))])  # fmt: skip
        directions = np.concatenate([fibonacci_sphere(300), returned[None], -returned[None]])
        scores = scorer.score(poses_looking_along(np.tile(location, (302, 1)), directions))
        np.testing.assert_allclose(scores, (1 + directions @ returned) / 2, atol=1e-9)
        assert np.argmax(scores) == 300 and scores[301] == pytest.approx(0, abs=1e-9)


def test_forward_prefers_the_heading(localization_map: LocalizationMap) -> None:
    directions = fibonacci_sphere(200)
    poses = poses_looking_along(np.zeros((200, 3)), directions)
    for heading in ((1.0, 0, 0), (0, -20.0, 0), (1, 1, 1e-3)):
        scores = ForwardScorer(localization_map, heading).score(poses)
        unit = np.array(heading) / np.linalg.norm(heading)
        np.testing.assert_array_equal(np.argsort(-scores), np.argsort(-directions @ unit))
        assert 0 <= scores.min() < 0.01 and 0.99 < scores.max() <= 1
    straight = poses_looking_along(np.zeros((3, 3)), [[1.0, 0, 0], [0, 1, 0], [-1, 0, 0]])
    np.testing.assert_allclose(ForwardScorer(localization_map, (1, 0, 0)).score(straight), [1, 0.5, 0])


def test_forward_follows_a_path(localization_map: LocalizationMap) -> None:
    path = [[0.0, 0, 1], [4, 0, 1], [4, 3, 1], [4, 3, 2]]
    scorer = ForwardScorer(localization_map, path)
    at = [[-5.0, 0, 1], [1, 0.5, 1], [3.5, 2, 1], [5, 2.9, 3]]
    np.testing.assert_allclose(scorer.headings(at), [[1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    np.testing.assert_allclose(scorer.score(poses_looking_along(at, np.tile([0.0, 1, 0], (4, 1)))), [0.5, 0.5, 1, 0.5])
    by_name = make_scorer("forward", localization_map, heading=tuple(map(tuple, path)))  # type: ignore[arg-type]
    np.testing.assert_allclose(by_name.headings(at), scorer.headings(at))  # type: ignore[attr-defined]


def test_without_a_heading_one_is_drawn_for_each_location(localization_map: LocalizationMap) -> None:
    at = np.random.default_rng(0).uniform(-5, 5, (4000, 3))
    headings = ForwardScorer(localization_map, seed=1).headings(at)
    np.testing.assert_allclose(np.linalg.norm(headings, axis=1), 1)
    assert not headings[:, 2].any() and np.abs(headings.mean(0)).max() < 0.05  # in every direction alike
    np.testing.assert_array_equal(ForwardScorer(localization_map, seed=1).headings(at[7:9]), headings[7:9])
    assert np.abs(ForwardScorer(localization_map, seed=2).headings(at) - headings).max(1).mean() > 0.5


@pytest.mark.parametrize(
    "heading", [(0.0, 0, 0), (np.nan, 0, 1), (np.inf, 0, 0), (1.0, 0), [[1.0, 0, 0]], [[1.0, 0, 0], [1, 0, 0]]]
)
def test_headings_that_are_none(heading: tuple[float, ...], localization_map: LocalizationMap) -> None:
    with pytest.raises(ValueError, match="a heading is a direction"):
        ForwardScorer(localization_map, heading)
