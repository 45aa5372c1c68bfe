"""Landmarks of COLMAP models written by hand with pycolmap, with attributes worked out by hand."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from wheretolook.features.extractor import quantize_descriptors, unit_descriptors
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks, max_cosine_to_other
from wheretolook.utils.errors import MapError, MapWarning

# Three cameras on a line, 2 m apart, that look along +y; two intrinsics. Points in front of them.
CENTERS = np.array([[-2.0, 0.0, 1.0], [0.0, 0.0, 1.0], [2.0, 0.0, 1.0]])
FOCAL_PX = {1: 300.0, 2: 400.0}
CAMERA_OF = (1, 2, 1)
POINTS = np.array([[0.0, 2.0, 1.0], [1.0, 4.0, 2.0], [0.5, 3.0, 0.5], [-2.0, 5.0, 1.0]])
TRACKS = ([0, 1, 2], [1, 2], [0, 1, 2], [0, 2])
OFFSETS_PX = (0.0, 0.3, 2.0, 0.0)  # each observation of the point is off by this much in x


def project(point, image):
    x, y, z = point - CENTERS[image]  # a camera that looks along +y has x to the right, z up, hence y down
    return FOCAL_PX[CAMERA_OF[image]] * np.array([x / y, -z / y]) + (320, 240)


def hand_written_model(offsets_px=OFFSETS_PX, tracks=TRACKS, points=POINTS):
    """The model, with ids 10, 20, ... for the points, and the keypoints of its images, one unused at the front."""
    model = pycolmap.Reconstruction()
    for camera_id, focal_px in FOCAL_PX.items():
        camera = pycolmap.Camera(
            camera_id=camera_id, model="SIMPLE_PINHOLE", width=640, height=480, params=[focal_px, 320, 240]
        )
        model.add_camera_with_trivial_rig(camera)
    keypoints = [[np.array([1.0 + i, 2.0])] for i in range(3)]
    elements = []
    for point, track, offset in zip(points, tracks, offsets_px, strict=True):
        for image in track:
            elements.append((image + 1, len(keypoints[image])))
            keypoints[image].append(project(point, image) + np.array([offset, 0]))
    poses = poses_looking_along(CENTERS, np.tile([0.0, 1.0, 0.0], (3, 1)))
    for i, pose in enumerate(poses):
        image = pycolmap.Image(name=f"{i}.png", camera_id=CAMERA_OF[i], image_id=i + 1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(p) for p in keypoints[i]])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3]))
    used = 0
    for index, (point, track) in enumerate(zip(points, tracks, strict=True)):
        colmap_track = pycolmap.Track()
        for image_id, keypoint in elements[used : used + len(track)]:
            colmap_track.add_element(image_id, keypoint)
        used += len(track)
        model.add_point3D_with_id(10 * (index + 1), pycolmap.Point3D(xyz=point, track=colmap_track))
    return model, [np.array(k, dtype=np.float32) for k in keypoints]


def write_database(path, model, keypoints, descriptors):
    with pycolmap.Database.open(str(path)) as database:
        for camera in model.cameras.values():
            database.write_camera(camera, use_camera_id=True)
        for image_id, name in ((7, "2.png"), (8, "0.png"), (9, "1.png")):  # other ids than the model's: joined by name
            i = int(name[0])
            image = pycolmap.Image(name=name, camera_id=CAMERA_OF[i], image_id=image_id)
            database.write_image(image, use_image_id=True)
            database.write_keypoints(image_id, keypoints[i])
            data = pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, descriptors[i])
            database.write_descriptors(image_id, data)
    return path


def random_descriptors(counts, seed=0):
    rng = np.random.default_rng(seed)
    return [quantize_descriptors(unit_descriptors(rng.gamma(0.5, size=(n, 128)))) for n in counts]


@pytest.fixture
def model_dir(tmp_path):
    folder = tmp_path / "model"
    folder.mkdir()
    hand_written_model()[0].write_binary(str(folder))
    return folder


@pytest.mark.parametrize("text", [False, True])
def test_attributes_of_a_hand_written_model(tmp_path, text):
    model, _ = hand_written_model()
    model.write_text(str(tmp_path)) if text else model.write_binary(str(tmp_path))
    with pytest.warns(MapWarning, match="3 of 4 points"):
        landmarks = load_colmap_landmarks(tmp_path, max_reprojection_error_px=0.5)
    # Point 30 is 2 px off in every image and so beyond 0.5 px.
    np.testing.assert_array_equal(landmarks.ids, [10, 20, 40])
    np.testing.assert_allclose(landmarks.points, POINTS[[0, 1, 3]], atol=1e-12)
    np.testing.assert_array_equal(landmarks.track_length, [3, 2, 2])
    np.testing.assert_allclose(landmarks.reprojection_error_px, [0, 0.3, 0], atol=1e-4)
    # Point 10 is 2 m ahead of the middle camera, the outer ones stand 2 m to its sides: 45 degrees each way.
    # Point 20 from (0, 0, 1) is (1, 4, 1) and from (2, 0, 1) is (-1, 4, 1): cos = 16 / 18.
    # Point 40 from (-2, 0, 1) is (0, 5, 0) and from (2, 0, 1) is (-4, 5, 0): tan = 4 / 5.
    angles = [90, np.degrees(np.arccos(16 / 18)), np.degrees(np.arctan(4 / 5))]
    np.testing.assert_allclose(landmarks.triangulation_angle_deg, angles, rtol=1e-5)
    mean_y = [(1 + 2 * np.sqrt(0.5)) / 3]  # the x parts of point 10's rays cancel
    np.testing.assert_allclose(landmarks.mapping_direction[0], [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(landmarks.mapping_direction[1], np.array([0, 4, 1]) / np.sqrt(17), atol=1e-6)
    np.testing.assert_allclose(landmarks.mapping_direction_spread[0], 1 - mean_y[0], atol=1e-6)
    np.testing.assert_allclose(landmarks.mapping_direction_spread[1], 1 - np.sqrt(17 / 18), atol=1e-6)
    np.testing.assert_allclose(landmarks.mapping_distance_m[0], (2 + 2 * np.sqrt(8)) / 3, rtol=1e-6)
    np.testing.assert_allclose(landmarks.mapping_distance_m[1:], [np.sqrt(18), (5 + np.sqrt(41)) / 2], rtol=1e-6)
    assert landmarks.descriptors is None and np.isnan(landmarks.ambiguity).all()
    kinds = [landmarks.ids, landmarks.points, landmarks.track_length, landmarks.mapping_direction]
    assert [k.dtype for k in kinds] == [np.int64, np.float64, np.int32, np.float32]


def test_descriptors_are_means_over_the_track(tmp_path, model_dir):
    model, keypoints = hand_written_model()
    descriptors = random_descriptors([len(k) for k in keypoints])
    database = write_database(tmp_path / "database.db", model, keypoints, descriptors)
    landmarks = load_colmap_landmarks(model_dir, database, max_reprojection_error_px=0.5)
    # Keypoints in the order in which the points were added, after an unused one.
    seen = {10: [(0, 1), (1, 1), (2, 1)], 20: [(1, 2), (2, 2)], 40: [(0, 3), (2, 4)]}
    expected = []
    for track in seen.values():
        unit = [d / np.linalg.norm(d) for d in (descriptors[i][k].astype(np.float64) for i, k in track)]
        mean = np.mean(unit, axis=0)
        expected.append(np.minimum(np.rint(512 * mean / np.linalg.norm(mean)), 255))
    np.testing.assert_array_equal(landmarks.descriptors, np.array(expected))
    assert landmarks.descriptors.dtype == np.uint8
    unit = np.array(expected) / np.linalg.norm(expected, axis=1, keepdims=True)
    cosine = unit @ unit.T - 2 * np.eye(3)
    np.testing.assert_allclose(landmarks.ambiguity, cosine.max(1), atol=1e-6)


@pytest.mark.parametrize("n", [2, 500, 3001])
def test_ambiguity_against_brute_force(n):
    descriptors = random_descriptors([n])[0]
    descriptors[-1] = descriptors[0]  # twins, in different blocks if there are several
    unit = descriptors / np.linalg.norm(descriptors.astype(np.float64), axis=1, keepdims=True)
    rows = np.unique(np.linspace(0, n - 1, 200).astype(int))
    cosine = unit[rows] @ unit.T
    cosine[np.arange(len(rows)), rows] = -1
    ambiguity = max_cosine_to_other(descriptors)
    np.testing.assert_allclose(ambiguity[rows], cosine.max(1), atol=1e-6)
    assert ambiguity[0] == ambiguity[-1] == pytest.approx(1, abs=1e-6)


def test_long_and_short_tracks_against_a_plain_loop(tmp_path):
    """Attributes of many random landmarks, one observation at a time."""
    rng = np.random.default_rng(4)
    n_images = 40
    n_points = 300
    centers = rng.uniform(-3, 3, (n_images, 3))
    points = rng.uniform(-3, 3, (n_points, 3)) + np.array([0, 12, 0])
    tracks = [rng.choice(n_images, rng.integers(2, n_images), replace=False) for _ in range(n_points)]
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=640, height=480, params=[300, 300, 320, 240])
    )
    poses = poses_looking_along(centers, np.tile([0.0, 1.0, 0.0], (n_images, 1)))
    for i, pose in enumerate(poses):
        image = pycolmap.Image(name=f"{i}", camera_id=1, image_id=i + 1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D([0.0, 0.0]) for _ in range(n_points)])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3]))
    for p, (point, track) in enumerate(zip(points, tracks, strict=True)):
        elements = pycolmap.Track()
        for i in track:
            elements.add_element(int(i) + 1, p)
        model.add_point3D_with_id(p + 1, pycolmap.Point3D(xyz=point, track=elements, error=0.1))
    model.write_binary(str(tmp_path))
    landmarks = load_colmap_landmarks(tmp_path)
    for p, track in enumerate(tracks):
        rays = points[p] - centers[track]
        unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        angle = max(np.degrees(np.arccos(np.clip(a @ b, -1, 1))) for a in unit for b in unit)
        mean = unit.mean(0)
        assert landmarks.track_length[p] == len(track)
        assert landmarks.triangulation_angle_deg[p] == pytest.approx(angle, rel=1e-4)
        distances = np.linalg.norm(rays, axis=1)
        assert landmarks.mapping_distance_m[p] == pytest.approx(distances.mean(), rel=1e-5)
        assert landmarks.mapping_distance_spread[p] == pytest.approx(distances.std() / distances.mean(), abs=1e-6)
        assert landmarks.mapping_direction_spread[p] == pytest.approx(1 - np.linalg.norm(mean), abs=1e-6)
        np.testing.assert_allclose(landmarks.mapping_direction[p], mean / np.linalg.norm(mean), atol=1e-6)


@pytest.mark.parametrize("with_descriptors", [False, True])
@pytest.mark.parametrize("compact", [False, True])
def test_saved_landmarks_load_again(tmp_path, model_dir, with_descriptors, compact):
    database = None
    if with_descriptors:
        model, keypoints = hand_written_model()
        descriptors = random_descriptors([len(k) for k in keypoints])
        database = write_database(tmp_path / "database.db", model, keypoints, descriptors)
    landmarks = load_colmap_landmarks(model_dir, database)
    landmarks.save(tmp_path / "a.npz", compact=compact)
    again = Landmarks.load(tmp_path / "a.npz")
    assert again.features == landmarks.features == ("sift" if with_descriptors else "")
    assert (again.descriptors is None) == (compact or not with_descriptors)
    for name, value in vars(landmarks).items():
        other = getattr(again, name)
        if other is not None and name != "described_by":
            assert other.dtype == value.dtype
            rtol = 0 if not compact or value.dtype.kind == "i" else 1e-7 if name == "points" else 5e-4
            np.testing.assert_allclose(other, value, rtol=rtol, atol=1e-7 if compact else 0)
    again.save(tmp_path / "b.npz", compact=compact)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_models_without_usable_points_are_rejected(tmp_path, model_dir):
    with pytest.raises(MapError):
        load_colmap_landmarks(model_dir, max_reprojection_error_px=-1)
    for name, point in (("empty", None), ("untracked", pycolmap.Point3D(xyz=np.ones(3), track=pycolmap.Track()))):
        model = hand_written_model(offsets_px=(), tracks=(), points=np.zeros((0, 3)))[0]
        if point is not None:
            model.add_point3D_with_id(1, point)
        (tmp_path / name).mkdir()
        model.write_binary(str(tmp_path / name))
        with pytest.raises(MapError):
            load_colmap_landmarks(tmp_path / name)


def without_points(path):
    with np.load(path) as stored:
        arrays = {name: array for name, array in stored.items() if name != "points"}
    np.savez(path, **arrays)


@pytest.mark.parametrize("edit", [Path.unlink, lambda path: path.write_bytes(path.read_bytes()[:500]), without_points])
def test_invalid_landmark_files_are_rejected(tmp_path, model_dir, edit):
    path = tmp_path / "landmarks.npz"
    load_colmap_landmarks(model_dir).save(path)
    edit(path)
    with pytest.raises(MapError):
        Landmarks.load(path)
