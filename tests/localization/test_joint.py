"""Joint localization recovers known poses in spite of outliers, noise, and similar rooms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.geometry.poses import camera_centers, compose_poses, pose_error, poses_looking_along
from wheretolook.localization.confidence import probabilities
from wheretolook.localization.estimation import PoseEstimator, turn_errors
from wheretolook.localization.rig import Look, rig_of
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


def look_at(points, cam_from_world, cam_from_rig, rng, n=80, noise_px=0.0, outliers=0.0, camera=CAMERA):
    """A look's matches with so many points in its image, some with wrong landmarks; (Look, right matches)."""
    there = points @ cam_from_world[:, :3].T + cam_from_world[:, 3]
    pixels = camera.project(there)
    rows = np.flatnonzero((there[:, 2] > 0.1) & camera.in_image(pixels))
    rows = rng.choice(rows, min(n, len(rows)), replace=False)
    seen = pixels[rows] + rng.normal(0, noise_px, (len(rows), 2))
    wrong = rng.random(len(rows)) < outliers
    matched = np.where(wrong, rng.integers(0, len(points), len(rows)), rows)
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
    poses = np.stack([
        np.concatenate([m[:, :3] @ rig[:, :3], (m[:, :3] @ rig[:, 3] + m[:, 3])[:, None]], axis=1) for m in cams_from_rig
    ])  # fmt: skip
    cameras = (CAMERA, CAMERA, other)
    looks = [
        look_at(points, pose, m, rng, camera=c)[0] for pose, m, c in zip(poses, cams_from_rig, cameras, strict=True)
    ]
    found = JointLocalizer(PoseEstimator(points)).localize(looks)
    np.testing.assert_allclose(found.cams_from_world, poses, atol=1e-5)


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


def test_one_look_is_localized_exactly_as_a_single_image():
    points = a_room()
    estimator = PoseEstimator(points)
    for seed in range(5):
        _, (look, *_), _ = looks_from(points, seed=seed, outliers=0.6, noise_px=1.0)
        pose, inliers = estimator.estimate(look.pixels, look.rows, CAMERA)
        joint = JointLocalizer(estimator, turn_noise_deg=1.0).localize([look])
        np.testing.assert_allclose(joint.cams_from_world[0], pose, atol=1e-12)
        np.testing.assert_array_equal(joint.inliers[0], inliers)


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


@pytest.mark.parametrize(("error_deg", "contradicted"), [(0.0, False), (3.0, True)])
def test_rotations_that_the_images_contradict_are_reported_and_do_no_harm(error_deg, contradicted):
    """The second view is turned by another angle than stated; the third as stated."""
    points = a_room()
    estimator = PoseEstimator(points)
    for seed in range(5):
        poses, looks, _ = looks_from(points, seed=seed, noise_px=1.0, outliers=0.4)
        wrong = Rotation.from_rotvec(np.radians([0.0, error_deg, 0.0])).as_matrix() @ looks[1].cam_from_rig
        looks[1] = Look(wrong, looks[1].pixels, looks[1].rows, CAMERA)
        found = JointLocalizer(estimator, 0.2, check_turns=True).localize(looks)
        assert found.status == ("contradicted" if contradicted else "localized")
        assert found.turn_error_deg == pytest.approx(error_deg, abs=0.4)
        error_m, angle = pose_error(found.cams_from_world, poses)
        assert error_m.max() < 0.05 and angle.max() < 0.4
        if contradicted:
            believed = JointLocalizer(estimator, 0.2).localize(looks)
            assert pose_error(believed.cams_from_world, poses)[1].max() > 1


@pytest.mark.parametrize(("error_deg", "contradicted"), [(0.0, False), (12.0, True)])
def test_rotations_of_cameras_that_are_apart_are_compared(error_deg, contradicted):
    """With 0.8 m between the first and the second camera, the error moves the location of the other by 17 cm."""
    points = a_room()
    for seed in range(5):
        rng = np.random.default_rng(seed)
        cams_from_rig = [np.eye(3, 4), np.eye(3, 4)]
        cams_from_rig[1][:, :3] = Rotation.from_euler("y", 60, degrees=True).as_matrix()
        cams_from_rig[1][:, 3] = cams_from_rig[1][:, :3] @ (-0.8, 0, 0)
        rig = poses_looking_along([(0.4, -0.7, 0.1)], [(1, 0, 0)])[0]
        poses = [compose_poses(pose, rig) for pose in cams_from_rig]
        made = [look_at(points, pose, given, rng, noise_px=1.0, outliers=0.4)[0]
                for pose, given in zip(poses, cams_from_rig, strict=True)]  # fmt: skip
        wrong = Rotation.from_euler("y", error_deg, degrees=True).as_matrix() @ made[1].cam_from_rig
        looks = [made[0], Look(wrong, made[1].pixels, made[1].rows, CAMERA)]
        found = JointLocalizer(PoseEstimator(points), 0.2, check_turns=True).localize(looks)
        assert found.status == ("contradicted" if contradicted else "localized")
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
    assert probabilities(found)[0] < 0.9


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


def test_wrong_poses_of_views_do_not_contradict_rotations():
    """Matches of the second view are of landmarks at random."""
    points = a_room()
    _, looks, _ = looks_from(points, noise_px=1.0)
    rng = np.random.default_rng(0)
    looks[1] = Look(looks[1].cam_from_rig, looks[1].pixels, rng.permutation(looks[1].rows), CAMERA)
    found = JointLocalizer(PoseEstimator(points), 0.2, check_turns=True).localize(looks)
    assert found.turn_error_deg == 0 and found.status == "localized"


def test_a_map_in_national_coordinates_gives_the_same():
    points = a_room()
    far = np.array([4_512_300.0, 5_402_100.0, 300.0])
    _, looks, _ = looks_from(points, outliers=0.3, noise_px=0.5)
    near = JointLocalizer(PoseEstimator(points)).localize(looks)
    away = JointLocalizer(PoseEstimator(points + far)).localize(looks)
    centers = camera_centers(away.cams_from_world) - far
    np.testing.assert_allclose(centers, camera_centers(near.cams_from_world), atol=1e-5)
    assert away.n_inliers == near.n_inliers


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
