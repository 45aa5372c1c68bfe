"""What a scorer that knows its landmarks must prefer, all else alike."""

import numpy as np
import pytest

from synthetic_dataset import make_landmarks
from wheretolook.features.extractor import quantize_descriptors
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import Landmarks, max_cosine_to_other
from wheretolook.mapping.map import Map
from wheretolook.scorers.weights import load_scorer

CAMERA = PinholeCamera(320, 240, 160.0)


def two_walls(n, seed):
    """Walls x = -2, where no two patches are alike, and x = 2, its mirror image, whose texture repeats 12 patches."""
    rng = np.random.default_rng(seed)
    left = np.column_stack([np.full(n, -2.0), rng.uniform(-1.2, 1.2, n), rng.uniform(0.6, 2.0, n)])
    patches = np.abs(rng.normal(size=(n, 128)))
    repeated = patches[rng.integers(0, 12, n)] * rng.normal(1, 0.03, (n, 128))
    descriptors = np.concatenate([patches, np.abs(repeated)])
    descriptors = quantize_descriptors(descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True))
    directions = left - (0, 0, 1.3) + rng.normal(0, 0.3, (n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    track_length = rng.integers(2, 6, n).astype(np.int32)
    of_both = {
        "track_length": track_length,
        "reprojection_error_px": rng.uniform(0.02, 0.3, n),
        "triangulation_angle_deg": rng.uniform(4, 30, n),
        "mapping_direction_spread": rng.uniform(0, 0.05, n),
        "mapping_distance_m": rng.uniform(1.5, 3.0, n),
        "mapping_distance_spread": rng.uniform(0, 0.2, n),
    }
    mirror = np.array([-1.0, 1, 1])
    return make_landmarks(
        rng, 2 * n, points=np.concatenate([left, left * mirror]), ambiguity=max_cosine_to_other(descriptors),
        mapping_direction=np.concatenate([directions, directions * mirror]), mapping_focal_px=np.nan,
        **{name: np.tile(values, 2) for name, values in of_both.items()},
    )  # fmt: skip


@pytest.mark.parametrize(("n", "seed"), [(40, 0), (80, 1), (160, 2), (400, 0)])
def test_a_wall_that_repeats_its_texture_is_not_the_one_to_look_at(n, seed):
    landmarks = two_walls(n, seed)
    views = poses_looking_along([[0, 0, 1.3]] * 2, [[-1.0, 0, 0], [1.0, 0, 0]])
    localization_map = LocalizationMap(Map(landmarks), CAMERA)
    visible = localization_map.landmarks_in_view(views)
    assert len(visible[0]) == len(visible[1]) == n
    assert np.median(landmarks.ambiguity[visible[1]]) > np.median(landmarks.ambiguity[visible[0]]) + 0.1
    odds = np.log(1 / load_scorer(localization_map).score(views) - 1)
    assert odds[0] < odds[1] - 0.1


@pytest.mark.parametrize("n", [40, 100, 200])
def test_a_wall_mapped_from_one_side_is_best_seen_from_that_side(n):
    both = two_walls(n, seed=1)
    left = {name: None if value is None else value[:n] for name, value in vars(both).items()}
    localization_map = LocalizationMap(Map(Landmarks(**left)), CAMERA)
    views = poses_looking_along([[0, 0, 1.3], [-4.0, 0, 1.3]], [[-1.0, 0, 0], [1.0, 0, 0]])
    assert np.diff(localization_map.landmarks_in_view(views).starts).tolist() == [n, n]
    scores = load_scorer(localization_map).score(views)
    assert scores[0] > 5 * scores[1]
