"""The exported folder localizes without PyTorch, at the pose of the product's localizer."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from synthetic_dataset import CAMERA, make_landmarks
from wheretolook import load_scorer
from wheretolook.features.extractor import ExtractorConfig, Keypoints, quantize_descriptors
from wheretolook.features.matches import match
from wheretolook.features.matching import DescriptorMatcher
from wheretolook.features.sift import OpenCvSift
from wheretolook.geometry.lattices import direction_lattice
from wheretolook.geometry.poses import camera_centers, pose_error, poses_looking_along, transform
from wheretolook.geometry.similarity import Similarity, local_origin
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.localizer import Localizer
from wheretolook.localization.rig import Look
from wheretolook.looks.next_look import N_DIRECTIONS, NextLookSelector, mean_scores_by_pitch
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.map import Map
from wheretolook.mapping.map_frame import MapFrame
from wheretolook.robot.export import export_localizer, export_robot
from wheretolook.robot.localizer import ImageSequence, RobotLocalizer
from wheretolook.robot.wheretolook_robot import RobotScorer, description_digest
from wheretolook.scorers.base import Scorer
from wheretolook.utils.errors import ConfigError, MapError
from wheretolook.utils.package import shipped

BUNDLED = shipped("data/release/weights/set.safetensors")
POSES = poses_looking_along([(-0.5, 0.3, 1.2)] * 2, [(1, 0.2, 0), (0.3, 1, 0)])
PLACES = [(-0.5, 0.3, 1.2), (0.4, -0.6, 1.5), (0.8, 0.8, 1.0)]
RUN = """
import sys
blocked = ("torch", "warp", "onnx", "pycolmap", "pandas", "cv2", "psutil", "yaml", "wheretolook")
sys.modules.update(dict.fromkeys(blocked, None))  # importing these fails
import numpy as np
from wheretolook_localization import RobotLocalizer
from wheretolook_robot import RobotScorer
views = np.load("views.npz")
localizer = RobotLocalizer(".")
result = localizer.localize([localizer.match(views["pixels"], views["descriptors"])])
np.save("pose.npy", result.poses[0].cam_from_world)
np.save("next.npy", localizer.next_look(result, RobotScorer(".")).cam_from_rig)
"""


@dataclass
class ByPose:
    """A scorer that samples the landmarks of each view as the robot does."""

    scorer: Scorer

    def score_directions(self, locations, directions):
        return Scorer.score_and_count(self.scorer, locations, directions)[0]


def described():
    rng = np.random.default_rng(0)
    unit = rng.exponential(size=(1200, 128))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    return replace(make_landmarks(rng, 1200), descriptors=np.round(512 * unit).clip(0, 255).astype(np.uint8))


def view_of(landmarks, pose):
    """Keypoints at the landmarks of a view, with half a pixel of noise."""
    rng = np.random.default_rng(1)
    in_camera = transform(pose, landmarks.points)
    pixels = CAMERA.project(np.where(in_camera[:, 2:] > 0.1, in_camera, (0, 0, 1)))
    rows = np.flatnonzero((in_camera[:, 2] > 0.1) & CAMERA.in_image(pixels))
    noise = rng.integers(-5, 6, (len(rows), 128))
    seen = (landmarks.descriptors[rows].astype(int) + noise).clip(0, 255).astype(np.uint8)
    return pixels[rows] + rng.normal(0, 0.5, (len(rows), 2)), seen


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("robot")
    source = LocalizationMap(Map(described()), CAMERA)
    export_localizer(described(), described().ids, mean_scores_by_pitch(load_scorer(source), PLACES), out)
    return export_robot(source, BUNDLED, out)


def test_poses_are_those_of_the_localizer(folder):
    landmarks = described()
    robot = RobotLocalizer(folder)
    matcher = DescriptorMatcher(landmarks.descriptors)
    localizer = Localizer(landmarks, CAMERA, LocalizerConfig(method="hypotheses"))
    views = [view_of(landmarks, pose) for pose in POSES]
    for (pixels, descriptors), pose in zip(views, POSES, strict=True):
        for own, expected in zip(robot.nearest(descriptors), matcher.nearest(descriptors, 16), strict=True):
            np.testing.assert_array_equal(own[:, 0], expected[:, 0])
        result = robot.localize([robot.match(pixels, descriptors)])
        best = result.poses[0]
        assert pose_error(best.cam_from_world, pose)[0] < 0.05
        look = Look.of(Keypoints(pixels, descriptors).pixels, match(matcher, [descriptors], 0.85, 16)[0], CAMERA)
        expected = localizer.joint.localize([look])
        np.testing.assert_allclose(best.cam_from_world, expected.rig_from_world, atol=1e-6)
        np.testing.assert_allclose(best.covariance, expected.covariance, rtol=1e-3)
        assert result.joint.missing == pytest.approx(expected.missing, abs=1e-3)
        assert result.probability == pytest.approx(expected.probability(), abs=1e-3)
    rig = robot.localize([robot.match(*view) for view in views], POSES[:, :, :3] @ POSES[0, :, :3].T)
    assert pose_error(rig.poses[0].cam_from_world, POSES[0])[0] < 0.02
    assert rig.probability == rig.poses[0].probability > 0.9


def test_the_next_look_is_that_of_the_selector(folder):
    scorer = load_scorer(LocalizationMap(Map(described()), CAMERA))
    selector = NextLookSelector(ByPose(scorer), mean_scores_by_pitch(scorer, PLACES))
    localizer = RobotLocalizer(folder)
    robot_scorer = RobotScorer(folder)
    axes = direction_lattice(40)
    scores = ByPose(scorer).score_directions(np.asarray(PLACES), axes)
    np.testing.assert_allclose(robot_scorer.score_directions(PLACES, axes), scores, atol=1e-5)
    for n_keypoints in (6, 400):  # of too few matches, and of a certain pose
        pixels, descriptors = view_of(described(), POSES[0])
        result = localizer.localize([localizer.match(pixels[:n_keypoints], descriptors[:n_keypoints])])
        for limits in ((-45.0, 45.0), (-10.0, 10.0)):
            chosen = localizer.next_look(result, robot_scorer, limits, (-120, 120))
            expected = selector.select(result.joint, None, limits, (-120, 120))
            np.testing.assert_allclose(chosen.cam_from_rig, expected.cam_from_rig, atol=1e-6)
            assert chosen.pan_deg == pytest.approx(expected.pan_deg) and limits[0] <= chosen.pitch_deg <= limits[1]
            assert chosen.gain == pytest.approx(expected.gain, abs=1e-5)


def test_a_map_that_repeats_has_two_places_and_a_prior_adds_one(tmp_path):
    """A map repeats 30 m away with the same descriptors, which Lowe's ratio must not compare with one another."""
    one = described()
    columns = {name: np.concatenate([v, v]) for name, v in vars(one).items() if isinstance(v, np.ndarray)}
    columns["points"][len(one) :] += (30.0, 0, 0)
    twice = Landmarks(**columns | {"ids": np.arange(2 * len(one))})
    export_localizer(twice, twice.ids, np.zeros(N_DIRECTIONS), tmp_path)
    export_robot(LocalizationMap(Map(twice), CAMERA), BUNDLED, tmp_path)
    robot = RobotLocalizer(tmp_path)
    view = view_of(one, POSES[0])
    found = robot.localize([robot.match(*view)]).poses
    centers = np.array([camera_centers(pose.cam_from_world) for pose in found])
    for x in (-0.5, 29.5):
        assert np.abs(centers - (x, 0.3, 1.2)).max(1).min() < 0.05
    assert max(pose.probability for pose in found) < 0.6
    for prior, x in (((0.0, 0.0, 1.2), -0.5), ((30.0, 0.5, 1.2, 15.0), 29.5)):
        center = camera_centers(robot.match(*view, prior=prior).near_prior[0][0]) + local_origin(twice.points)
        np.testing.assert_allclose(center, (x, 0.3, 1.2), atol=0.05)


