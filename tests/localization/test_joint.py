"""Joint localization recovers known poses in spite of outliers, noise, and similar rooms."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from wheretolook.features.matches import Matches
from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.geometry.poses import camera_centers, compose_poses, pose_error, poses_looking_along, transform
from wheretolook.localization.confidence import ERRORS_ON_PHOTOGRAPHS, RIGHT_PLACE
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.estimation import (
    PoseAmbiguity,
    PoseEstimator,
    match_under,
    most_likely,
    strongest_rival,
    turn_errors,
)
from wheretolook.localization.rig import MAX_NEAREST_RATIO, Candidates, FocalPrior, Look, rig_of
from wheretolook.localization.rig_localization import JointLocalizer
from wheretolook.utils.errors import PoseError

CAMERA = PinholeCamera()
AXES = ((1, 0, 0), (0, 1, 0.2), (-1, 0.3, -0.1))


def a_room(n=3000, seed=0, shift=(0.0, 0.0, 0.0)):
    """Points on the walls of a room of 8 x 6 x 3 m centred at the origin, (n, 3)."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (n, 3))
    axis = rng.integers(0, 3, n)
    points[np.arange(n), axis] = np.sign(points[np.arange(n), axis])
    return points * (4, 3, 1.5) + shift


def in_view(points, cam_from_world, camera=CAMERA):
    """Rows of the points in a view, and their pixels."""
    there = transform(cam_from_world, points)
    pixels = camera.project(np.where(there[:, 2:] > 0.1, there, (0, 0, 1)))
    rows = np.flatnonzero((there[:, 2] > 0.1) & camera.in_image(pixels))
    return rows, pixels[rows]


def look_at(points, cam_from_world, cam_from_rig, rng, n=80, noise_px=0.0, outliers=0.0, camera=CAMERA):
    """A look's matches with so many points in its image, some with wrong landmarks; (Look, right matches)."""
    rows, pixels = in_view(points, cam_from_world, camera)
    chosen = rng.choice(len(rows), min(n, len(rows)), replace=False)
    seen = pixels[chosen] + rng.normal(0, noise_px, (len(chosen), 2))
    wrong = rng.random(len(chosen)) < outliers
    matched = np.where(wrong, rng.integers(0, len(points), len(chosen)), rows[chosen])
    return Look(cam_from_rig, seen, matched, camera), ~wrong


def looks_from(points, center=(0.4, -0.7, 0.1), axes=AXES, seed=1, **options):
    rng = np.random.default_rng(seed)
    poses = poses_looking_along(np.tile(center, (len(axes), 1)), np.array(axes, dtype=float))
    made = [
        look_at(points, pose, cam_from_rig, rng, **options)
        for pose, cam_from_rig in zip(poses, rig_of(poses), strict=True)
    ]
    return poses, [look for look, _ in made], [right for _, right in made]


def test_a_rig_whose_parts_are_apart_is_localized_as_one():
    """Stereo with 30 cm between centres and a camera that looks back, of another model."""
    points = a_room()
    rng = np.random.default_rng(3)
    other = ColmapCamera("OPENCV", 800, 600, (400.0, 410.0, 390.0, 310.0, -0.1, 0.02, 0.001, -0.001))
    cams_from_rig = [np.eye(3, 4), np.eye(3, 4), np.eye(3, 4)]
    cams_from_rig[1][0, 3] = -0.3
    cams_from_rig[2][:, :3] = Rotation.from_euler("y", 170, degrees=True).as_matrix()
    cams_from_rig[2][:, 3] = (0.0, 0.1, 0.2)
    rig = poses_looking_along([[0.5, 0.2, -0.2]], [[1.0, 0.4, 0.1]])[0]
    poses = np.stack([compose_poses(m, rig) for m in cams_from_rig])
    cameras = (CAMERA, CAMERA, other)
    looks = [
        look_at(points, pose, m, rng, camera=c)[0] for pose, m, c in zip(poses, cams_from_rig, cameras, strict=True)
    ]
    found = JointLocalizer(PoseEstimator(points)).localize(looks)
    assert_allclose(found.cams_from_world, poses, atol=1e-5)


