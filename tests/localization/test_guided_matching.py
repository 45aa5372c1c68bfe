"""Matching again under a pose finds the landmarks that the pose predicts, and none that it does not."""

from dataclasses import replace

import numpy as np
from tests.localization.test_joint import CAMERA, a_room

from wheretolook.features.matches import Matches
from wheretolook.geometry.poses import pose_error, poses_looking_along, transform
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.estimation import PoseEstimator, match_under
from wheretolook.localization.rig import MAX_NEAREST_RATIO, Candidates, Look
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
    seen = descriptors[rows] + rng.integers(-noise, noise + 1, (len(rows), 128))
    squared = ((seen[:, None] - descriptors[None].astype(np.int64)) ** 2).sum(2)
    near = np.argsort(squared, axis=1)[:, :5]
    at = pixels[rows] + rng.normal(0, 0.5, (len(rows), 2))
    few = np.sort(rng.choice(len(rows), n_matched, replace=False))
    matches = Matches(few, rows[few], near, np.take_along_axis(squared, near, 1).astype(np.float32))
    return Look(
        np.eye(3, 4), at[few] + rng.normal(0, 2, (n_matched, 2)), rows[few], CAMERA, Candidates.of(at, matches)
    ), rows


def test_a_correct_pose_finds_landmarks_that_have_twins_and_a_wrong_one_does_not():
    points, descriptors = twin_rooms()
    pose, wrong = poses_looking_along([(0.4, -0.7, 0.1)] * 2, [(1, 0.2, 0), (-0.2, 1, 0)])
    look, rows = view_of(points, descriptors, pose)
    assert look.candidates is not None
    points = points[look.candidates.landmarks]
    found = match_under(look, points, pose, 4.0)
    assert len(found.rows) > 0.98 * len(rows) and np.isin(found.rows, rows).mean() > 0.99
    assert len(match_under(look, points, wrong, 4.0).rows) < 0.02 * len(rows)


def test_matches_are_those_of_a_search_over_all_pairs():
    rng = np.random.default_rng(3)
    points = a_room(400)
    pose = poses_looking_along([(0.0, 0, 0)], [(1.0, 0.1, 0)])[0]
    pixels = rng.uniform(0, (640, 480), (300, 2))
    squared = rng.uniform(1, 1.5, (300, 400))
    near = np.argsort(squared, axis=1)
    matches = Matches.none(300)._replace(near=near, squared=np.take_along_axis(squared, near, 1))
    candidates = Candidates.of(pixels, matches)
    look = Look(np.eye(3, 4), pixels[:0], near[0, :0], CAMERA, candidates)
    found = match_under(look, points[candidates.landmarks], pose, 30.0)
    in_camera = transform(pose, points)
    near_px = np.linalg.norm(CAMERA.project(in_camera) - pixels[:, None], axis=2) < 30
    allowed = near_px & (in_camera[:, 2] > 0) & (squared <= MAX_NEAREST_RATIO**2 * squared.min(1)[:, None])
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
    localizer = JointLocalizer(PoseEstimator(points, LocalizerConfig(method="hypotheses")))
    alone = localizer.localize([replace(look, candidates=None)])
    guided = localizer.localize([look])
    assert guided.n_inliers > 10 * alone.n_inliers
    error, error_alone = (pose_error(result.rig_from_world, pose)[0] for result in (guided, alone))
    assert error < 0.3 * error_alone and error < 0.01
