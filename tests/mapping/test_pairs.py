"""Overlap of views against surfaces whose overlap follows from plane geometry."""

import numpy as np

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.mapping.triangulation import choose_pairs, shrink_depth, surface_overlap

CAMERA = PinholeCamera(320, 240, 160.0)


def wall_depth(distance_m):
    """Depth of a wall across the optical axis."""
    return np.full((CAMERA.height, CAMERA.width), distance_m, dtype=np.float32)


def test_overlap_of_cameras_that_face_a_wall():
    """A view of a wall 2 m away is 4 m wide, so a step of s metres to the side leaves the share 1 - s / 4."""
    steps = np.array([0.0, 0.5, 1.0, 1.5])
    poses = poses_looking_along(np.column_stack([steps, 0 * steps, 0 * steps]), np.tile([0.0, 1.0, 0.0], (4, 1)))
    overlap = surface_overlap(CAMERA, poses, shrink_depth(np.stack([wall_depth(2.0)] * 4)))
    expected = 1 - np.abs(steps[:, None] - steps[None]) / 4
    np.fill_diagonal(expected, 0)
    np.testing.assert_allclose(overlap, expected, atol=0.05)


def test_no_overlap_without_parallax_behind_walls_or_from_the_other_side():
    centers = np.array([[0.0, 0.0, 0.0], [0.001, 0.0, 0.0], [0.0, 4.0, 0.0], [0.5, 0.0, 0.0]])
    directions = np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    depth = np.stack([wall_depth(2.0), wall_depth(2.0), wall_depth(2.0), wall_depth(1.0)])
    overlap = surface_overlap(CAMERA, poses_looking_along(centers, directions), shrink_depth(depth))
    assert overlap[0, 1] == 0  # rays that meet at less than a degree
    # Facing each other through a thin wall, only the parts at which both look from the side of a line are near 180 or
    # 90 degrees apart: never below the limit.
    assert overlap[0, 2] == 0
    assert overlap[0, 3] == 0  # something hides the wall from the last camera
    empty = surface_overlap(CAMERA, poses_looking_along(centers, directions), 0 * shrink_depth(depth))
    assert (empty == 0).all()


def test_pairs_are_each_images_best_partners():
    rng = np.random.default_rng(0)
    overlap = rng.random((12, 12))
    overlap = (overlap + overlap.T) / 2
    np.fill_diagonal(overlap, 0)
    pairs = choose_pairs(overlap, 3, min_overlap=0.4)
    expected = set()
    for i in range(12):
        best = sorted(range(12), key=lambda j: -overlap[i, j])[:3]
        expected |= {(min(i, j), max(i, j)) for j in best if overlap[i, j] >= 0.4}
    assert [tuple(p) for p in pairs] == sorted(expected)
    assert choose_pairs(np.zeros((4, 4)), 3, min_overlap=0.0).shape == (0, 2)
    assert len(choose_pairs(np.ones((3, 3)) - np.eye(3), 10)) == 3