def test_the_folder_runs_by_itself(folder):
    pixels, descriptors = view_of(described(), POSES[0])
    np.savez(folder / "views.npz", pixels=pixels, descriptors=descriptors)
    subprocess.run([sys.executable, "-c", RUN], cwd=folder, check=True)
    localizer = RobotLocalizer(folder)
    expected = localizer.localize([localizer.match(pixels, descriptors)])
    np.testing.assert_allclose(np.load(folder / "pose.npy"), expected.poses[0].cam_from_world, atol=1e-12)
    chosen = localizer.next_look(expected, RobotScorer(folder))
    np.testing.assert_allclose(np.load(folder / "next.npy"), chosen.cam_from_rig, atol=1e-9)


def test_keypoints_are_those_of_the_extractor(folder):
    rng = np.random.default_rng(0)
    grey = cv2.GaussianBlur(rng.integers(0, 256, (CAMERA.height, CAMERA.width), np.uint8), (0, 0), 3)
    grey = cv2.normalize(grey, None, 0, 255, cv2.NORM_MINMAX)
    (expected,) = OpenCvSift(ExtractorConfig(), "cpu").extract_batch([np.repeat(grey[:, :, None], 3, axis=2)])
    pixels, descriptors = RobotLocalizer(folder).extract(grey)
    assert len(pixels) > 50
    np.testing.assert_array_equal(pixels, expected.pixels)
    np.testing.assert_array_equal(descriptors, quantize_descriptors(expected.descriptors))
    double = cv2.resize(grey, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    np.testing.assert_allclose(RobotLocalizer(folder).extract(double)[0], 2 * pixels, atol=1e-3)


def test_poses_are_in_the_frame_of_the_map(tmp_path):
    landmarks = described()
    frame = Similarity(2.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2.0, 3.0]))
    export_localizer(landmarks, landmarks.ids, np.zeros(N_DIRECTIONS), tmp_path)
    there = replace(LocalizationMap(Map(landmarks), CAMERA).frame, world_from_map=frame)
    assert isinstance(there, MapFrame)
    export_robot(LocalizationMap(Map(landmarks, frame=there), CAMERA), BUNDLED, tmp_path)
    robot = RobotLocalizer(tmp_path)
    result = robot.localize([robot.match(*view_of(landmarks, POSES[0]))])
    expected = frame.inverse.apply_to_poses(POSES[:1])[0]
    np.testing.assert_allclose(result.poses[0].cam_from_world, expected, atol=0.05)
    own = result.joint.covariance  # in the world, whose y axis is the map's x axis
    assert result.poses[0].covariance[0, 0] == pytest.approx(own[1, 1] / 4)
    assert result.poses[0].covariance[3, 1] == pytest.approx(-own[4, 0] / 2)


