"""A scene in the coordinates of a country's grid, millions of metres from the origin, gives what it gives near it."""

from dataclasses import replace
from functools import cache

import numpy as np
import pycolmap
import pytest

from box_scenes import ROOM, box_room, furnished_room
from planning.rooms import CAMERA, DIRECTIONS, GRID, free_voxels, room_landmarks
from selection.room import POINTS, WEIGHTS, write_room
from twins.open3d_renderer import Open3DRenderer
from wheretolook import WhereToLook
from wheretolook.features.extractor import Keypoints
from wheretolook.features.matches import Matches
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.geometry.poses import camera_centers, pose_error, poses_looking_along, transform
from wheretolook.geometry.similarity import local_origin, poses_from
from wheretolook.geometry.tsdf import DepthImage, TsdfVolume
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.localization.localizer import Localizer
from wheretolook.mapping.colmap_model import load_mapping_poses, save_mapping_poses
from wheretolook.mapping.config import MapConfig
from wheretolook.mapping.georeference import REPORT_FILE
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.map import Map
from wheretolook.mapping.rendered_map import build_map
from wheretolook.planning.scene_map import build_viewpoint_map
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.robot.export import export_robot
from wheretolook.robot.wheretolook_robot import RobotScorer
from wheretolook.scenes.loading import load_mesh, save_glb
from wheretolook.scorers.registry import make_scorer, scorers
from wheretolook.space.free_space import FreeSpace, TsdfSpace
from wheretolook.utils.errors import OutOfRangeWarning
from wheretolook.visibility.hidden_points import HiddenPointRemoval
from wheretolook.visibility.occlusion import MeshOcclusion, TsdfOcclusion

SHIFT = np.array([4e6, 5e6, 300.0])  # as of a place in Europe in UTM, and its height
ROOM_POSES = poses_looking_along(
    [(3.0, 2.5, 1.5), (1.0, 1.0, 1.2), (5.0, 4.0, 2.0)], [(1.0, 0.2, -0.1), (0.3, 1.0, 0.0), (-1.0, -1.0, -0.3)]
)
LOOSE = pytest.mark.filterwarnings(f"ignore::{OutOfRangeWarning.__module__}.{OutOfRangeWarning.__name__}")


@cache
def far_room():
    """The furnished room there, as a loaded mesh would be."""
    mesh = furnished_room()
    return replace(mesh, origin=SHIFT)


def far_poses(poses):
    return poses_from(poses, -SHIFT)


def far_landmarks(landmarks):
    return replace(landmarks, points=landmarks.points + SHIFT)


def test_most_scenes_keep_their_origin():
    assert not local_origin(np.random.default_rng(0).normal(scale=20, size=(100, 3))).any()
    assert not np.signbit(local_origin([(-1.0, -2.0, -3.0)])).any()
    outliers = np.array([(4e6 + x, 5e6, 300.0) for x in range(10)] + [(1e300, 0, 0), (np.nan, 0, 0)])
    np.testing.assert_array_equal(local_origin(outliers), SHIFT)
    poses = far_poses(ROOM_POSES)
    np.testing.assert_allclose(camera_centers(poses) - SHIFT, camera_centers(ROOM_POSES), atol=1e-8)
    np.testing.assert_allclose(poses_from(poses, SHIFT), ROOM_POSES, atol=1e-8)


@pytest.mark.parametrize("kind", ["glb", "obj"])
def test_a_mesh_is_read_and_written_to_a_hundredth_of_a_millimetre(kind, tmp_path):
    near = furnished_room()
    file = tmp_path / f"scene.{kind}"
    if kind == "glb":
        save_glb(far_room(), file)
    else:
        corners = (near.vertices.astype(np.float64) + SHIFT).tolist()
        lines = [f"v {x!r} {y!r} {z!r} 0.5 0.5 0.5" for x, y, z in corners]
        lines += ["f " + " ".join(str(1 + i) for i in face) for face in near.triangles.tolist()]
        file.write_text("\n".join(lines) + "\n")
    read = load_mesh(file, colored=False)
    np.testing.assert_array_equal(read.origin, SHIFT)
    np.testing.assert_allclose(read.bounds - SHIFT, near.bounds, atol=1e-5)
    np.testing.assert_allclose(np.sort(read.normals, axis=0), np.sort(near.normals, axis=0), atol=1e-4)


def test_images_and_depth_are_the_same():
    camera = PinholeCamera(64, 48, 32.0)
    near = WarpRenderer(furnished_room()).render(camera, ROOM_POSES)
    for renderer in (WarpRenderer(far_room()), WarpRenderer(far_room(), method="rays"), Open3DRenderer(far_room())):
        far = renderer.render(camera, far_poses(ROOM_POSES))
        assert np.isclose(far.depth_m, near.depth_m, atol=1e-4).mean() > 0.999
        assert (np.abs(far.rgb.astype(int) - near.rgb) <= 2).mean() > 0.999


