"""The exported scorer against the one it was exported from, whatever the weights, map, camera and poses."""

from __future__ import annotations

import ast
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import nn

from box_scenes import ROOM, furnished_room
from synthetic_dataset import CAMERA, make_landmarks
from wheretolook.geometry.camera import Camera, ColmapCamera, PinholeCamera
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import Float, camera_centers, invert_poses, poses_looking_along
from wheretolook.inputs.channels import ATTRIBUTES
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.robot import wheretolook_robot
from wheretolook.robot.export import export_robot, pinhole_of
from wheretolook.robot.wheretolook_robot import RobotScorer
from wheretolook.scorers.set.network import ALL_TOLD, TOLD_ONCE, SetNetwork
from wheretolook.space.free_space import FreeSpace
from wheretolook.training.landmark_views import AttributeStatistics
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.training.training_range import TrainingRange
from wheretolook.utils.errors import CameraError, ConfigError, WeightsError
from wheretolook.visibility.occlusion import MeshOcclusion, OcclusionModel
from wheretolook.weights.resolve import load_scorer

pytestmark = pytest.mark.filterwarnings("ignore::wheretolook.utils.errors.OutOfRangeWarning")

RELEASED = Path("data/release/weights/set.safetensors")
SAME = 1e-5  # what scores may differ by

CAMERAS = {
    "paper": PinholeCamera(),
    "narrow, off centre": PinholeCamera(1280, 720, 1400.0, 1380.0, (610.0, 377.5)),
    "wide, upright": PinholeCamera(480, 640, 190.0),
}


def some_poses(n: int, seed: int = 0) -> Float:
    """Poses about the middle of the box of `make_landmarks`, some with roll."""
    rng = np.random.default_rng(seed)
    poses = poses_looking_along(rng.uniform((-2, -2, 0.5), (2, 2, 2), (n, 3)), rng.normal(size=(n, 3)))
    roll = Rotation.from_rotvec(rng.normal(scale=0.3, size=(n, 1)) * (0, 0, 1)).as_matrix()
    return roll @ poses


def walls(n: int, seed: int = 0) -> Landmarks:
    """Landmarks on the walls of a room about the origin, of which some attributes are not known."""
    landmarks = make_landmarks(np.random.default_rng(seed), n)
    assert landmarks.mapping_focal_px is not None
    landmarks.points[:, :2] *= np.random.default_rng(seed).choice([-1, 1], (n, 2))
    landmarks.ambiguity[::3] = np.nan
    landmarks.mapping_distance_spread[::4] = np.nan
    landmarks.mapping_focal_px[::5] = np.nan
    return landmarks


