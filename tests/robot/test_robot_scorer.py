"""The exported scorer equals the PyTorch scorer for any weights, map, camera and poses."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import nn

from box_scenes import ROOM, furnished_room
from synthetic_dataset import CAMERA, make_landmarks
from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import invert_poses, poses_looking_along
from wheretolook.inputs.channels import ATTRIBUTES
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.inputs.statistics import FeatureStatistics
from wheretolook.mapping.landmarks import MAP_ATTRIBUTES
from wheretolook.mapping.map import Map
from wheretolook.robot import wheretolook_robot
from wheretolook.robot.export import export_robot, pinhole_of
from wheretolook.robot.wheretolook_robot import RobotScorer, description_digest, file_digest
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.scorers.weights import load_scorer
from wheretolook.space.free_space import FreeSpace
from wheretolook.training.trained_network import TrainedNetwork, TrainingRange
from wheretolook.utils.errors import CameraError, WeightsError
from wheretolook.utils.package import shipped
from wheretolook.visibility.occlusion import MeshOcclusion

pytestmark = pytest.mark.filterwarnings("ignore::wheretolook.utils.errors.OutOfRangeWarning")

BUNDLED = shipped("data/release/weights/set.safetensors")
TOLERANCE = 1e-5  # of scores
PLACES = np.array([[1.0, 1.0, 1.5], [3.0, 4.0, 1.2], [5.0, 3.0, 1.0]])
CAMERAS = {
    "paper": PinholeCamera(),
    "narrow, off centre": PinholeCamera(1280, 720, 1400.0, 1380.0, (610.0, 377.5)),
    "wide, upright": PinholeCamera(480, 640, 190.0),
}


def some_poses(n, seed=0):
    """Make poses in the middle of the box of `make_landmarks`, some with roll."""
    rng = np.random.default_rng(seed)
    poses = poses_looking_along(rng.uniform((-2, -2, 0.5), (2, 2, 2), (n, 3)), rng.normal(size=(n, 3)))
    roll = Rotation.from_rotvec(rng.normal(scale=0.3, size=(n, 1)) * (0, 0, 1)).as_matrix()
    return roll @ poses


def walls(n, seed=0):
    """Make landmarks on the walls of a room, with some unknown attributes."""
    landmarks = make_landmarks(np.random.default_rng(seed), n)
    assert landmarks.mapping_focal_px is not None
    landmarks.points[:, :2] *= np.random.default_rng(seed).choice([-1, 1], (n, 2))
    landmarks.ambiguity[::3] = np.nan
    landmarks.mapping_distance_spread[::4] = np.nan
    landmarks.mapping_focal_px[::5] = np.nan
    return landmarks


def random_network(seed, attributes=ATTRIBUTES, **options):
    """Make a network with random weights and statistics."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    mean = rng.normal(size=len(attributes))
    std = rng.uniform(0.3, 2, len(attributes))
    network = SetNetwork(FeatureStatistics(attributes, tuple(mean.tolist()), tuple(std.tolist())), **options)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm1d):
            module.running_mean.normal_()
            module.running_var.uniform_(1, 4)
            module.weight.data.uniform_(0.3, 1)
            module.bias.data.normal_()
    training_range = TrainingRange({"distance_m": (1.0, 2.6), "in_view": (20, 300), "across_deg": (30.0, 130.0)})
    return TrainedNetwork("set", network, None, 0.8, -0.3, training_range)


NETWORKS = {
    "default": {"hidden": ("distance", "mapped_distance", "mapped_pixel_size")},
    "small": {"dropout": 0.5, "width": 24, "head": 16},
    "another order": {"attributes": ATTRIBUTES[::-1]},
}