def test_rays_and_free_space_are_the_same():
    near = FreeSpace(furnished_room())
    far = FreeSpace(far_room())
    assert near.two_sided == far.two_sided
    rng = np.random.default_rng(1)
    a, b = rng.uniform(0, ROOM, (2, 300, 3))
    np.testing.assert_array_equal(far.is_free(a + SHIFT), near.is_free(a))
    np.testing.assert_array_equal(far.segments_are_free(a + SHIFT, b + SHIFT), near.segments_are_free(a, b))
    np.testing.assert_allclose(far.floor_below(a + SHIFT) - SHIFT[2], near.floor_below(a), atol=1e-5)
    occluded = near.raycaster.occluded(a[:20], b)
    assert 0.05 < occluded.mean() < 0.95
    np.testing.assert_array_equal(far.raycaster.occluded(a[:20] + SHIFT, b + SHIFT), occluded)
    hits = near.raycaster.cast(a, b - a)
    there = far.raycaster.cast(a + SHIFT, b - a)
    np.testing.assert_allclose(there.distance_m, hits.distance_m, atol=1e-4)


def test_depth_images_fuse_to_the_same():
    camera = PinholeCamera(160, 120, 80.0)
    rng = np.random.default_rng(0)
    poses = poses_looking_along(np.tile((3.0, 2.5, 1.5), (16, 1)), rng.normal(size=(16, 3)))
    depth = WarpRenderer(furnished_room()).render(camera, poses).depth_m
    points = rng.uniform((1, 1, 0.5), (5, 4, 2.5), (200, 3))
    results = []
    for moved, shift in ((poses, 0), (far_poses(poses), SHIFT)):
        images = [DepthImage(image, camera, pose) for image, pose in zip(depth, moved, strict=True)]
        volume = TsdfVolume.from_images(images, progress=False)
        at = points + shift
        free = TsdfSpace(volume, images, progress=False).is_free(at)
        results.append((volume.surface().bounds - shift, TsdfOcclusion(volume).unoccluded(at[:10], at), free))
    (bounds, in_sight, free), (far_bounds, far_in_sight, far_free) = results
    np.testing.assert_allclose(far_bounds, bounds, atol=1e-3)
    assert (in_sight == far_in_sight).mean() > 0.999 and in_sight.mean() > 0.05
    assert (free == far_free).mean() > 0.98 and free.mean() > 0.05


@LOOSE
@pytest.mark.parametrize("model", ["mesh", "hidden-points"])
def test_scores_are_the_same_by_every_method(model):
    landmarks = room_landmarks(400)
    poses = poses_looking_along(GRID.centers()[list(free_voxels())][:8], DIRECTIONS[:8])
    known = poses_looking_along([(3.0, 2.5, 1.5)] * 4, DIRECTIONS[:4])
    views = []
    for mesh, there, move in (
        (furnished_room(), landmarks, np.copy),
        (far_room(), far_landmarks(landmarks), far_poses),
    ):
        hides = MeshOcclusion(MeshRaycaster(mesh)) if model == "mesh" else HiddenPointRemoval()
        views.append((LocalizationMap(Map(there, mapping_poses=move(known)), CAMERA, hides), move(poses)))
    released = {"set": "set", "expected-inliers": "matchability", "mlp-2d+z": "mlp-2d+z"}
    rules = [name for name, method in scorers().items() if method.learner is None and not method.weights]
    for name in (*rules, *released) if model == "mesh" else ("visible",):
        # random numbers are drawn from the pose; and turns about the world's origin are, as the name says
        if name in ("random", "forward") or name.endswith("-origin"):
            continue
        weights = WEIGHTS / f"{released[name]}.safetensors" if name in released else None
        scores, there = (make_scorer(name, seen, weights=weights).score(at) for seen, at in views)
        np.testing.assert_allclose(there, scores, rtol=2e-4, atol=1e-5, err_msg=name)


@LOOSE
def test_a_colmap_model_gives_the_same_views(tmp_path):
    folder = write_room(tmp_path / "near")
    model = pycolmap.Reconstruction(str(folder))
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(np.eye(3)), SHIFT))
    (tmp_path / "far").mkdir()
    model.write_binary(str(tmp_path / "far"))
    (folder / REPORT_FILE).unlink()  # which states that the images are rendered, and not copied with the model
    for hides in ("none", "hidden-points"):
        near = WhereToLook.from_colmap(folder, occlusion=hides, directions=100, scale=1)
        far = WhereToLook.from_colmap(tmp_path / "far", occlusion=hides, directions=100, scale=1)
        views = near.best(POINTS)
        there = far.best(POINTS + SHIFT)
        np.testing.assert_array_equal(there.n_visible, views.n_visible)
        np.testing.assert_allclose(there.yaw_deg, views.yaw_deg, atol=1e-6)
        np.testing.assert_allclose(there.score, views.score, rtol=1e-4)
        np.testing.assert_array_equal(far.grid(0.5).ids, near.grid(0.5).ids)
    there.save(tmp_path / "posed", "colmap")
    posed = pycolmap.Reconstruction(str(tmp_path / "posed"))
    centers = [posed.images[number].projection_center() for number in sorted(posed.images)]
    np.testing.assert_allclose(np.array(centers) - SHIFT, POINTS, atol=1e-6)


