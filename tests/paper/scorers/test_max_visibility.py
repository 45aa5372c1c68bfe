"""The benchmark's most visible landmarks."""

import numpy as np
import pytest

from synthetic_dataset import make_landmarks
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import axes_of_angles, fibonacci_sphere, yaw_pitch_angles
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.map import Map
from wheretolook_paper.scorers.max_visibility import MaxVisibilityScorer, SwappedMaxVisibilityScorer

CAMERA = PinholeCamera(320, 320, 277.0)


@pytest.fixture
def localization_map():
    return LocalizationMap(Map(make_landmarks(np.random.default_rng(0), 400)), CAMERA)


def count_of_the_benchmark(pose, points):
    """Points at a depth of 0 to 3 m that are projected into the image, whatever stands before them."""
    count = 0
    for x, y, z in points @ pose[:, :3].T + pose[:, 3]:
        if 0 < z < 3:
            u = 277 * x / z + 160
            v = 277 * y / z + 160
            count += 0 <= u < 320 and 0 <= v < 320
    return count


def test_max_visibility_counts_as_the_benchmark(localization_map, device):
    rng = np.random.default_rng(1)
    points = localization_map.landmarks.points
    poses = poses_looking_along(rng.uniform((-2, -2, 0.5), (2, 2, 2), (60, 3)), rng.normal(size=(60, 3)))
    expected = [count_of_the_benchmark(pose, points) for pose in poses]
    scorer = MaxVisibilityScorer(LocalizationMap(Map(localization_map.landmarks), CAMERA, device=device))
    np.testing.assert_allclose(scorer.score(poses) * len(points), expected, atol=1e-9)
    assert max(expected) > 50 and min(expected) == 0
    behind_3_m = [np.sum((points @ pose[2, :3] + pose[2, 3]) >= 3) for pose in poses]
    assert sum(behind_3_m) > 100


def test_the_swapped_one_looks_at_yaw_for_pitch_and_pitch_for_yaw(localization_map):
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
