"""The network of the whole sphere: its lattice, its tokens, its batches, what it learns, and its weights on disk."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from synthetic_dataset import CAMERA, make_landmarks, make_mapping_poses
from wheretolook.geometry.lattices import axes_of_angles, fibonacci_sphere, yaw_pitch_angles
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.map import Map
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.visibility.occlusion import StoredOcclusion
from wheretolook_paper.scorers.sphere import SphereConfig
from wheretolook_paper.scorers.sphere.network import PITCHES, YAWS, SphereNetwork, on_lattice
from wheretolook_paper.scorers.sphere.score import SphereScorer
from wheretolook_paper.scorers.sphere.views import LocationDescriber

FEW = SphereConfig(points=48, cameras=8, width=32, heads=2, layers=1, dropout=0.0, epochs=10, batch_size=40)


@pytest.fixture
def localization_map():
    landmarks = make_landmarks(np.random.default_rng(0), 200)
    return LocalizationMap(Map(landmarks, mapping_poses=make_mapping_poses(0)), CAMERA)


@pytest.fixture
def model():
    """Untrained; its logits differ from direction to direction and from place to place."""
    torch.manual_seed(0)
    return TrainedNetwork("sphere", SphereNetwork(FEW).requires_grad_(False), CAMERA, 1.5, -0.25)


def at_angles(*yaw_pitch_deg):
    return torch.from_numpy(axes_of_angles(yaw_pitch_deg))


def test_the_lattice_has_its_own_values_at_its_directions_and_means_between():
    values = torch.randn(2, PITCHES, YAWS, dtype=torch.float64)
    axes = torch.from_numpy(axes_of_angles(yaw_pitch_angles()))
    for lattice in (0, 1):
        found = on_lattice(values, torch.full((len(axes),), lattice), axes)
        torch.testing.assert_close(found, values[lattice].flatten(), rtol=0, atol=1e-10)
        torch.testing.assert_close(on_lattice(values, torch.full((108,), lattice), 3 * axes), found)
    # yaw 10, pitch -50 is in the middle of four; row 0 is at -60, column 9 at 0
    found = on_lattice(values, torch.zeros(1, dtype=torch.int64), at_angles((10, -50)))
    torch.testing.assert_close(found[0], values[0, :2, 9:11].mean())
    found = on_lattice(values, torch.zeros(1, dtype=torch.int64), at_angles((25, 0)))
    torch.testing.assert_close(found[0], 0.75 * values[0, 3, 10] + 0.25 * values[0, 3, 11])


def test_a_pose_has_its_own_score(localization_map, model):
    rng = np.random.default_rng(2)
    locations = rng.uniform((-1, -1, 1), (1, 1, 2), (5, 3))
    mask = rng.random((5, 200)) < 0.5
    mask[3] = False  # sees nothing, and is scored all the same
    seen = replace(localization_map, occlusion=StoredOcclusion.from_mask(locations, mask))
    views = poses_looking_along(np.repeat(locations, 8, axis=0), np.tile(fibonacci_sphere(8), (5, 1)))
    scorer = SphereScorer(seen, model)
    scores = scorer.score(views)
    assert scores.dtype == np.float64 and ((scores > 0) & (scores < 1)).all() and len(np.unique(scores)) == 40
    order = rng.permutation(40)
    np.testing.assert_array_equal(scorer.score(views[order]), scores[order])
    np.testing.assert_array_equal([scorer.score(view[None])[0] for view in views[::7]], scores[::7])
    # of the network by hand: direction 0 of the lattice at location 3, which is none but cameras
    (tokens,) = LocationDescriber(seen, FEW).describe(locations[3:4])
    lattice = poses_looking_along(np.tile(locations[3], (108, 1)), axes_of_angles(yaw_pitch_angles()))
    logits = 1.5 * model.network.encode(tokens[None]).flatten().double() - 0.25
    np.testing.assert_allclose(scorer.score(lattice), logits.sigmoid(), rtol=1e-5)
    rolled = views.copy()
    rolled[:, :2] *= -1  # by half a turn about the optical axis
    np.testing.assert_allclose(scorer.score(rolled), scores, rtol=1e-9)
