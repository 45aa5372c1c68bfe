"""A map of a small textured box, held against the box itself."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import pose_error, poses_looking_along
from wheretolook.mapping import triangulation
from wheretolook.mapping.colmap_model import colmap_poses
from wheretolook.mapping.config import MIN_TRIANGULATION_ANGLE_DEG, MapConfig
from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks
from wheretolook.mapping.rendered_map import build_map, plan_walk
from wheretolook.mapping.triangulation import choose_pairs, estimate_poses, posed_model, shrink_depth, surface_overlap
from wheretolook.rendering.appearance import Appearance
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.utils.errors import MapError

CAMERA = PinholeCamera(320, 240, 160.0)
CONFIG = MapConfig(n_images=14, keep_database=True, keep_images=True)
SEED = 2**32 - 2  # beyond what COLMAP's own seed holds


@pytest.fixture(scope="module")
def renderer(room):
    return WarpRenderer(room)


@pytest.fixture(scope="module")
def built(room, room_free_space, renderer, tmp_path_factory):
    folder = tmp_path_factory.mktemp("maps") / "scene" / "map"
    report = build_map(room, renderer, room_free_space, CAMERA, CONFIG, SEED, folder, workers=1, progress=False)
    return folder, report


def distance_to_box_m(points, mesh):
    """Distance from points to the surface of the box, in closed form."""
    low, high = mesh.bounds
    outside = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0), axis=1)
    inside = np.minimum(points - low, high - points).min(1)
    return np.where(inside >= 0, inside, outside)


def test_landmarks_lie_on_the_mesh(built, room):
    folder, report = built
    landmarks = Landmarks.load(folder / "landmarks.npz")
    assert len(landmarks) == report.n_landmarks > 200
    distance_cm = 100 * distance_to_box_m(landmarks.points, room)
    assert np.median(distance_cm) < 1
    assert report.median_distance_to_mesh_cm == pytest.approx(np.median(distance_cm), abs=1e-3)
    assert report.p90_distance_to_mesh_cm == pytest.approx(np.quantile(distance_cm, 0.9), abs=1e-3)


def test_model_reopens_with_the_poses_of_the_walk(built, room, room_free_space):
    folder, report = built
    model = pycolmap.Reconstruction(str(folder))
    assert model.num_images() == CONFIG.n_images and model.num_points3D() == report.n_landmarks
    (camera,) = model.cameras.values()
    assert_allclose(camera.calibration_matrix(), CAMERA.matrix)
    walk = plan_walk(room_free_space, room.bounds, CONFIG.n_images, SEED)
    expected = poses_looking_along(walk.positions, walk.directions)
    for index, pose in enumerate(expected):
        image = model.images[index + 1]
        assert image.name == f"{index:05d}.png" and image.has_pose
        assert_allclose(image.cam_from_world().matrix(), pose, atol=1e-9)


def test_a_varied_map_with_appearance_is_of_fewer_and_changed_images(built, room, room_free_space, renderer, tmp_path):
    """The changed images are those of `Appearance` at the map's own poses."""
    import cv2

    config = MapConfig(n_images=20, keep_images=True, vary=True, appearance=1.0)
    report = build_map(
        room, renderer, room_free_space, CAMERA, config, SEED, tmp_path / "map", workers=1, progress=False
    )
    assert 8 <= report.n_images < 20
    poses = colmap_poses(tmp_path / "map")
    changes = []
    for index, appearance in enumerate(Appearance.of_views(poses, 1.0, SEED)):
        rendering = renderer.render(CAMERA, poses[index : index + 1])
        expected = appearance.apply(rendering.rgb[0], CAMERA, rendering.depth_m[0])
        image = cv2.imread(str(tmp_path / "map" / "images" / f"{index:05d}.png"))[..., ::-1]
        assert np.abs(image.astype(int) - expected).mean() < 0.1
        changes.append(np.abs(image.astype(int) - rendering.rgb[0]).mean())
    assert min(changes) > 0.5 and max(changes) > 10


