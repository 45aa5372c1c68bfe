"""Poses of many images at once: P3P against closed forms and a plain twin, and the whole against single images."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from localization.rooms import CAMERA
from localization.test_joint import a_room, in_view
from twins import estimation as twin
from wheretolook.dataset.config import LOCALIZED, NO_POSE, TOO_FEW_MATCHES
from wheretolook.features.extractor import Keypoints
from wheretolook.features.matches import Matches
from wheretolook.geometry.poses import pose_error, poses_looking_along
from wheretolook.localization.batched_estimation import MatchBatch
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.estimation_kernel import p3p_kernel
from wheretolook.localization.localizer import Localizer
from wheretolook.localization.shard import label_rows
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh

FOCAL = 40.0  # in units of the limit of 8 pixels


def exact_matches(n_views, n_matches, seed):
    """Random poses (V, 3, 4), points (V, M, 3), and their keypoints (V, M, 2) on the plane at depth 1."""
    rng = np.random.default_rng(seed)
    poses = np.concatenate([Rotation.random(n_views, rng).as_matrix(), rng.normal(0, 3, (n_views, 3, 1))], axis=2)
    keypoints = rng.uniform(-1, 1, (n_views, n_matches, 2))
    in_camera = np.pad(keypoints, ((0, 0), (0, 0), (0, 1)), constant_values=1) * rng.uniform(
        1, 8, (n_views, n_matches, 1)
    )
    return poses, (in_camera - poses[:, None, :, 3]) @ poses[:, :, :3], keypoints


def solve(points, keypoints, device):
    """The kernel's solutions from the first three matches of each view: poses (V, 4, 3, 4) and costs (V, 4)."""
    n = len(points)
    costs = torch.full((n, 1, 4), torch.inf, dtype=torch.float64, device=device)
    turns = torch.full((n, 1, 4, 3, 3), torch.nan, dtype=torch.float64, device=device)
    shifts = turns[..., 0].contiguous()
    counts = torch.full((n,), points.shape[1], dtype=torch.int32, device=device)
    drawn = torch.arange(3, dtype=torch.int32, device=device).repeat(n, 1, 1)
    rays = np.pad(keypoints, ((0, 0), (0, 0), (0, 1)), constant_values=1)
    inputs = [torch.tensor(points, device=device), torch.tensor(rays, device=device), wp.vec3d(FOCAL, FOCAL, 0)]
    wp.launch(p3p_kernel, (n, 1), [*inputs, counts, drawn, costs, turns, shifts], device=device)
    wp.synchronize_device(device)
    return torch.cat([turns, shifts[..., None]], -1)[:, 0].cpu().numpy(), costs[:, 0].cpu().numpy()


def test_the_true_pose_is_among_the_solutions_of_p3p(device):
    poses, points, keypoints = exact_matches(1000, 3, seed=0)
    found, costs = solve(points, keypoints, device)
    error = np.nan_to_num(np.abs(found - poses[:, None]).max((2, 3)), nan=np.inf)
    assert error.min(1).max() < 1e-6
    turns = found[np.isfinite(costs)][:, :, :3]
    assert_allclose(turns @ turns.swapaxes(1, 2), np.broadcast_to(np.eye(3), turns.shape), atol=1e-8)


def test_solutions_and_scores_are_those_of_the_twin(device):
    _, points, keypoints = exact_matches(100, 12, seed=1)
    keypoints[:, 3:] += np.random.default_rng(2).normal(0, 0.02, (100, 9, 2))
    found, costs = solve(points, keypoints, device)
    for solutions, cost, of_view, at in zip(found, costs, points, keypoints, strict=True):
        expected = sorted((*pose[:, 3], twin.msac(pose, of_view, at, FOCAL)) for pose in twin.p3p(of_view[:3], at[:3]))
        got = sorted((*pose[:, 3], value) for value, pose in zip(cost, solutions, strict=True) if np.isfinite(value))
        assert_allclose(got, expected, atol=1e-6)


@pytest.mark.parametrize("shape", ["a line", "a point", "missing"])
def test_three_points_that_determine_no_pose_have_no_solution(shape, device):
    _, points, keypoints = exact_matches(20, 3, seed=3)
    if shape == "a line":
        points[:, 2] = 2 * points[:, 1] - points[:, 0]
    elif shape == "a point":
        points[:] = points[:, :1]
    else:
        points[:, 1] = np.nan
    _, costs = solve(points, keypoints, device)
    assert np.isinf(costs).all()


def refined(points, keypoints, poses, steps, device):
    """Refine poses (V, S, 3, 4) on points (V, 1 or S, M, 3) at keypoints: poses and costs (V, S)."""
    arrays = (torch.tensor(values, device=device) for values in (points, keypoints))
    found = MatchBatch(*arrays, (FOCAL, FOCAL)).refine(torch.tensor(poses, device=device), 1 / 8, steps)
    return [values.cpu().numpy() for values in found]