@pytest.mark.parametrize(
    ("name", "camera"),
    [*((name, CAMERAS["paper"]) for name in NETWORKS), *(("small", camera) for camera in [*CAMERAS.values()][1:])],
)
def test_scores_are_those_of_pytorch(name, camera, tmp_path):
    weights = tmp_path / "set.safetensors"
    random_network(len(name), **NETWORKS[name]).save(weights)
    localization_map = LocalizationMap(Map(walls(1500, len(name))), camera)
    poses = some_poses(120, len(name))
    scorer = load_scorer(localization_map, weights)
    robot = RobotScorer(export_robot(localization_map, weights, tmp_path / "robot"))
    views = robot.views(poses)
    expected = scorer.score(poses)
    np.testing.assert_allclose(views.score, expected, atol=TOLERANCE, rtol=0)
    assert views.score.dtype == np.float64 and np.ptp(expected) > 100 * TOLERANCE
    np.testing.assert_array_equal(views.n_visible, np.diff(localization_map.landmarks_in_view(poses).starts))
    np.testing.assert_array_equal(views.in_range, scorer.in_range(poses))
    assert 0 < views.in_range.sum() < len(poses)
    np.testing.assert_allclose(robot.score(poses[7]), expected[7:8], atol=TOLERANCE, rtol=0)
    accuracies = ((0.001, 0.01), (0.25, 2.0), (1e3, 90.0), (np.inf, np.inf)) if camera == CAMERAS["paper"] else ()
    for file, accuracy in product((weights, BUNDLED), accuracies):
        scorer = load_scorer(localization_map, file).at_accuracy(accuracy)
        folder = export_robot(localization_map, file, tmp_path / "robot", accuracy=accuracy)
        np.testing.assert_allclose(RobotScorer(folder).score(poses), scorer.score(poses), atol=TOLERANCE, rtol=0)
        assert json.loads((folder / "robot.json").read_text())["accuracy"] == [*accuracy]


@pytest.mark.parametrize("n", [1, 60, 25_000])
def test_bundled_weights_on_maps_of_any_size(n, tmp_path):
    """From views without landmarks to views with more than are sampled."""
    localization_map = LocalizationMap(Map(walls(n, n)), CAMERAS["wide, upright"])
    poses = some_poses(80, n)
    expected = load_scorer(localization_map, BUNDLED).score(poses)
    views = RobotScorer(export_robot(localization_map, BUNDLED, tmp_path)).views(poses)
    np.testing.assert_allclose(views.score, expected, atol=TOLERANCE, rtol=0)
    assert views.n_visible.max() > 2048 if n == 25_000 else views.n_visible.min() == 0


@pytest.fixture(scope="module")
def room_map():
    """Landmarks on the walls of a room with a cabinet, which occludes some of them."""
    rng = np.random.default_rng(5)
    points = rng.uniform((0, 0, 0), ROOM, (600, 3))
    axis = rng.integers(0, 3, 600)
    points[np.arange(600), axis] = np.array(ROOM)[axis] * rng.integers(0, 2, 600)
    space = FreeSpace(furnished_room())
    return LocalizationMap(
        Map(replace(make_landmarks(rng, 600), points=points)), CAMERA, MeshOcclusion(space.raycaster)
    )


@pytest.fixture(scope="module")
def folder(room_map, tmp_path_factory):
    return export_robot(room_map, BUNDLED, tmp_path_factory.mktemp("robot") / "robot", PLACES, progress=False)


def test_occlusion_is_that_of_the_nearest_place(room_map, folder, tmp_path):
    scorer = load_scorer(room_map, BUNDLED)
    without = RobotScorer(export_robot(room_map, BUNDLED, tmp_path))
    robot = RobotScorer(folder)
    for at in PLACES:
        poses = poses_looking_along(np.tile(at, (60, 1)), fibonacci_sphere(60))
        views = robot.views(poses)
        np.testing.assert_allclose(views.score, scorer.score(poses), atol=TOLERANCE, rtol=0)
        assert np.abs(views.place_distance).max() < 1e-9
        through_walls = without.views(poses)
        assert np.isnan(through_walls.place_distance).all()
        assert through_walls.n_visible.sum() > views.n_visible.sum() + 50
        unoccluded = room_map.occlusion.unoccluded(at[None], room_map.landmarks.points)[0]
        np.testing.assert_array_equal(without.views(poses, unoccluded).score, views.score)
    aside = robot.views(poses_looking_along(PLACES[1] + (0.3, 0, -0.4), (0, 1, 0)))
    np.testing.assert_allclose(aside.place_distance, 0.5)


