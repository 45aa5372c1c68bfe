"""Landmarks of views described one by one, and pooled, against NumPy view by view."""

import numpy as np
import pytest
import torch

from synthetic_dataset import CAMERA, make_landmarks
from wheretolook.geometry.camera import ColmapCamera
from wheretolook.geometry.poses import poses_looking_along, transform
from wheretolook.inputs.channels import ATTRIBUTES, POSE_ATTRIBUTES
from wheretolook.inputs.landmark_features import LandmarkDescriber
from wheretolook.inputs.localization_map import LocalizationMap, shared_locations
from wheretolook.mapping.landmarks import MAP_ATTRIBUTES
from wheretolook.mapping.map import Map
from wheretolook.visibility.occlusion import StoredOcclusion

COLMAP = ColmapCamera("OPENCV", 160, 120, (80.0, 80.0, 80.0, 60.0, -0.1, 0.01, 1e-3, -1e-3))


def some_views():
    rng = np.random.default_rng(1)
    at = rng.uniform((-2, -2, 0.5), (2, 2, 2), (6, 3))
    return poses_looking_along(at[rng.integers(0, 6, 50)], rng.normal(size=(50, 3)))


@pytest.fixture(params=[CAMERA, COLMAP], ids=["pinhole", "opencv"])
def localization_map(request, device):
    rng = np.random.default_rng(0)
    landmarks = make_landmarks(rng, 400)
    centers = np.unique(-np.einsum("bji,bj->bi", some_views()[:, :, :3], some_views()[:, :, 3]).round(6), axis=0)
    occlusion = StoredOcclusion.from_mask(centers, rng.random((len(centers), 400)) < 0.7)
    return LocalizationMap(Map(landmarks), request.param, occlusion, device)


def test_each_landmark_by_hand(localization_map):
    m = localization_map.landmarks
    views = some_views()
    described = LandmarkDescriber(localization_map).describe(views)
    visible = localization_map.landmarks_in_view(views)
    assert len(described) == 50 and described.counts.tolist() == np.diff(visible.starts).tolist()
    assert described.counts.min() == 0 and described.counts.max() > 50
    np.testing.assert_array_equal(described.rows.cpu(), visible.indices)
    np.testing.assert_array_equal(described.views.cpu(), np.repeat(np.arange(50), np.diff(visible.starts)))
    for view, pose in enumerate(views):
        rows = visible[view]
        x, y, z = transform(pose, m.points[rows]).T
        ray = m.points[rows] + pose[:, :3].T @ pose[:, 3]
        distance = np.linalg.norm(ray, axis=1)
        expected = {
            "across": x / z,
            "down": y / z,
            "distance": np.log(distance),
            "mapped_angle": (ray * m.mapping_direction[rows]).sum(1) / distance,
            "distance_ratio": np.log(distance / m.mapping_distance_m[rows]),
            "pixel_angle": np.full(len(rows), -np.log(localization_map.camera.mean_focal_px)),
            "pixel_size_ratio": np.log(distance / localization_map.camera.mean_focal_px)
            - np.log(m.mapping_distance_m[rows] / m.mapping_focal_px[rows]),
            "track_length": np.log(m.track_length[rows]),
            "reprojection_error": m.reprojection_error_px[rows],
            "triangulation_angle": np.log(m.triangulation_angle_deg[rows]),
            "direction_spread": m.mapping_direction_spread[rows],
            "ambiguity": m.ambiguity[rows],
            "mapped_distance": np.log(m.mapping_distance_m[rows]),
            "distance_spread": m.mapping_distance_spread[rows],
            "mapped_pixel_size": np.log(m.mapping_distance_m[rows] / m.mapping_focal_px[rows]),
        }
        assert tuple(expected) == ATTRIBUTES == POSE_ATTRIBUTES + MAP_ATTRIBUTES
        found = described.values[described.starts[view] : described.starts[view + 1]].cpu()
        np.testing.assert_allclose(found, np.stack([*expected.values()], axis=1), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("most", [None, 1, 20])
def test_blocks_of_views_hold_all_or_evenly_spread_landmarks(localization_map, most, monkeypatch):
    views = some_views()
    describer = LandmarkDescriber(localization_map)
    whole = describer.describe(views)
    monkeypatch.setattr("wheretolook.inputs.landmark_features.BLOCK_ENTRIES", {"cpu": 100, "cuda": 100})
    n_views = 0
    for rows, part, visible in describer.in_blocks(views, most):
        assert rows.start == n_views and (len(part) == 1 or part.counts.sum() <= 100)
        for view in range(len(part)):
            all_of_view = slice(int(whole.starts[n_views]), int(whole.starts[n_views + 1]))
            kept = slice(int(part.starts[view]), int(part.starts[view + 1]))
            n = all_of_view.stop - all_of_view.start
            assert visible[view] == n
            expected = torch.arange(n) if most is None or n <= most else torch.arange(most) * n // most
            assert torch.equal(part.rows[kept].cpu(), whole.rows[all_of_view].cpu()[expected])
            assert torch.equal(part.values[kept], whole.values[all_of_view][expected])
            n_views += 1
    assert n_views == len(views)


def test_views_share_locations_in_whatever_order_they_come():
    rng = np.random.default_rng(5)
    places = rng.uniform(0, 4, (4, 3))
    for order in ([0, 0, 0], [0, 0, 1, 1, 2], [2, 0, 2, 1, 0, 3, 3, 0], []):
        poses = poses_looking_along(places[order], rng.normal(size=(len(order), 3)))
        locations, rows = shared_locations(poses)
        assert len(locations) == len(set(order))
        np.testing.assert_allclose(locations[rows], places[order], atol=1e-6)


def test_one_view_is_described_and_thinned_as_it_is_among_others(localization_map):
    poses = some_views()
    describer = LandmarkDescriber(localization_map)
    ((_, together, seen),) = describer.in_blocks(poses, 20)
    assert int(seen.max()) > 20 == int(together.counts.max())
    for view, pose in enumerate(poses):
        ((_, alone, alone_seen),) = describer.in_blocks(pose[None], 20)
        mine = together.views == view
        assert alone.rows.tolist() == together.rows[mine].tolist()
        torch.testing.assert_close(alone.values, together.values[mine], rtol=1e-5, atol=1e-5, equal_nan=True)
        assert int(alone_seen[0]) == int(seen[view])