@pytest.mark.parametrize("shared", [True, False])
def test_refinement_is_that_of_the_twin(shared, device):
    """Several hypotheses with the same matches or each with its own, of which some are wrong, behind or missing."""
    rng = np.random.default_rng(6)
    poses, points, keypoints = exact_matches(20, 100, seed=7)
    keypoints += rng.normal(0, 0.1 / FOCAL, keypoints.shape)
    keypoints[:, :20] = rng.uniform(-1, 1, (20, 20, 2))
    points[:, 20:30] = -points[:, 20:30]
    keypoints[:, 30:35] = 1e6
    starts = np.stack([poses, poses, poses], 1)
    starts[..., 3] += rng.normal(0, 0.01, (20, 3, 3))
    starts[0, 1] = np.nan
    points, keypoints = (np.stack([x] if shared else [x, x[:, ::-1], x], 1) for x in (points, keypoints))
    found, costs = refined(points, keypoints, starts, 5, device)
    assert np.isnan(found[0, 1]).all() and np.isinf(costs[0, 1])
    for view, n in np.argwhere(np.isfinite(costs)):
        matched = 0 if shared else n
        pose, cost = twin.refine(starts[view, n], points[view, matched], keypoints[view, matched], FOCAL, 1 / 8, 5)
        assert_allclose(found[view, n], pose, atol=1e-9)
        assert_allclose(costs[view, n], cost, rtol=1e-9)


def test_refinement_finds_the_minimum(device):
    """Against SciPy with the same loss, on matches of which none is an outlier."""
    poses, points, keypoints = exact_matches(1, 20, seed=4)
    keypoints += np.random.default_rng(5).normal(0, 0.04 / FOCAL, keypoints.shape)
    start = poses.copy()
    start[:, :, 3] += 0.02
    found = refined(points[:, None], keypoints[:, None], start[:, None], 25, device)[0][:, 0]

    for pose, true, of_view, at in zip(found, poses, points, keypoints, strict=True):

        def moved(step, true=true):
            turn = Rotation.from_rotvec(step[:3]).as_matrix()
            return np.column_stack([turn @ true[:, :3], turn @ true[:, 3] + step[3:]])

        def norms(step, of_view=of_view, at=at, moved=moved):
            x, y, z = moved(step)[:, :3] @ of_view.T + moved(step)[:, 3:]
            return np.hypot(*((np.stack([x / z, y / z]) - at.T) * FOCAL))

        best = least_squares(norms, np.zeros(6), loss="cauchy", f_scale=1 / 8, xtol=1e-10)
        assert_allclose(pose, moved(best.x), atol=1e-4)


def matched_image(points, pose, rng, n_right=60, n_wrong=60):
    """Keypoints of a view of the points, and their matches, of which some are wrong and of less quality."""
    rows, pixels = in_view(points, pose, CAMERA)
    chosen = rng.choice(len(rows), n_right + n_wrong)
    landmarks = rows[chosen]
    landmarks[n_right:] = rng.choice(len(points), n_wrong)
    near = np.stack([landmarks, rng.choice(len(points), len(landmarks))], axis=1)
    squared = np.tile(np.float32([1, 4]), (len(near), 1))
    squared[n_right:, 0] += rng.uniform(-0.5, 1, n_wrong)
    pixels = (pixels[chosen] + rng.normal(0, 0.3, (len(chosen), 2))).astype(np.float32)
    return keypoints_at(pixels), Matches(np.arange(len(near)), landmarks, near, squared)


def keypoints_at(pixels):
    return Keypoints(pixels, np.zeros((len(pixels), 128), np.float32))


@pytest.fixture(scope="module")
def landmarks(room):
    """Landmarks on the walls of another room, with many in each view."""
    of_room = Landmarks.load(room.landmarks)
    return replace(of_room, points=a_room(n=len(of_room)) * 0.5)


@pytest.mark.parametrize("method", ["first", "hypotheses"])
def test_a_batch_gives_the_poses_of_single_images(landmarks, method, device):
    rng = np.random.default_rng(0)
    poses = poses_looking_along(rng.uniform(-0.3, 0.3, (5, 3)), rng.normal(size=(5, 3)))
    images = [matched_image(landmarks.points, pose, rng, n_wrong=30 * n) for n, pose in enumerate(poses)]
    localizer = Localizer(landmarks, CAMERA, LocalizerConfig(method), device=device)
    localizer.in_batches = True
    together = localizer.estimate_batch(*zip(*images, strict=True))
    for found, image, true in zip(together, images, poses, strict=True):
        alone = localizer.estimate(*image)
        assert found.status == alone.status == LOCALIZED
        assert max(pose_error(found.cam_from_world, alone.cam_from_world)) < 2e-3
        assert pose_error(found.cam_from_world, true)[0] < 0.02
        assert len(np.setxor1d(found.inlier_rows, alone.inlier_rows)) <= 2
        assert_array_equal(found.matched_rows, alone.matched_rows)
        assert (found.first is None) == (method == "first")
    (again,) = localizer.estimate_batch(*([of_last] for of_last in images[-1]))
    assert_allclose(again.cam_from_world, together[-1].cam_from_world, atol=1e-9)