def test_the_best_view_at_a_location(room_map, folder):
    robot = RobotScorer(folder)
    axes = fibonacci_sphere(200)
    scores = load_scorer(room_map, BUNDLED).score(poses_looking_along(np.tile(PLACES[0], (200, 1)), axes))
    view = robot.best(PLACES[0], directions=200)
    np.testing.assert_allclose(view.direction, axes[scores.argmax()], atol=1e-12)
    assert abs(view.score - scores.max()) < TOLERANCE
    np.testing.assert_allclose(view.cam_from_world, poses_looking_along(PLACES[0], view.direction), atol=1e-12)
    turn = Rotation.from_quat(view.quaternion_xyzw).as_matrix()
    np.testing.assert_allclose(turn, invert_poses(view.cam_from_world)[:, :3], atol=1e-12)
    assert 0 < view.expected_inliers <= view.n_visible and view.place_distance < 1e-9
    level = np.abs(np.degrees(np.arcsin(axes[:, 2]))) <= 10
    chosen = robot.best(PLACES[0], directions=axes, pitch_deg=(-10, 10))
    np.testing.assert_allclose(chosen.direction, axes[level][scores[level].argmax()], atol=1e-12)


def test_rotations_and_quaternions():
    special = [Rotation.from_quat(np.eye(4)), Rotation.from_euler("z", [[180], [179.99]], True)]
    for rotation in Rotation.concatenate([Rotation.random(200, random_state=0), *special]):
        quaternion = wheretolook_robot.quaternion_xyzw(rotation.as_matrix())
        np.testing.assert_allclose(quaternion, rotation.as_quat(canonical=True), atol=1e-9)
    along = [*fibonacci_sphere(50), (0, 0, 1), (0, 0, -3)]
    expected = poses_looking_along(np.zeros((52, 3)), along)[:, :, :3]
    np.testing.assert_allclose(wheretolook_robot.rotations_looking_along(along), expected, atol=1e-12)


@pytest.mark.parametrize(
    "call",
    [
        lambda robot: robot.score(np.eye(4)),
        lambda robot: robot.score(np.full((1, 3, 4), np.nan)),
        lambda robot: robot.score(some_poses(1), np.ones(7, bool)),
        lambda robot: robot.best(PLACES[0], directions=[(0, 0, 2.0)], pitch_deg=(-10, 10)),
        lambda robot: robot.best((0.0, np.nan, 1.0)),
    ],
)
def test_invalid_arguments(call, folder):
    with pytest.raises(ValueError):
        call(RobotScorer(folder))


WITHOUT_PYTORCH = """
import sys
sys.modules.update(dict.fromkeys(("torch", "warp", "scipy", "onnx", "wheretolook"), None))  # importing these fails
import numpy as np
from wheretolook_robot import RobotScorer
np.save("scores.npy", RobotScorer(".").score(np.load("poses.npy")))
"""


def test_the_folder_runs_by_itself(folder, tmp_path):
    copy = tmp_path / "robot"
    shutil.copytree(folder, copy)
    poses = some_poses(5)
    np.save(copy / "poses.npy", poses)
    subprocess.run([sys.executable, "-c", WITHOUT_PYTORCH], cwd=copy, check=True)
    np.testing.assert_array_equal(np.load(copy / "scores.npy"), RobotScorer(folder).score(poses))
    other = export_robot(LocalizationMap(Map(walls(50)), CAMERA), BUNDLED, tmp_path / "other")
    shutil.copy(other / "landmarks.npz", copy)
    with pytest.raises(ValueError):  # landmarks of another export
        RobotScorer(copy)


