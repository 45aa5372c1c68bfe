"""Degenerate maps, images of one pixel and requests that exceed the memory."""

from dataclasses import replace

import numpy as np
import pytest

from box_scenes import furnished_room
from planning.rooms import CAMERA, DIRECTIONS, GRID, room_landmarks
from selection.room import WEIGHTS
from synthetic_dataset import make_landmarks
from twins.open3d_renderer import Open3DRenderer
from twins.visibility import count_plain
from wheretolook.dataset.config import SampleConfig
from wheretolook.dataset.sampling import sample_viewpoints
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import VoxelGrid, fibonacci_sphere
from wheretolook.geometry.poses import poses_looking_along, rotation_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.map import Map
from wheretolook.planning.config import MappedLattice
from wheretolook.planning.scene_map import build_viewpoint_map
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scorers.registry import make_scorer, scorers
from wheretolook.space.mapped_space import MappedSpace
from wheretolook.utils import devices as memory
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.visibility.counting import SurveyOptions, survey
from wheretolook.visibility.hidden_points import HiddenPointRemoval
from wheretolook.visibility.occlusion import NoOcclusion

pytestmark = pytest.mark.filterwarnings("ignore::wheretolook.utils.errors.OutOfRangeWarning")

FORWARD = np.array([(1.0, 0.0, 0.0)])
WEIGHTS_OF = {"set": "set", "expected-inliers": "matchability", "mlp-2d+z": "mlp-2d+z"}


def at(points):
    """Landmarks with made-up attributes at points (N, 3)."""
    return replace(make_landmarks(np.random.default_rng(0), len(points)), points=np.asarray(points, dtype=np.float64))


def scores_of(method, localization_map, poses):
    weights = WEIGHTS / f"{WEIGHTS_OF[method]}.safetensors" if method in WEIGHTS_OF else None
    return make_scorer(method, localization_map, weights=weights).score(poses)


MAPS = {
    "single": at(np.array([(2.0, 0.1, 0.0)])),
    "coincident": at(np.tile([(2.0, 0.1, 0.2)], (40, 1))),
    "on a line": at(np.column_stack([np.full(30, 2.0), np.linspace(-0.5, 0.5, 30), np.zeros(30)])),
    "coplanar": at(np.column_stack([np.full(50, 2.0), np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))])),
    "in the camera's plane": at(np.column_stack([np.random.default_rng(0).uniform(1, 3, (50, 2)), np.zeros(50)])),
}


@pytest.mark.parametrize("name", MAPS)
def test_flat_and_tiny_maps_are_scored_by_every_method(name):
    landmarks = MAPS[name]
    poses = poses_looking_along(np.zeros((2, 3)), [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)])
    known = poses_looking_along([(0.5, 0.5, 0.0)], FORWARD)
    for hides in (NoOcclusion(), HiddenPointRemoval()):
        localization_map = LocalizationMap(Map(landmarks, mapping_poses=known), CAMERA, hides)
        seen = np.diff(localization_map.landmarks_in_view(poses).starts)
        in_image = CAMERA.in_image(CAMERA.project(landmarks.points @ poses[0, :, :3].T))
        expected = in_image & (landmarks.points[:, 0] > 0)
        free = hides.unoccluded(np.zeros((1, 3)), landmarks.points)[0]
        np.testing.assert_array_equal(seen, [np.sum(expected & free), 0])
        assert seen[0] > 0
        rules = [rule for rule, method in scorers().items() if method.learner is None and not method.weights]
        for method in (*rules, *WEIGHTS_OF):
            score = scores_of(method, localization_map, poses)
            assert score.shape == (2,) and not np.isnan(score).any(), (method, score)
    assert np.isfinite(MappedSpace(landmarks.points, [(0.5, 0.5, 0.0)]).bounds).all()