def test_noisy_poses_are_adjusted_to_those_of_the_walk(built, rng):
    model = pycolmap.Reconstruction(str(built[0]))
    exact = {number: image.cam_from_world().matrix() for number, image in model.images.items()}
    for number, image in model.images.items():
        turned = pycolmap.Rotation3d(rng.normal(0, 0.005, 3)) * pycolmap.Rotation3d(exact[number][:, :3])
        image.frame.set_cam_from_world(1, pycolmap.Rigid3d(turned, exact[number][:, 3] + rng.normal(0, 0.02, 3)))
    estimate_poses(model)
    errors_m = [
        pose_error(image.cam_from_world().matrix(), exact[number])[0]
        for number, image in model.images.items()
        if image.num_points3D > 20
    ]
    assert np.median(errors_m) < 0.02


def test_images_that_observe_nothing_keep_their_poses():
    exact = poses_looking_along(np.zeros((2, 3)), np.eye(3)[:2])
    model = posed_model(CAMERA, exact)
    estimate_poses(model)
    found = [image.cam_from_world().matrix() for _, image in sorted(model.images.items())]
    assert_allclose(found, exact, atol=1e-12)


def test_a_drifting_map_has_an_estimated_camera(room, room_free_space, renderer, tmp_path):
    folder = tmp_path / "map"
    config = MapConfig(n_images=10, vary="drift")
    report = build_map(room, renderer, room_free_space, CAMERA, config, SEED, folder, workers=1, progress=False)
    (camera,) = pycolmap.Reconstruction(str(folder)).cameras.values()
    assert 1e-5 < abs(camera.focal_length / CAMERA.fx - 1) < 0.05
    assert report.median_distance_to_mesh_cm < 5


def test_landmarks_project_to_their_keypoints(built):
    folder, report = built
    model = pycolmap.Reconstruction(str(folder))
    seen = 0
    for point in model.points3D.values():
        errors = []
        for element in point.track.elements:
            image = model.images[element.image_id]
            pixel = CAMERA.project(image.cam_from_world().matrix() @ [*point.xyz, 1.0])
            errors.append(np.linalg.norm(pixel - image.points2D[element.point2D_idx].xy))
            assert image.points2D[element.point2D_idx].point3D_id in model.points3D
        assert np.mean(errors) == pytest.approx(point.error, abs=1e-6)
        assert np.mean(errors) <= CONFIG.max_reprojection_error_px
        seen += len(errors)
    assert seen == model.compute_num_observations()
    assert report.mean_reprojection_error_px == pytest.approx(
        np.mean([p.error for p in model.points3D.values()]), rel=1e-5
    )


def test_keypoint_pixels_have_the_colour_of_the_landmark(built):
    """The images, the keypoints and the points belong together, down to the pixel."""
    import cv2

    folder, _ = built
    model = pycolmap.Reconstruction(str(folder))
    images = {i: cv2.imread(str(folder / "images" / image.name))[..., ::-1] for i, image in model.images.items()}
    for point in model.points3D.values():
        colors = []
        for element in point.track.elements:
            x, y = model.images[element.image_id].points2D[element.point2D_idx].xy
            colors.append(images[element.image_id][int(y), int(x)])
        assert_allclose(point.color, np.mean(colors, axis=0), atol=1)


def test_stored_landmarks_are_those_of_the_model_and_its_database(built):
    folder, _ = built
    stored = Landmarks.load(folder / "landmarks.npz")
    read = load_colmap_landmarks(folder, folder / "database.db")
    for name, value in vars(stored).items():
        assert_array_equal(value, getattr(read, name))
    assert (stored.track_length >= 2).all()
    # The angle is held by COLMAP before the last adjustment of the points.
    assert stored.triangulation_angle_deg.min() > 0.9 * MIN_TRIANGULATION_ANGLE_DEG