@pytest.mark.slow
def test_a_map_is_triangulated_as_well(tmp_path):
    mesh = replace(box_room(), origin=SHIFT)
    config = MapConfig(n_images=12)
    camera = PinholeCamera(320, 240, 160.0)
    scene = mesh, WarpRenderer(mesh), FreeSpace(mesh)
    report = build_map(*scene, camera, config, 0, tmp_path / "map", workers=1, progress=False)
    assert report.n_landmarks > 200 and report.median_distance_to_mesh_cm < 1


def test_a_pose_is_estimated_as_exactly_as_near_the_origin():
    rng = np.random.default_rng(0)
    points = rng.uniform(0, ROOM, (200, 3))
    pose = ROOM_POSES[0]
    pixels = CAMERA.project(transform(pose, points))
    rows = np.flatnonzero((transform(pose, points)[:, 2] > 0.1) & CAMERA.in_image(pixels))
    keypoints = Keypoints(pixels.astype(np.float32), np.zeros((200, 128), np.float32))
    landmarks = replace(room_landmarks(200), points=points + SHIFT, descriptors=np.ones((200, 128), np.uint8))
    found = Localizer(landmarks, CAMERA).estimate(keypoints, Matches.none(200)._replace(keypoints=rows, landmarks=rows))
    assert found.status == "localized" and len(found.inlier_rows) == len(rows)
    error_m, error_deg = pose_error(found.cam_from_world, far_poses(pose))
    assert error_m < 1e-3 and error_deg < 1e-2


@LOOSE
def test_a_viewpoint_map_and_a_robots_file_are_the_same(tmp_path):
    pytest.importorskip("onnx")
    landmarks = room_landmarks(300)
    weights = WEIGHTS / "set.safetensors"
    maps = []
    robots = []
    for shift, mesh in ((0 * SHIFT, furnished_room()), (SHIFT, far_room())):
        there = replace(landmarks, points=landmarks.points + shift)
        localization_map = LocalizationMap(Map(there), CAMERA, MeshOcclusion(MeshRaycaster(mesh)))
        scorer = make_scorer("set", localization_map, weights=weights)
        grid = VoxelGrid(tuple(shift), tuple(shift + ROOM), GRID.shape)
        folder = tmp_path / str(len(maps))
        build_viewpoint_map(scorer, grid, free_voxels(), DIRECTIONS, "fibonacci").save(folder / "map")
        maps.append(ViewpointMap.load(folder / "map"))
        places = grid.centers()[list(free_voxels())]
        robots.append(RobotScorer(export_robot(localization_map, weights, folder / "robot", places, progress=False)))
    near, far = maps
    np.testing.assert_allclose(far.scores, near.scores, atol=1e-4)
    np.testing.assert_array_equal(far.n_visible, near.n_visible)
    asked = np.random.default_rng(0).uniform(0, ROOM, (100, 3))
    np.testing.assert_array_equal(far.best_many(asked + SHIFT).direction_id, near.best_many(asked).direction_id)
    views = robots[0].views(ROOM_POSES)
    there = robots[1].views(far_poses(ROOM_POSES))
    np.testing.assert_array_equal(there.n_visible, views.n_visible)
    np.testing.assert_allclose(there.score, views.score, atol=1e-4)


def test_poses_and_compact_landmarks_keep_their_place_in_files(tmp_path):
    save_mapping_poses(far_poses(ROOM_POSES), tmp_path / "far.npz")
    save_mapping_poses(ROOM_POSES, tmp_path / "near.npz")
    assert load_mapping_poses(tmp_path / "near.npz").dtype == np.float32
    centers = camera_centers(load_mapping_poses(tmp_path / "far.npz")) - SHIFT
    np.testing.assert_allclose(centers, camera_centers(ROOM_POSES), atol=1e-8)
    landmarks = room_landmarks(50)
    far_landmarks(landmarks).save(tmp_path / "landmarks.npz", compact=True)
    np.testing.assert_allclose(Landmarks.load(tmp_path / "landmarks.npz").points - SHIFT, landmarks.points, atol=1e-8)