def test_images_without_a_pose_have_the_status_of_single_images(landmarks):
    """Too few matches, all on a line, at pixels that are not numbers, all wrong; beside one with a pose."""
    rng = np.random.default_rng(1)
    (pose,) = poses_looking_along([[0.0, 0.0, 0.0]], [[1.0, 0.2, 0.1]])
    right = matched_image(landmarks.points, pose, rng)
    points = landmarks.points.copy()
    points[:40] = [0.0, 0.0, 1.0] + np.linspace(0, 1, 40)[:, None] * [1.0, 0.5, 0.2]
    line = Matches.none(40)._replace(keypoints=np.arange(40), landmarks=np.arange(40))
    line = line._replace(near=np.tile(np.arange(40)[:, None], 2), squared=np.tile(np.float32([1, 4]), (40, 1)))
    pixels = rng.uniform(0, 240, (40, 2)).astype(np.float32)
    few = Matches(*(values[:3] for values in line))
    images = [
        (keypoints_at(pixels[:3]), few),
        (keypoints_at(pixels), line),
        (keypoints_at(np.full((40, 2), np.nan, np.float32)), line),
        matched_image(points, pose, rng, n_right=0),
        right,
    ]
    for method in ("first", "hypotheses"):
        localizer = Localizer(replace(landmarks, points=points), CAMERA, LocalizerConfig(method))
        alone = [localizer.estimate(*image) for image in images]
        localizer.in_batches = True
        together = localizer.estimate_batch(*zip(*images, strict=True))
        expected = [TOO_FEW_MATCHES, NO_POSE, NO_POSE, NO_POSE, LOCALIZED]
        assert [found.status for found in together] == [found.status for found in alone] == expected
        assert localizer.estimate_batch(images[0][:1], images[0][1:])[0].status == TOO_FEW_MATCHES


@pytest.mark.parametrize("method", ["first", "hypotheses"])
def test_a_map_of_fewer_landmarks_than_nearest_ones(landmarks, method):
    rows = np.flatnonzero(np.isfinite(landmarks.points).all(1))[:12]
    rng = np.random.default_rng(0)
    points = rng.uniform((3, -1, -1), (5, 1, 1), (12, 3))
    values = {name: v[rows] if isinstance(v, np.ndarray) else v for name, v in vars(landmarks).items()}
    localizer = Localizer(Landmarks(**{**values, "points": points}), CAMERA, LocalizerConfig(method))
    (pose,) = poses_looking_along([[0.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]])
    seen, pixels = in_view(points, pose, CAMERA)
    right = Keypoints(pixels.astype(np.float32), landmarks.descriptors[rows[seen]].astype(np.float32) / 512)
    others = rng.gamma(0.5, 1, right.descriptors.shape).astype(np.float32)  # like many landmarks alike
    more = Keypoints(np.tile(right.pixels, (2, 1)), np.concatenate([right.descriptors, others]))
    localizer.in_batches = True
    keypoints = [right, more]
    for found in localizer.estimate_batch(keypoints, localizer.match(keypoints)):
        assert found.status == LOCALIZED and len(found.inlier_rows) == len(seen)
        assert max(pose_error(found.cam_from_world, pose)) < 1e-3


def test_views_are_labelled_alike_in_batches(room, views):
    """The whole chain, from rendering to labels, on views of which some localize."""
    tables = []
    for in_batches in (False, True):
        localizer = Localizer(Landmarks.load(room.landmarks), CAMERA, LocalizerConfig("hypotheses"))
        localizer.in_batches = in_batches
        tables.append(label_rows(views[::3], room.job, localizer, WarpRenderer(load_mesh(room.mesh))))
    alone, together = tables
    assert (together["status"] == alone["status"]).mean() > 0.8 and together["status"].nunique() > 1
    right = alone["error_m"] < 0.01  # wrong poses are random
    assert right.sum() >= 4
    for name in ("error_m", "error_deg", "first_error_m", "first_error_deg"):
        assert_allclose(together[name][right], alone[name][right], atol=2e-3)
    assert_allclose(together["n_inliers"][right], alone["n_inliers"][right], atol=3)


def test_a_batch_that_exceeds_the_memory_is_halved(landmarks, caplog):
    rng = np.random.default_rng(2)
    poses = poses_looking_along(np.zeros((4, 3)), rng.normal(size=(4, 3)))
    images = [matched_image(landmarks.points, pose, rng) for pose in poses]
    localizer = Localizer(landmarks, CAMERA)
    localizer.in_batches = True
    expected = localizer.estimate_batch(*zip(*images, strict=True))
    estimator = localizer._batched
    whole = estimator.localize

    def localize(views, *options):
        if len(views) > 2:
            raise RuntimeError("CUDA out of memory. Tried to allocate 1000 MiB")
        return whole(views, *options)

    estimator.localize = localize
    with caplog.at_level("WARNING"):
        found = localizer.estimate_batch(*zip(*images, strict=True))
    assert "GPU memory does not suffice" in caplog.text
    for one, other in zip(found, expected, strict=True):
        assert_allclose(one.cam_from_world, other.cam_from_world, atol=1e-9)