@pytest.mark.slow
def test_same_seed_same_bytes_whatever_the_workers(built, room, room_free_space, renderer, tmp_path, monkeypatch):
    monkeypatch.setattr(triangulation, "_PAIRS_AT_A_TIME", 16)  # so that both workers match
    folder, report = built
    assert report.n_pairs > 32
    again = tmp_path / "again"
    build_map(room, renderer, room_free_space, CAMERA, CONFIG, SEED, again, workers=2, progress=False)
    names = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(again) for p in again.rglob("*") if p.is_file())
    assert Path("points3D.bin") in names and {Path("landmarks.npz"), Path("cameras.npz")} < {*names}
    for name in names:
        if name.name not in ("report.json", "database.db"):
            assert (folder / name).read_bytes() == (again / name).read_bytes(), name


def test_scene_without_texture_gives_no_map(room, room_free_space, tmp_path):
    plain = TexturedMesh(
        room.vertices,
        room.triangles,
        room.corner_uvs,
        room.triangle_texture,
        tuple(np.full((8, 8, 3), 30 * i + 60, np.uint8) for i in range(6)),
    )
    with pytest.raises(MapError):
        build_map(
            plain, WarpRenderer(plain), room_free_space, CAMERA, CONFIG, 0, tmp_path / "map", workers=1, progress=False
        )
    assert list(tmp_path.iterdir()) == []


# Overlap of views against surfaces whose overlap follows from plane geometry.


def wall_depth(distance_m):
    """Depth of a wall across the optical axis."""
    return np.full((CAMERA.height, CAMERA.width), distance_m, dtype=np.float32)


def test_overlap_of_cameras_that_face_a_wall():
    """A view of a wall 2 m away is 4 m wide, so a step of s metres to the side leaves the share 1 - s / 4."""
    steps = np.array([0.0, 0.5, 1.0, 1.5])
    poses = poses_looking_along(np.column_stack([steps, 0 * steps, 0 * steps]), np.tile([0.0, 1.0, 0.0], (4, 1)))
    overlap = surface_overlap(CAMERA, poses, shrink_depth(np.stack([wall_depth(2.0)] * 4)))
    expected = 1 - np.abs(steps[:, None] - steps[None]) / 4
    np.fill_diagonal(expected, 0)
    np.testing.assert_allclose(overlap, expected, atol=0.05)


def test_no_overlap_without_parallax_behind_walls_or_from_the_other_side():
    centers = np.array([[0.0, 0.0, 0.0], [0.001, 0.0, 0.0], [0.0, 4.0, 0.0], [0.5, 0.0, 0.0]])
    directions = np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    depth = np.stack([wall_depth(2.0), wall_depth(2.0), wall_depth(2.0), wall_depth(1.0)])
    overlap = surface_overlap(CAMERA, poses_looking_along(centers, directions), shrink_depth(depth))
    assert overlap[0, 1] == 0  # rays that meet at less than a degree
    # Facing each other through a thin wall, only the parts at which both look from the side of a line are near 180 or
    # 90 degrees apart: never below the limit.
    assert overlap[0, 2] == 0
    assert overlap[0, 3] == 0  # something hides the wall from the last camera
    empty = surface_overlap(CAMERA, poses_looking_along(centers, directions), 0 * shrink_depth(depth))
    assert (empty == 0).all()


def test_pairs_are_each_images_best_partners(rng):
    overlap = rng.random((12, 12))
    overlap = (overlap + overlap.T) / 2
    np.fill_diagonal(overlap, 0)
    pairs = choose_pairs(overlap, 3, min_overlap=0.4)
    expected = set()
    for i in range(12):
        best = sorted(range(12), key=lambda j: -overlap[i, j])[:3]
        expected |= {(min(i, j), max(i, j)) for j in best if overlap[i, j] >= 0.4}
    assert [tuple(p) for p in pairs] == sorted(expected)
    assert choose_pairs(np.zeros((4, 4)), 3, min_overlap=0.0).shape == (0, 2)
    assert len(choose_pairs(np.ones((3, 3)) - np.eye(3), 10)) == 3