def test_a_view_exactly_on_a_landmark():
    landmarks = room_landmarks(200)
    here = landmarks.points[17]
    poses = poses_looking_along(np.tile(here, (len(DIRECTIONS), 1)), DIRECTIONS)
    localization_map = LocalizationMap(Map(landmarks, mapping_poses=poses[:3]), CAMERA, NoOcclusion())
    seen = localization_map.landmarks_in_view(poses)
    assert not np.isin(17, seen.indices)  # it has no direction as seen from there
    rotations = poses[:, :, :3]
    free = np.ones((1, 200), dtype=bool)
    np.testing.assert_array_equal(
        count_plain(CAMERA, rotations, here[None], landmarks.points, free)[0], np.diff(seen.starts)
    )
    for method in ("visible", "bins", "fisher-mineig-exact", "fisher-logdet-gp", "fisher-trace-quadratic", *WEIGHTS_OF):
        assert not np.isnan(scores_of(method, localization_map, poses)).any(), method
    with pytest.raises(SceneError):
        HiddenPointRemoval().unoccluded(here[None], landmarks.points)


def test_images_of_one_pixel():
    camera = PinholeCamera(1, 1, 1.0)
    pose = poses_looking_along([(3.0, 2.5, 1.5)], FORWARD)
    images = [WarpRenderer(furnished_room(), method=method).render(camera, pose) for method in ("raster", "rays")]
    images.append(Open3DRenderer(furnished_room()).render(camera, pose))
    for image in images:
        assert image.rgb.shape == (1, 1, 1, 3)
        np.testing.assert_allclose(image.depth_m, images[0].depth_m, rtol=1e-4)
        np.testing.assert_allclose(image.rgb.astype(float), images[0].rgb, atol=3)
    localization_map = LocalizationMap(Map(room_landmarks(300)), camera)
    ahead = localization_map.landmarks_in_view(pose)
    assert len(ahead.indices) > 0
    for method in ("bins", "set"):
        assert np.isfinite(scores_of(method, localization_map, pose)).all()


def test_seventy_thousand_directions():
    axes = fibonacci_sphere(70_000)
    landmarks = room_landmarks(60)
    place = np.array([(3.0, 2.5, 1.5)])
    rotations = rotation_looking_along(axes)
    counts = survey(CAMERA, rotations, place, landmarks.points, NoOcclusion(), SurveyOptions(keep=5)).counts
    some = np.arange(0, 70_000, 701)
    everything = np.ones((1, 60), dtype=bool)
    expected = count_plain(CAMERA, rotations[some], place, landmarks.points, everything)
    np.testing.assert_array_equal(counts[0, some], expected[0])
    with pytest.raises(ConfigError):
        MappedLattice(directions=70_000)
    with pytest.raises(ConfigError):
        build_viewpoint_map(make_scorer("visible", LocalizationMap(Map(landmarks), CAMERA)), GRID, [30], axes)


HUGE = (100_000, 100_000, 100_000)


@pytest.mark.parametrize(
    "refused",
    [
        lambda: SampleConfig(directions=10**11),
        lambda: fibonacci_sphere(10**15),
        lambda: SampleConfig(grid=HUGE),
        lambda: VoxelGrid((0, 0, 0), (1, 1, 1), HUGE).centers(),
    ],
)
def test_requests_that_exceed_any_memory(refused):
    with pytest.raises(ConfigError):
        refused()


def test_requests_that_exceed_the_free_memory(monkeypatch):
    landmarks = room_landmarks(60)
    rotations = rotation_looking_along(fibonacci_sphere(20_000))
    monkeypatch.setattr(memory, "available_bytes", lambda: 2_000_000)
    with pytest.raises(ConfigError):
        survey(CAMERA, rotations, GRID.centers()[:10], landmarks.points, NoOcclusion())
    with pytest.raises(ConfigError):
        sample_viewpoints(GRID, np.arange(60), landmarks, CAMERA, NoOcclusion(), SampleConfig(keep=0, directions=100))