def test_outliers_are_separated_from_inliers():
    points = a_room()
    poses, looks, right = looks_from(points, outliers=0.7, noise_px=0.5)
    found = JointLocalizer(PoseEstimator(points)).localize(looks)
    error_m, error_deg = pose_error(found.cams_from_world, poses)
    assert error_m.max() < 0.02 and error_deg.max() < 0.2
    inlier = np.concatenate(found.inliers)
    assert (inlier[np.concatenate(right)]).mean() > 0.98 and inlier[~np.concatenate(right)].mean() < 0.02
    assert found.rival_support < 0.2 * found.support


def test_several_looks_are_more_accurate_and_the_deviation_is_calibrated():
    """Over 40 draws of noise the errors are as large as the deviation says, and smaller than those of one look."""
    points = a_room()
    localizer = JointLocalizer(PoseEstimator(points))
    errors = []
    single = []
    deviations = []
    for seed in range(40):
        poses, looks, _ = looks_from(points, seed=seed, noise_px=1.0, n=30)
        found = localizer.localize(looks)
        alone = localizer.localize(looks[:1])
        errors.append(np.linalg.norm(camera_centers(found.cams_from_world[0]) - camera_centers(poses[0])))
        single.append(np.linalg.norm(camera_centers(alone.cams_from_world[0]) - camera_centers(poses[0])))
        deviations.append(found.deviation[0])
    rms = np.sqrt(np.mean(np.square(errors)))
    assert rms < 0.5 * np.sqrt(np.mean(np.square(single)))
    assert 0.7 < rms / np.mean(deviations) < 1.4


def test_deviations_on_photographs_are_larger_by_one_factor_and_probabilities_follow():
    """An error above a limit is as probable as one above the limit over the factor on a map of renders."""
    points = a_room()
    _, looks, _ = looks_from(points, seed=3, noise_px=1.0, n=30)
    rendered, photographed = (
        JointLocalizer(PoseEstimator(points, photographs=photographs)).localize(looks) for photographs in (False, True)
    )
    assert_array_equal(photographed.rig_from_world, rendered.rig_from_world)
    factor = ERRORS_ON_PHOTOGRAPHS
    assert_allclose(photographed.deviation, factor * np.array(rendered.deviation))
    place = rendered.probability(RIGHT_PLACE)
    assert photographed.probability(RIGHT_PLACE) == pytest.approx(place)
    limits = (2 * rendered.deviation[0], 2 * rendered.deviation[1])
    assert photographed.probability(limits) < rendered.probability(limits) < place
    larger = (factor * limits[0], factor * limits[1])
    assert photographed.probability(larger) == pytest.approx(rendered.probability(limits))


def test_one_look_is_localized_exactly_as_a_single_image():
    points = a_room()
    estimator = PoseEstimator(points)
    for seed in range(5):
        _, (look, *_), _ = looks_from(points, seed=seed, outliers=0.6, noise_px=1.0)
        pose, inliers = estimator.estimate(look.pixels, look.rows, CAMERA)
        joint = JointLocalizer(estimator, turn_noise_deg=1.0).localize([look])
        assert_allclose(joint.cams_from_world[0], pose, atol=1e-12)
        assert_array_equal(joint.inliers[0], inliers)


def test_turns_that_are_known_to_a_degree_are_refined():
    points = a_room()
    rng = np.random.default_rng(2)
    errors = []
    ignored = []
    for seed in range(4):
        poses, looks, _ = looks_from(points, seed=seed, noise_px=0.5, outliers=0.3)
        turned = [
            Look(
                np.concatenate([Rotation.from_rotvec(np.radians(rng.normal(0, 1, 3))).as_matrix()
                                @ look.cam_from_rig[:, :3], np.zeros((3, 1))], axis=1),
                look.pixels, look.rows, CAMERA,
            )
            for look in looks
        ]  # fmt: skip
        estimator = PoseEstimator(points)
        known = JointLocalizer(estimator, turn_noise_deg=1.0).localize(turned)
        errors.append(pose_error(known.cams_from_world, poses))
        ignored.append(pose_error(JointLocalizer(estimator).localize(turned).cams_from_world, poses))
    error_m, error_deg = np.max(errors, axis=0)
    assert error_m.max() < 0.02 and error_deg.max() < 0.2
    assert np.median(np.array(ignored)[:, 0]) > 3 * np.median(np.array(errors)[:, 0])