def trained(seed: int, attributes: tuple[str, ...] = ATTRIBUTES, **options: object) -> TrainedNetwork[SetNetwork]:
    """A network with random weights and statistics, as if it had learnt."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    mean = rng.normal(size=len(attributes))
    std = rng.uniform(0.3, 2, len(attributes))
    network = SetNetwork(AttributeStatistics(tuple(mean.tolist()), tuple(std.tolist()), attributes), **options)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm1d):
            module.running_mean.normal_()
            module.running_var.uniform_(1, 4)
            module.weight.data.uniform_(0.3, 1)
            module.bias.data.normal_()
    known = TrainingRange({"distance_m": (1.0, 2.6), "in_view": (20, 300), "across_deg": (30.0, 130.0)})
    return TrainedNetwork("set", network, None, 0.8, -0.3, known)


def without(*names: str) -> tuple[str, ...]:
    return tuple(name for name in ATTRIBUTES if name not in names)


NETWORKS = {
    "as learnt": {"hidden": ("distance", "mapped_distance", "mapped_pixel_size")},
    "told all": {"told": ALL_TOLD, "width": 24, "head": 16},
    "told what older weights are": {"told": TOLD_ONCE},
    "attention": {"pooled": 5, "told": ALL_TOLD, "dropout": 0.5},
    "before pixels": {"attributes": without("pixel_angle", "pixel_size_ratio", "mapped_pixel_size")},
    "in another order": {"attributes": ATTRIBUTES[::-1], "told": ("axis_height", "log_visible", "log_variance_z")},
}


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_scores_are_those_of_pytorch(name: str, camera: Camera, tmp_path: Path) -> None:
    weights = tmp_path / "set.safetensors"
    trained(len(name), **NETWORKS[name]).save(weights)
    localization_map = LocalizationMap(walls(1500, len(name)), camera)
    poses = some_poses(120, len(name))
    scorer = load_scorer(weights, localization_map)
    expected = scorer.score(poses)
    robot = RobotScorer(export_robot(localization_map, weights, tmp_path / "robot"))
    found = robot.views(poses)
    np.testing.assert_allclose(found.score, expected, atol=SAME, rtol=0)
    assert found.score.dtype == np.float64 and np.ptp(expected) > 100 * SAME
    seen = localization_map.landmarks_in_view(poses)
    np.testing.assert_array_equal(found.n_visible, np.diff(seen.starts))
    np.testing.assert_array_equal(found.in_range, scorer.in_range(poses))
    assert 0 < found.in_range.sum() < len(poses)
    one = robot.score(poses[7])
    np.testing.assert_allclose(one, expected[7:8], atol=SAME, rtol=0)


@pytest.mark.parametrize("n", [1, 3, 60, 25_000])
def test_the_weights_that_ship(n: int, tmp_path: Path) -> None:
    """From a map of a single landmark to one where views see more than are looked at, and some see none."""
    localization_map = LocalizationMap(walls(n, n), CAMERAS["wide, upright"])
    poses = some_poses(80, n)
    expected = load_scorer(RELEASED, localization_map).score(poses)
    found = RobotScorer(export_robot(localization_map, RELEASED, tmp_path)).views(poses)
    np.testing.assert_allclose(found.score, expected, atol=SAME, rtol=0)
    assert n < 25_000 or found.n_visible.max() > 2048
    assert n > 100 or found.n_visible.min() == 0


def test_a_camera_right_at_a_wall(tmp_path: Path) -> None:
    """One landmark a few centimetres away tells far more of the position than all others."""
    landmarks = walls(4000, 1)
    localization_map = LocalizationMap(landmarks, PinholeCamera())
    at = landmarks.points[:200]
    poses = poses_looking_along(at * 0.985, at)
    expected = load_scorer(RELEASED, localization_map).score(poses)
    found = RobotScorer(export_robot(localization_map, RELEASED, tmp_path)).score(poses)
    np.testing.assert_allclose(found, expected, atol=SAME, rtol=0)


@pytest.fixture(scope="module")
def room_map() -> LocalizationMap:
    """Landmarks on the walls of a room with a cabinet, which hides some of them."""
    rng = np.random.default_rng(5)
    landmarks = make_landmarks(rng, 600)
    points = rng.uniform((0, 0, 0), ROOM, (600, 3))
    axis = rng.integers(0, 3, 600)
    points[np.arange(600), axis] = np.array(ROOM)[axis] * rng.integers(0, 2, 600)
    space = FreeSpace(furnished_room())
    return LocalizationMap(replace(landmarks, points=points), CAMERA, MeshOcclusion(space.raycaster))


PLACES = np.array([[1.0, 1.0, 1.5], [3.0, 4.0, 1.2], [5.0, 3.0, 1.0]])


def test_what_is_unoccluded_is_that_of_the_nearest_place(room_map: LocalizationMap, tmp_path: Path) -> None:
    scorer = load_scorer(RELEASED, room_map)
    blind = RobotScorer(export_robot(room_map, RELEASED, tmp_path / "blind"))
    robot = RobotScorer(export_robot(room_map, RELEASED, tmp_path / "robot", PLACES, progress=False))
    axes = fibonacci_sphere(60)
    for at in PLACES:
        poses = poses_looking_along(np.tile(at, (60, 1)), axes)
        views = robot.views(poses)
        np.testing.assert_allclose(views.score, scorer.score(poses), atol=SAME, rtol=0)
        np.testing.assert_array_equal(views.n_visible, np.diff(room_map.landmarks_in_view(poses).starts))
        assert np.abs(views.place_m).max() < 1e-9
        through = blind.views(poses)
        assert np.isnan(through.place_m).all() and through.n_visible.sum() > views.n_visible.sum() + 50
        # a robot that knows by itself what is free
        free = room_map.occlusion.unoccluded(at[None], room_map.landmarks.points)[0]
        np.testing.assert_array_equal(blind.views(poses, free).score, views.score)
    beside = robot.views(poses_looking_along(PLACES[1] + (0.3, 0, -0.4), (0, 1, 0)))
    np.testing.assert_allclose(beside.place_m, 0.5)
    n_free = room_map.occlusion.unoccluded(PLACES[1:2], room_map.landmarks.points)[0]
    np.testing.assert_array_equal(
        beside.score, blind.score(poses_looking_along(PLACES[1] + (0.3, 0, -0.4), (0, 1, 0)), n_free)
    )


def test_the_best_view_at_a_place(room_map: LocalizationMap, tmp_path: Path) -> None:
    robot = RobotScorer(export_robot(room_map, RELEASED, tmp_path, PLACES, progress=False))
    axes = fibonacci_sphere(200)
    scores = load_scorer(RELEASED, room_map).score(poses_looking_along(np.tile(PLACES[0], (200, 1)), axes))
    view = robot.best(PLACES[0], directions=200)
    np.testing.assert_allclose(view.direction, axes[scores.argmax()], atol=1e-12)
    assert abs(view.score - scores.max()) < SAME
    np.testing.assert_allclose(view.cam_from_world, poses_looking_along(PLACES[0], view.direction), atol=1e-12)
    np.testing.assert_allclose(robot.score(view.cam_from_world), view.score, atol=1e-9)
    np.testing.assert_allclose(
        Rotation.from_quat(view.quaternion_xyzw).as_matrix(), invert_poses(view.cam_from_world)[:, :3], atol=1e-12
    )
    assert 0 < view.expected_inliers <= view.n_visible and view.place_m < 1e-9
    level = np.abs(np.degrees(np.arcsin(axes[:, 2]))) <= 10
    chosen = robot.best(PLACES[0], directions=axes, pitch_deg=(-10, 10))
    np.testing.assert_allclose(chosen.direction, axes[level][scores[level].argmax()], atol=1e-12)
    with pytest.raises(ValueError, match="no direction"):
        robot.best(PLACES[0], directions=[(0, 0, 2.0)], pitch_deg=(-10, 10))
    with pytest.raises(ValueError, match="three finite numbers"):
        robot.best((0.0, np.nan, 1.0))


def test_poses_and_quaternions() -> None:
    turns = Rotation.random(200, random_state=0)
    turns = Rotation.concatenate(
        [turns, Rotation.from_quat(np.eye(4)), Rotation.from_euler("z", [[180], [179.99]], True)]
    )
    for turn in turns:
        quaternion = wheretolook_robot.quaternion_xyzw(turn.as_matrix())
        np.testing.assert_allclose(quaternion, turn.as_quat(canonical=True), atol=1e-9)
        pose = wheretolook_robot.cam_from_world_of((1, 2, 3), 2 * quaternion)
        np.testing.assert_allclose(pose[:, :3], turn.as_matrix().T, atol=1e-9)
        np.testing.assert_allclose(camera_centers(pose), (1, 2, 3), atol=1e-9)
    np.testing.assert_allclose(wheretolook_robot.fibonacci_sphere(77), fibonacci_sphere(77), atol=1e-12)
    along = [*fibonacci_sphere(50), (0, 0, 1), (0, 0, -3)]
    expected = poses_looking_along(np.zeros((52, 3)), along)[:, :, :3]
    np.testing.assert_allclose(wheretolook_robot.rotations_looking_along(along), expected, atol=1e-12)


def test_no_pose_and_poses_that_are_none(room_map: LocalizationMap, tmp_path: Path) -> None:
    robot = RobotScorer(export_robot(room_map, RELEASED, tmp_path))
    assert robot.score(np.empty((0, 3, 4))).shape == (0,)
    with pytest.raises(ValueError, match="cam_from_world"):
        robot.score(np.eye(4))
    with pytest.raises(ValueError, match="cam_from_world"):
        robot.score(np.full((1, 3, 4), np.nan))
    with pytest.raises(ValueError, match="one bool for each landmark"):
        robot.score(some_poses(1), np.ones(7, bool))


WITHOUT_PYTORCH = """
import sys
sys.modules.update(dict.fromkeys(("torch", "warp", "scipy", "onnx", "wheretolook"), None))  # importing these fails
import numpy as np
from wheretolook_robot import RobotScorer
np.save("scores.npy", RobotScorer(".").score(np.load("poses.npy")))
"""


def test_the_folder_runs_by_itself(room_map: LocalizationMap, tmp_path: Path) -> None:
    folder = export_robot(room_map, RELEASED, tmp_path / "robot", PLACES, progress=False)
    assert {path.name for path in folder.iterdir()} == {
        "landmarks.npz", "robot.json", "scorer.onnx", "wheretolook_robot.py"
    }  # fmt: skip
    poses = some_poses(5)
    np.save(folder / "poses.npy", poses)
    subprocess.run([sys.executable, "-c", WITHOUT_PYTORCH], cwd=folder, check=True)
    np.testing.assert_array_equal(np.load(folder / "scores.npy"), RobotScorer(folder).score(poses))


def test_the_one_file_imports_numpy_and_onnxruntime_only() -> None:
    tree = ast.parse(Path(wheretolook_robot.__file__).read_text())
    modules = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    modules |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    others = {module.partition(".")[0] for module in modules} - {*sys.stdlib_module_names}
    assert others == {"numpy", "onnxruntime"}


def test_a_damaged_folder_is_refused(room_map: LocalizationMap, tmp_path: Path) -> None:
    folder = export_robot(room_map, RELEASED, tmp_path / "robot")
    other = export_robot(LocalizationMap(walls(50), CAMERA), RELEASED, tmp_path / "other")
    shutil.copy(other / "landmarks.npz", folder)
    with pytest.raises(ValueError, match=r"landmarks\.npz: not the landmarks"):
        RobotScorer(folder)
    (other / "scorer.onnx").unlink()
    with pytest.raises(FileNotFoundError, match=r"scorer\.onnx"):
        RobotScorer(other)
    about = (folder / "robot.json").read_text()
    (folder / "robot.json").write_text(about.replace('"format_version": 1', '"format_version": 9'))
    with pytest.raises(ValueError, match="reads format 1"):
        RobotScorer(folder)


def test_cameras_that_are_no_pinhole(room_map: LocalizationMap, tmp_path: Path) -> None:
    opencv = ColmapCamera("OPENCV", 160, 120, (80.0, 81.0, 79.0, 60.5, -0.1, 0.01, 1e-3, -1e-3))
    assert pinhole_of(opencv) == PinholeCamera(160, 120, 80.0, 81.0, (79.0, 60.5))
    radial = ColmapCamera("SIMPLE_RADIAL", 160, 120, (80.0, 79.0, 60.5, -0.1))
    assert pinhole_of(radial) == PinholeCamera(160, 120, 80.0, center_px=(79.0, 60.5))
    with pytest.raises(CameraError, match="no pinhole of its own"):
        pinhole_of(ColmapCamera("OPENCV_FISHEYE", 160, 120, (80.0, 80.0, 80.0, 60.0, 0.0, 0.0, 0.0, 0.0)))
    with pytest.raises(CameraError, match="must be a pinhole"):
        export_robot(room_map.of_camera(opencv), RELEASED, tmp_path)


def test_weights_of_another_method_are_refused(room_map: LocalizationMap, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="not of set"):
        export_robot(room_map, RELEASED.with_name("matchability.safetensors"), tmp_path)


def test_a_custom_occlusion_is_asked_in_blocks(tmp_path: Path) -> None:
    class Halves(OcclusionModel):
        """East of the origin only the even landmarks are free, west of it the odd ones."""

        def unoccluded(self, locations: Float, points: Float) -> np.ndarray:
            return (np.arange(len(points)) % 2 == 0) == (np.asarray(locations)[:, :1] > 0)

    localization_map = LocalizationMap(walls(301), CAMERA, Halves())
    places = np.random.default_rng(0).uniform(-1, 1, (200, 3))
    robot = RobotScorer(export_robot(localization_map, RELEASED, tmp_path, places, progress=False))
    poses = poses_looking_along(places, np.tile((1.0, 0.5, 0), (200, 1)))
    expected = np.diff(localization_map.landmarks_in_view(poses).starts)
    np.testing.assert_array_equal(robot.views(poses).n_visible, expected)


def test_without_onnx_it_is_said_what_to_install(
    room_map: LocalizationMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ConfigError, match=r"needs the package onnx.*wheretolook\[robot\]"):
        export_robot(room_map, RELEASED, tmp_path)
