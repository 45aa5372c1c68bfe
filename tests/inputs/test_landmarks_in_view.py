"""Landmarks of views described one by one, and pooled, against NumPy view by view."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from box_scenes import furnished_room
from selection.room import POINTS, write_room
from synthetic_dataset import CAMERA, make_landmarks
from wheretolook.geometry.camera import ColmapCamera
from wheretolook.geometry.lattices import direction_lattice
from wheretolook.geometry.poses import poses_looking_along, transform
from wheretolook.inputs.channels import ATTRIBUTES, POSE_ATTRIBUTES
from wheretolook.inputs.landmark_features import LandmarkDescriber, ReasonCounter
from wheretolook.inputs.localization_map import LocalizationMap, shared_locations
from wheretolook.mapping.landmarks import MAP_ATTRIBUTES
from wheretolook.mapping.map import Map
from wheretolook.scenes.loading import save_glb
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
    assert_array_equal(described.rows.cpu(), visible.indices)
    assert_array_equal(described.views.cpu(), np.repeat(np.arange(50), np.diff(visible.starts)))
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
        assert_allclose(found, np.stack([*expected.values()], axis=1), rtol=1e-4, atol=1e-5)


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
        assert_allclose(locations[rows], places[order], atol=1e-6)


# Landmarks that are hard to match are counted by their distance, angle, descriptor and line of sight.


def test_counts_by_the_definitions(tmp_path):
    save_glb(furnished_room(), tmp_path / "room.glb")
    room = LocalizationMap.from_colmap(write_room(tmp_path / "sparse"), mesh=tmp_path / "room.glb")
    mapped_m = room.landmarks.mapping_distance_m / 4  # so that some are twice as far
    mapped_along = np.roll(room.landmarks.mapping_direction, 1, axis=0)  # and some oblique
    ambiguity = np.linspace(0.9, 1.0, len(room.landmarks), dtype=np.float32)
    changed = {"mapping_distance_m": mapped_m, "mapping_direction": mapped_along, "ambiguity": ambiguity}
    room = replace(room, map=replace(room.map, landmarks=replace(room.landmarks, **changed)))
    axes = direction_lattice(12)
    poses = poses_looking_along(np.repeat(POINTS, 12, axis=0), np.tile(axes, (4, 1)))
    counts = ReasonCounter(room).count(poses)
    expected = np.zeros((len(poses), 4), dtype=int)
    for row, pose in enumerate(poses):
        local = room.landmarks.points @ pose[:, :3].T + pose[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = (320 * local[:, :2] / local[:, 2:] + (320, 240)).T
        in_image = (local[:, 2] > 0) & (x >= 0) & (x < 640) & (y >= 0) & (y < 480)
        visible = room.landmarks_in_view(pose[None])[0]
        rays = (local @ pose[:, :3])[visible]
        distance = np.linalg.norm(rays, axis=1)
        angle = np.degrees(np.arccos((rays * mapped_along[visible]).sum(1) / distance))
        hard = distance > 2 * mapped_m[visible], angle > 45, ambiguity[visible] > 0.95
        expected[row] = in_image.sum() - len(visible), *(reason.sum() for reason in hard)
    found = np.column_stack([counts.n_occluded, counts.n_too_far, counts.n_too_oblique, counts.n_repeated])
    np.testing.assert_array_equal(found, expected)
    assert (expected.sum(0) > 0).all()


def test_without_descriptors_repetition_is_unknown(tmp_path):
    room = LocalizationMap.from_colmap(write_room(tmp_path / "sparse"))
    counts = ReasonCounter(room).count(poses_looking_along(POINTS, np.tile((1.0, 0, 0), (4, 1))))
    assert np.isnan(counts.n_repeated).all() and (counts.n_occluded == 0).all() and (counts.n_too_far >= 0).all()