@pytest.mark.parametrize(("apart_m", "error_deg"), [(0.0, 0.0), (0.0, 3.0), (0.8, 0.0), (0.8, 12.0)])
def test_rotations_that_the_images_contradict_are_reported_and_do_no_harm(apart_m, error_deg):
    """The second camera is turned by another angle than stated, and may be apart from the first."""
    points = a_room()
    estimator = PoseEstimator(points)
    turned, other = (
        np.column_stack([Rotation.from_euler("y", angle, degrees=True).as_matrix(), np.zeros(3)]) for angle in (60, -80)
    )
    turned[:, 3] = turned[:, :3] @ (-apart_m, 0, 0)
    stated = Rotation.from_euler("y", error_deg, degrees=True).as_matrix() @ turned
    rig = poses_looking_along([(0.4, -0.7, 0.1)], [(1, 0, 0)])[0]
    poses = [rig, compose_poses(turned, rig), compose_poses(other, rig)]
    for seed in range(5):
        rng = np.random.default_rng(seed)
        looks = [look_at(points, pose, given, rng, noise_px=1.0, outliers=0.4)[0]
                 for pose, given in zip(poses, (np.eye(3, 4), stated, other), strict=True)]  # fmt: skip
        found = JointLocalizer(estimator, 0.2, check_turns=True).localize(looks)
        assert found.status == ("contradicted" if error_deg else "localized")
        assert found.turn_error_deg == pytest.approx(error_deg, abs=0.6)
        error_m, angle = pose_error(found.cams_from_world, poses)
        assert error_m.max() < 0.05 and angle.max() < 0.4


def test_rotations_of_the_wrong_sign_are_reported_and_the_pose_is_uncertain():
    """Yaw to the right instead of to the left: the second view is 180 degrees off, the third 327 of 360."""
    points = a_room()
    _, looks, _ = looks_from(points, noise_px=1.0, outliers=0.4)
    mirrored = [
        Look(np.diag([-1.0, 1, 1]) @ one.cam_from_rig @ np.diag([-1.0, 1, 1, 1]), one.pixels, one.rows, CAMERA)
        for one in looks
    ]
    found = JointLocalizer(PoseEstimator(points), 0.2, check_turns=True).localize(mirrored)
    assert found.turn_error_deg > 90
    assert found.probabilities()[0] < 0.9


def test_views_of_a_small_part_of_the_image_do_not_contradict_rotations():
    """Their own poses are uncertain, about one axis more than about others, and biased by outliers."""
    points = a_room()
    axes = np.array([(1, 0, 0), (0.5, 0.9, 0.1), (-0.5, 0.9, -0.1), (-1, 0, 0.1)])
    localizer = JointLocalizer(PoseEstimator(points))
    contradicted = []
    for seed in range(12):
        _, looks, right = looks_from(points, axes=axes, seed=seed, n=400, noise_px=2.0, outliers=0.3)
        small = []
        for look, is_right in zip(looks, right, strict=True):
            distance = np.linalg.norm(look.pixels - (320, 240), axis=1)
            kept = np.r_[np.flatnonzero(is_right)[np.argsort(distance[is_right])[:30]], np.flatnonzero(~is_right)[:60]]
            small.append(Look(look.cam_from_rig, look.pixels[kept], look.rows[kept], CAMERA))
        poses = [localizer.single_view_poses(look) for look in small]
        contradicted.append(turn_errors(localizer.estimator, small, poses, noise_deg=0.2) != (0.2, 0.0))
    assert sum(contradicted) == 0


