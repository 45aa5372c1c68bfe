"""Matching again under a pose finds the landmarks that the pose predicts, and none that it does not."""

from __future__ import annotations

import numpy as np
from tests.localization.test_joint import CAMERA, a_room

from wheretolook.geometry.poses import pose_error, poses_looking_along, transform
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.estimation import PoseEstimator
from wheretolook.localization.guided_matching import MAX_NEAREST_RATIO, GuidedMatcher, StoredKeypoints
from wheretolook.localization.rig import Look
from wheretolook.localization.rig_localization import JointLocalizer


def twin_rooms(n=1500, seed=0):
    """Two rooms 20 m apart with the same landmarks: points (2n, 3) and descriptors (2n, 128)."""
    room = a_room(n, seed)
    descriptors = np.random.default_rng(seed).integers(0, 90, (n, 128), dtype=np.uint8)
    return np.concatenate([room, room + np.array((20, 0, 0))]), np.concatenate([descriptors, descriptors])


def view_of(points, descriptors, pose, n_matched=12, noise=6, seed=1):
    """A view whose keypoints are landmarks of the first room, of which a few are matched already."""
    rng = np.random.default_rng(seed)
    in_camera = transform(pose, points)
    pixels = CAMERA.project(in_camera)
    rows = np.flatnonzero(
        (in_camera[:, 2] > 0.1) & CAMERA.in_image(pixels) & (np.arange(len(points)) < len(points) // 2)
    )
    seen = np.clip(descriptors[rows] + rng.integers(-noise, noise + 1, (len(rows), 128)), 0, 255).astype(np.uint8)
    distances = ((seen[:, None].astype(float) - descriptors[rows].astype(float)) ** 2).sum(2).min(1)
    at = pixels[rows] + rng.normal(0, 0.5, (len(rows), 2))
    few = rng.choice(len(rows), n_matched, replace=False)
    keypoints = StoredKeypoints(at, seen, distances)
    return Look(np.eye(3, 4), at[few] + rng.normal(0, 2, (n_matched, 2)), rows[few], CAMERA, keypoints), rows


def test_a_correct_pose_finds_landmarks_that_have_twins_and_a_wrong_one_does_not():
    points, descriptors = twin_rooms()
    pose, wrong = poses_looking_along([(0.4, -0.7, 0.1)] * 2, [(1, 0.2, 0), (-0.2, 1, 0)])
    look, rows = view_of(points, descriptors, pose)
    matcher = GuidedMatcher(points, descriptors)
    found = matcher.match(look, pose, 4.0)
    assert len(found.rows) > 0.98 * len(rows) and np.isin(found.rows, rows).mean() > 0.99
    assert len(matcher.match(look, wrong, 4.0).rows) < 0.02 * len(rows)


def test_matches_are_those_of_a_search_over_all_pairs():
    rng = np.random.default_rng(3)
    points = a_room(400)
    descriptors = rng.integers(0, 60, (400, 32), dtype=np.uint8)
    pose = poses_looking_along([(0.0, 0, 0)], [(1.0, 0.1, 0)])[0]
    pixels = rng.uniform(0, (640, 480), (300, 2))
    seen = rng.integers(0, 60, (300, 32), dtype=np.uint8)
    squared = ((seen[:, None].astype(float) - descriptors) ** 2).sum(2)
    nearest = np.quantile(squared, 0.5, axis=1)
    found = GuidedMatcher(points, descriptors).match(
        Look(np.eye(3, 4), pixels[:0], np.zeros(0, int), CAMERA, StoredKeypoints(pixels, seen, nearest)), pose, 30.0
    )
    in_camera = transform(pose, points)
    near = np.linalg.norm(CAMERA.project(in_camera) - pixels[:, None], axis=2) <= 30
    allowed = near & (in_camera[:, 2] > 0.05) & (squared <= MAX_NEAREST_RATIO**2 * nearest[:, None])
    best = {}
    for keypoint in range(300):
        if allowed[keypoint].any():
            landmark = int(np.where(allowed[keypoint], squared[keypoint], np.inf).argmin())
            if landmark not in best or squared[keypoint, landmark] < squared[best[landmark], landmark]:
                best[landmark] = keypoint
    assert len(best) > 30
    expected = sorted((landmark, *pixels[keypoint]) for landmark, keypoint in best.items())
    np.testing.assert_allclose(sorted(zip(found.rows, *found.pixels.T, strict=True)), expected)


def test_a_pose_from_few_matches_becomes_more_accurate():
    points, descriptors = twin_rooms()
    pose = poses_looking_along([(0.4, -0.7, 0.1)], [(1, 0.2, 0)])[0]
    look, _ = view_of(points, descriptors, pose)
    estimator = PoseEstimator(points, LocalizerConfig(method="hypotheses"))
    alone = JointLocalizer(estimator).localize([look])
    guided = JointLocalizer(estimator, guide=GuidedMatcher(estimator.points, descriptors)).localize([look])
    assert guided.n_inliers > 10 * alone.n_inliers
    error, error_alone = (pose_error(result.rig_from_world, pose)[0] for result in (guided, alone))
    assert error < 0.3 * error_alone and error < 0.01