def setting(*keys, value):
    """An edit of robot.json; a value of None removes the setting."""

    def edit(folder):
        about = json.loads((folder / "robot.json").read_text())
        inner = about
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = value
        if value is None:
            del inner[keys[-1]]
        (folder / "robot.json").write_text(json.dumps(about))

    return edit


def array(name, change):
    """An edit of an array of landmarks.npz; None removes it."""

    def edit(folder):
        with np.load(folder / "landmarks.npz") as stored:
            arrays = dict(stored)
        arrays[name] = change(arrays[name])
        np.savez(folder / "landmarks.npz", **{key: value for key, value in arrays.items() if value is not None})

    return edit


def content(name, change):
    return lambda folder: (folder / name).write_bytes(change((folder / name).read_bytes()))


DAMAGES = [
    setting("camera", "fx", value=0),
    setting("world_from_map", "rotation", value=np.zeros((3, 3)).tolist()),
    setting("map_attributes", value=[*MAP_ATTRIBUTES[::-1]]),
    setting("range", "in_view", value=[np.nan, 2]),
    *(setting(key, value=None) for key in ("camera", "files", "sha256", "format_version")),
    array("points", lambda a: np.where(a == a[0, 0], np.nan, a)),
    array("directions", lambda a: 1e4 * a),
    array("attributes", lambda a: np.full_like(a, np.nan)),
    array("unoccluded", lambda a: None),
    *(content(name, lambda data: data[: len(data) // 2]) for name in ("robot.json", "landmarks.npz", "scorer.onnx")),
    *(content(name, lambda data: b"") for name in ("robot.json", "landmarks.npz", "scorer.onnx")),
    content("robot.json", lambda data: b"[" * 100_000),
    content("robot.json", lambda data: b"\xff[]"),
    content("robot.json", lambda data: data + b" " * 1_000_000),
]


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_folders_are_rejected_by_file(damage, folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    damage(copy)
    with pytest.raises(ValueError, match=f"^{copy}.*Export again"):
        RobotScorer(copy)


def test_devices_and_bombs_are_rejected(folder, tmp_path, monkeypatch):
    copy = shutil.copytree(folder, tmp_path / "copy")
    with np.load(copy / "landmarks.npz") as stored:
        arrays = dict(stored)
    changes = {
        "uint64": {"unoccluded": arrays["unoccluded"].astype(np.uint64)},
        "would expand": {"places": np.zeros((200_000, 3))},
    }
    monkeypatch.setattr("wheretolook.robot.wheretolook_robot.FREE_BYTES", 100_000)
    for problem, change in changes.items():
        np.savez_compressed(copy / "landmarks.npz", **(arrays | change))
        about = json.loads((copy / "robot.json").read_text())
        about["files"]["landmarks.npz"] = file_digest(copy / "landmarks.npz")
        del about["sha256"]
        (copy / "robot.json").write_text(json.dumps(about | {"sha256": description_digest(about)}))
        with pytest.raises(ValueError, match=problem):
            RobotScorer(copy)
    for name in ("landmarks.npz", "robot.json"):
        (copy / name).unlink()
        os.mkfifo(copy / name)
        with pytest.raises(FileNotFoundError):
            RobotScorer(copy)


def test_cameras_and_weights_that_cannot_be_exported(room_map, tmp_path):
    opencv = ColmapCamera("OPENCV", 160, 120, (80.0, 81.0, 79.0, 60.5, -0.1, 0.01, 1e-3, -1e-3))
    assert pinhole_of(opencv) == PinholeCamera(160, 120, 80.0, 81.0, (79.0, 60.5))
    with pytest.raises(CameraError):
        export_robot(room_map.of_camera(opencv), BUNDLED, tmp_path)
    with pytest.raises(WeightsError):
        export_robot(room_map, BUNDLED.with_name("matchability.safetensors"), tmp_path)