@pytest.mark.parametrize(("error_deg", "max_views"), [(0.0, 2), (5.0, 2), (0.0, 1)])
def test_odometry_whose_rotation_the_images_contradict_is_reported(folder, error_deg, max_views):
    """A confidence that no image reaches keeps all views in the rig, at most `max_views`."""
    robot = RobotLocalizer(folder)
    sequence = ImageSequence(robot, max_views=max_views)
    sequence.confidence = 2.0
    turn = Rotation.from_euler("y", error_deg, degrees=True).as_matrix()
    odometry = [POSES[0], turn @ POSES[1]]
    views = [robot.match(*view_of(described(), pose)) for pose in POSES]
    first, second = (sequence.add(view, pose) for view, pose in zip(views, odometry, strict=True))
    assert (first.n_views, second.n_views) == (1, max_views) and first.contradiction == ""
    assert ("odometry contradicts the images by" in second.contradiction) == (error_deg > 0)
    assert second.localization.status == ("contradicted" if error_deg else "localized")


def test_invalid_input_is_rejected(folder, tmp_path):
    robot = RobotLocalizer(folder)
    view = view_of(described(), POSES[0])
    nothing = robot.localize([robot.match(np.zeros((0, 2)), np.zeros((0, 128), np.uint8))])
    assert nothing.poses == () and nothing.probability == 0 and nothing.joint.status == "too_few_matches"
    matched = robot.match(*view)
    nan = np.full((2, 3, 3), np.nan)
    for views, turns in [
        (2, None),
        (0, None),
        (1, np.eye(3)),
        (0, np.zeros((0, 3, 3))),
        (2, nan),
        (2, [np.eye(3), [1]]),
    ]:
        with pytest.raises(ValueError):
            robot.localize(views * [matched], turns)
    for prior in ((1, 2), "abc", (1, 2, np.nan)):
        with pytest.raises(ConfigError, match="prior"):
            robot.match(*view, prior=prior)
    for pixels, descriptors in [(0, 0), (view[0] * np.nan, view[1]), (view[0], view[1].astype(float))]:
        with pytest.raises(ValueError):
            robot.match(pixels, descriptors)
    for image in (np.zeros((8, 8, 3), np.uint8), np.zeros((8, 8)), np.zeros((0, 8), np.uint8)):
        with pytest.raises(ValueError, match="grey"):
            robot.extract(image)
    for accuracy in ((0.0, 0.0), (np.nan, 0.4)):
        with pytest.raises(ConfigError, match="two positive limits"):
            robot.localize([matched], accuracy=accuracy)
    for confidence, max_views in ((0.0, 4), (2.0, 4), (np.nan, 4), (0.95, 0)):
        with pytest.raises(ConfigError):
            ImageSequence(robot, confidence, max_views=max_views)
    with pytest.raises(ValueError):
        robot.match(view[0][1:], view[1])
    with pytest.raises(MapError):
        export_localizer(replace(described(), descriptors=None), described().ids, np.zeros(N_DIRECTIONS), tmp_path)


def test_a_folder_of_another_version_is_rejected(folder, tmp_path):
    old = shutil.copytree(folder, tmp_path / "old")
    (old / "mean_scores.npy").unlink()
    with pytest.raises(FileNotFoundError, match=r"mean_scores.*Export again"):
        RobotLocalizer(old)
    about = json.loads((old / "robot.json").read_text())
    del about["calibration"], about["sha256"]
    about["files"] = {name: digest for name, digest in about["files"].items() if name != "mean_scores.npy"}
    (old / "robot.json").write_text(json.dumps(about | {"sha256": description_digest(about)}))
    with pytest.raises(ValueError, match="without calibration"):
        RobotLocalizer(old)
    (old / "robot.json").write_text(json.dumps(about | {"format_version": 0}))
    with pytest.raises(ValueError, match=r"reads format 2\. Export again"):
        RobotLocalizer(old)
