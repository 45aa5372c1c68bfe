"""The counting kernel against its plain twin and by hand."""

from __future__ import annotations

import numpy as np

from conftest import RandomViews
from wheretolook.geometry import PinholeCamera, rotation_looking_along, transform
from wheretolook.visibility import VisibleSets, count_in_frustum
from wheretolook.visibility.frustum import count_in_frustum_plain


def test_sparse_rows_of_a_mask() -> None:
    mask = np.array([[1, 0, 1], [0, 0, 0], [0, 1, 1]], dtype=bool)
    sets = VisibleSets.from_mask(mask)
    assert sets.starts.tolist() == [0, 2, 2, 4]
    assert sets.indices.tolist() == [0, 2, 1, 2]


def test_kernel_counts_as_its_plain_twin(random_views: RandomViews, device: str) -> None:
    v = random_views
    rotations = rotation_looking_along(v.directions)
    arguments = v.camera, rotations, v.locations, v.points, v.visible
    counts, plain = count_in_frustum(*arguments, device), count_in_frustum_plain(*arguments)
    # Single precision may decide differently within this many pixels of the border: allow exactly those landmarks.
    border = np.zeros_like(plain)
    for row, location in enumerate(v.locations):
        seen = (v.points[v.mask[row]] - location) @ np.swapaxes(rotations, 1, 2)
        pixels = v.camera.project(seen)
        gap = np.minimum(np.abs(pixels), np.abs(pixels - [v.camera.width, v.camera.height])).min(-1)
        border[row] = (gap < 1e-2).sum(-1)
    assert np.all(np.abs(counts - plain) <= border)
    assert plain.sum() > 500 and (counts != plain).mean() < 0.05


def test_counts_by_hand(device: str) -> None:
    camera = PinholeCamera(100, 100, 50.0)  # sees 45 degrees to every side
    points = np.array([[1, 0, 0], [1, 0.9, 0], [1, 1.1, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 0], [np.nan, 0, 0]])
    visible = VisibleSets.from_mask(np.ones((1, 7), dtype=bool))
    directions = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0]])
    counts = count_in_frustum(camera, rotation_looking_along(directions), np.zeros((1, 3)), points, visible, device)
    assert counts.tolist() == [[2, 1, 2]]


def test_occluded_landmarks_do_not_count() -> None:
    camera, points = PinholeCamera(100, 100, 50.0), np.array([[1.0, 0, 0], [2, 0, 0], [3, 0, 0]])
    visible = VisibleSets.from_mask(np.array([[True, False, False], [True, False, True]]))
    rotation = rotation_looking_along(np.array([[1.0, 0, 0]]))
    assert count_in_frustum(camera, rotation, np.zeros((2, 3)), points, visible).tolist() == [[1], [2]]


def test_moving_map_and_camera_together_changes_nothing(random_views: RandomViews) -> None:
    from scipy.spatial.transform import Rotation

    v = random_views
    turn = Rotation.from_rotvec([0.3, -0.5, 1.1]).as_matrix()
    rotations = rotation_looking_along(v.directions)
    moved = np.concatenate([turn, [[3.0], [-1.0], [2.0]]], axis=1)
    before = count_in_frustum_plain(v.camera, rotations, v.locations, v.points, v.visible)
    after = count_in_frustum(
        v.camera, rotations @ turn.T, transform(moved, v.locations), transform(moved, v.points), v.visible
    )
    assert np.abs(before - after).max() <= 1