def test_wrong_poses_of_views_do_not_contradict_rotations(rng):
    """Matches of the second view are of landmarks at random."""
    points = a_room()
    _, looks, _ = looks_from(points, noise_px=1.0)
    looks[1] = Look(looks[1].cam_from_rig, looks[1].pixels, rng.permutation(looks[1].rows), CAMERA)
    found = JointLocalizer(PoseEstimator(points), 0.2, check_turns=True).localize(looks)
    assert found.turn_error_deg == 0 and found.status == "localized"


def test_invalid_rigs():
    poses, looks, _ = looks_from(a_room())
    poses[1, 0, 3] += 0.01
    for call in (
        lambda: rig_of(poses),  # from two locations
        lambda: Look(2 * looks[0].cam_from_rig, looks[0].pixels, looks[0].rows, CAMERA),
        lambda: Look(looks[0].cam_from_rig, looks[0].pixels[:1], looks[0].rows, CAMERA),
    ):
        with pytest.raises(PoseError):
            call()


# Two rooms alike: the pose with evidence of its own is chosen, though a wrong one has more inliers.

BEYOND = np.array([20.0, 0, 0])


def two_rooms():
    """Points (N, 3) of a room of 8 x 6 x 3 m and its copy 20 m off, and of a column that only the first has.

    Also rows of each: room, copy, column.
    """
    room = a_room(2000)
    column = np.column_stack([np.full((40, 2), (2.0, 0.5)), np.linspace(-1, 1, 40)])
    points = np.concatenate([room, room + BEYOND, column])
    return points, np.split(np.arange(len(points)), [2000, 4000])


def test_unique_support_counts_landmarks_that_the_other_location_lacks():
    points, (room, copy, column) = two_rooms()
    here = poses_looking_along([[0.4, -0.7, 0.1]], [[1.0, 0.4, 0.0]])[0]
    there = poses_looking_along([[20.4, -0.7, 0.1]], [[1.0, 0.4, 0.0]])[0]
    ambiguity = PoseAmbiguity(points)
    assert not ambiguity.unique_supports([room, copy], [here, there]).any()

    def of_column(other):
        return ambiguity.unique_supports([column, column], [here, other])[0, 1]

    # 2 m of the column, in cubes of 0.25 m whose corners lie at multiples of that: the last point is in a ninth
    assert of_column(there) == ambiguity.count_voxels(column) == 9
    # a turn of half a circle: the room is alike, the column is where there is nothing
    turned = poses_looking_along([[-0.4, 0.7, 0.1]], [[-1.0, -0.4, 0.0]])[0]
    assert of_column(turned) == 9
    # 20 cm off a thing is the same thing
    near = poses_looking_along([[0.6, -0.7, 0.1]], [[1.0, 0.4, 0.0]])[0]
    assert of_column(near) == 0


@pytest.mark.parametrize("n_column", [0, 12])
def test_unique_support_outweighs_inliers_that_both_rooms_explain(n_column):
    """Each of three looks matches 60 landmarks of the copy and 30 of the room that it sees. Without the
    column the rooms are indistinguishable and the copy has more inliers; a dozen matches of the column decide."""
    points, (room, _, column) = two_rooms()
    axes = [(1.0, 0.4, 0.0), (0.0, 1.0, 0.2), (-1.0, 0.3, -0.1)]
    poses = poses_looking_along(np.tile((0.4, -0.7, 0.1), (3, 1)), np.array(axes))
    rng = np.random.default_rng(1)
    looks = []
    for number, (pose, cam_from_rig) in enumerate(zip(poses, rig_of(poses), strict=True)):
        rows, pixels = in_view(points[room], pose)
        chosen = rng.choice(len(rows), 90, replace=False)
        landmarks = np.where(np.arange(90) < 60, rows[chosen] + len(room), rows[chosen])
        own, at = in_view(points[column], pose) if number == 0 else (column[:0], np.zeros((0, 2)))
        seen = np.concatenate([pixels[chosen], at[:n_column]])
        looks.append(Look(cam_from_rig, seen, np.concatenate([landmarks, own[:n_column] + column[0]]), CAMERA))
    found = JointLocalizer(PoseEstimator(points)).localize(looks)
    right = poses if n_column else poses_looking_along(np.tile((20.4, -0.7, 0.1), (3, 1)), np.array(axes))
    assert pose_error(found.cams_from_world, right)[0].max() < 1e-3
    assert found.n_inliers == (90 + 12 if n_column else 180)
    assert found.unique_support[1] == 0 and (found.unique_support[0] > 0) == (n_column > 0)
    assert found.rival_support == pytest.approx(180 if n_column else 90, abs=1)


