"""The exported folder localizes without PyTorch, at the pose of the product's localizer."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from synthetic_dataset import CAMERA, make_landmarks
from wheretolook.features.keypoints import Keypoints
from wheretolook.features.matching import DescriptorMatcher, match
from wheretolook.geometry.poses import Float, pose_error, poses_looking_along, transform
from wheretolook.geometry.similarity import Similarity
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.localizer import Localizer
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.map_frame import MapFrame
from wheretolook.robot.export import export_robot
from wheretolook.robot.localizer import RobotLocalizer
from wheretolook.robot.localizer_export import export_localizer
from wheretolook.utils.errors import MapError

BUNDLED = Path("data/release/weights/set.safetensors")
POSES = poses_looking_along([(-0.5, 0.3, 1.2)] * 2, [(1, 0.2, 0), (0.3, 1, 0)])
RUN = """
import sys
blocked = ("torch", "warp", "onnx", "onnxruntime", "pycolmap", "pandas", "cv2", "wheretolook")
sys.modules.update(dict.fromkeys(blocked, None))  # importing these fails
import numpy as np
from wheretolook_localization import RobotLocalizer
views = np.load("views.npz")
np.save("pose.npy", RobotLocalizer(".").localize([(views["pixels"], views["descriptors"])])[0].cam_from_world)
"""


def described() -> Landmarks:
    rng = np.random.default_rng(0)
    unit = rng.exponential(size=(1200, 128))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    return replace(make_landmarks(rng, 1200), descriptors=np.round(512 * unit).clip(0, 255).astype(np.uint8))


def view_of(landmarks: Landmarks, pose: Float) -> tuple[np.ndarray, np.ndarray]:
    """Keypoints at the landmarks of a view, with half a pixel of noise."""
    assert landmarks.descriptors is not None
    rng = np.random.default_rng(1)
    in_camera = transform(pose, landmarks.points)
    pixels = CAMERA.project(np.where(in_camera[:, 2:] > 0.1, in_camera, (0, 0, 1)))
    rows = np.flatnonzero((in_camera[:, 2] > 0.1) & CAMERA.in_image(pixels))
    noise = rng.integers(-5, 6, (len(rows), 128))
    seen = (landmarks.descriptors[rows].astype(int) + noise).clip(0, 255).astype(np.uint8)
    return pixels[rows] + rng.normal(0, 0.5, (len(rows), 2)), seen


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("robot")
    export_localizer(described(), described().ids, out)
    return export_robot(LocalizationMap(described(), CAMERA), BUNDLED, out)


def test_poses_are_those_of_the_localizer(folder: Path) -> None:
    landmarks = described()
    robot = RobotLocalizer(folder)
    views = [view_of(landmarks, pose) for pose in POSES]
    assert landmarks.descriptors is not None
    matcher = DescriptorMatcher(landmarks.descriptors)
    localizer = Localizer(landmarks, CAMERA, LocalizerConfig(method="hypotheses"))
    looks = []
    for pixels, descriptors in views:
        near, squared = matcher.nearest(descriptors, 16)
        own_near, own_squared = robot.nearest(descriptors)
        np.testing.assert_array_equal(own_squared, squared)
        np.testing.assert_array_equal(own_near[:, 0], near[:, 0])
        keypoints = Keypoints(pixels, descriptors)
        looks.append(localizer.look(keypoints, match(matcher, [descriptors], 0.85, 16)[0]))
    for view, look, pose in zip(views, looks, POSES, strict=True):
        best = robot.localize([view])[0]
        assert pose_error(best.cam_from_world, pose)[0] < 0.05
        expected = localizer.joint.localize([look]).rig_from_world
        assert expected is not None
        np.testing.assert_allclose(best.cam_from_world, expected, atol=1e-6)
    turns = POSES[:, :, :3] @ POSES[0, :, :3].T
    assert pose_error(robot.localize(views, turns)[0].cam_from_world, POSES[0])[0] < 0.02


def test_the_folder_runs_by_itself(folder: Path) -> None:
    pixels, descriptors = view_of(described(), POSES[0])
    np.savez(folder / "views.npz", pixels=pixels, descriptors=descriptors)
    subprocess.run([sys.executable, "-c", RUN], cwd=folder, check=True)
    expected = RobotLocalizer(folder).localize([(pixels, descriptors)])[0].cam_from_world
    np.testing.assert_allclose(np.load(folder / "pose.npy"), expected, atol=1e-12)


def test_poses_are_in_the_frame_of_the_map(tmp_path: Path) -> None:
    landmarks = described()
    frame = Similarity(2.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2.0, 3.0]))
    export_localizer(landmarks, landmarks.ids, tmp_path)
    there = replace(LocalizationMap(landmarks, CAMERA).frame, world_from_map=frame)
    assert isinstance(there, MapFrame)
    export_robot(LocalizationMap(landmarks, CAMERA, frame=there), BUNDLED, tmp_path)
    pose = RobotLocalizer(tmp_path).localize([view_of(landmarks, POSES[0])])[0].cam_from_world
    expected = frame.inverse.apply_to_poses(POSES[:1])[0]
    np.testing.assert_allclose(pose, expected, atol=0.05)


def test_invalid_input_is_rejected(folder: Path, tmp_path: Path) -> None:
    robot = RobotLocalizer(folder)
    view = view_of(described(), POSES[0])
    assert robot.localize([(np.zeros((0, 2)), np.zeros((0, 128), np.uint8))]) == []
    for views, turns in [([view, view], None), ([], None), ([view], np.eye(3)), ([(view[0][1:], view[1])], None)]:
        with pytest.raises(ValueError):
            robot.localize(views, turns)
    with pytest.raises(MapError):
        export_localizer(replace(described(), descriptors=None), described().ids, tmp_path)