def test_the_pose_with_the_weakest_strongest_rival_is_selected():
    """The second beats the first, the third beats the second, and the first beats the third by far."""
    own = np.array([[0, 10, 50], [14, 0, 12], [12, 14, 0]])
    support = [300.0, 230.0, 33.0]
    assert [strongest_rival(own, support, k) for k in range(3)] == [1, 0, 0]
    assert most_likely(own, support) == 1
    assert most_likely(own[:1, :1], support[:1]) == 0 == most_likely(np.array([[0, 0], [50, 0]]), [300.0, 29.0])
    assert most_likely(np.array([[0, 0], [50, 0]]), [300.0, 31.0]) == 1


# Matching again under a pose finds the landmarks that the pose predicts, and none that it does not.


def twin_rooms(n=1500, seed=0):
    """Two rooms 20 m apart with the same landmarks: points (2n, 3) and descriptors (2n, 128)."""
    room = a_room(n, seed)
    descriptors = np.random.default_rng(seed).integers(0, 90, (n, 128), dtype=np.uint8)
    return np.concatenate([room, room + np.array((20, 0, 0))]), np.concatenate([descriptors, descriptors])


def view_of(points, descriptors, pose, n_matched=12, noise=6, seed=1):
    """A view whose keypoints are landmarks of the first room, of which a few are matched already."""
    rng = np.random.default_rng(seed)
    rows, pixels = in_view(points[: len(points) // 2], pose)
    seen = descriptors[rows] + rng.integers(-noise, noise + 1, (len(rows), 128))
    squared = ((seen[:, None] - descriptors[None].astype(np.int64)) ** 2).sum(2)
    near = np.argsort(squared, axis=1)[:, :5]
    at = pixels + rng.normal(0, 0.5, (len(rows), 2))
    few = np.sort(rng.choice(len(rows), n_matched, replace=False))
    matches = Matches(few, rows[few], near, np.take_along_axis(squared, near, 1).astype(np.float32))
    return Look(
        np.eye(3, 4), at[few] + rng.normal(0, 2, (n_matched, 2)), rows[few], CAMERA, Candidates.of(at, matches)
    ), rows


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


def test_an_estimated_focal_length_near_the_assumed_one_is_that():
    """Landmarks and the lens err alike for many keypoints: by up to some of their standard deviations."""
    prior = FocalPrior((500.0,), (0.0,))
    assert prior.posterior(np.log(505.0), 0.002**2)[0] == np.log(500.0)
    mean, variance = prior.posterior(np.log(600.0), 0.002**2)
    assert mean == np.log(600.0) and variance > 0.004**2


def test_an_assumed_focal_length_that_a_wall_does_not_determine_makes_the_pose_uncertain():
    points = a_room(2000)
    points[:, 0] = 4.0  # a wall, which the camera faces: distance and focal length are exchangeable
    poses, (look,), _ = looks_from(points, axes=((1, 0, 0),), noise_px=0.5)
    localizer = JointLocalizer(PoseEstimator(points, LocalizerConfig(method="hypotheses")))
    known = localizer.localize([look])
    assert known.deviation[0] < 0.02
    for ratio in (0.9, 1.0):
        camera = replace(CAMERA, focal_px=CAMERA.focal_px * ratio)
        assumed = replace(look, camera=camera, focal=FocalPrior((camera.focal_px,), (0.0,)))
        found = localizer.localize([assumed])
        error_m = pose_error(found.rig_from_world, poses[0])[0]
        assert error_m < 3 * found.deviation[0]
        assert found.probabilities()[0] < 0.5
