"""Landmarks of COLMAP models written by hand with pycolmap, with attributes worked out by hand."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from colmap_models import camera, model_of
from wheretolook.features.extractor import quantize_descriptors, unit_descriptors
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks, max_cosine_to_other
from wheretolook.mapping.map import Map
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
    """The model, and the keypoints of its images, one unused at the front."""
    keypoints = [[np.array([1.0 + i, 2.0])] for i in range(3)]
    seen = [[] for _ in points]
    for row, (point, track, offset) in enumerate(zip(points, tracks, offsets_px, strict=True)):
        for image in track:
            seen[row].append((image, len(keypoints[image])))
            keypoints[image].append(project(point, image) + np.array([offset, 0]))
    cameras = [camera(number, "SIMPLE_PINHOLE", 640, 480, focal_px, 320, 240) for number, focal_px in FOCAL_PX.items()]
    poses = poses_looking_along(CENTERS, np.tile([0.0, 1.0, 0.0], (3, 1)))
    images = [(f"{i}.png", CAMERA_OF[i], pose, np.array(keypoints[i])) for i, pose in enumerate(poses)]
    model = model_of(cameras, images, zip(points, seen, strict=True), id_step=10)
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
    assert_array_equal(landmarks.ids, [10, 20, 40])
    assert_allclose(landmarks.points, POINTS[[0, 1, 3]], atol=1e-12)
    assert_array_equal(landmarks.track_length, [3, 2, 2])
    assert_allclose(landmarks.reprojection_error_px, [0, 0.3, 0], atol=1e-4)
    # Point 10 is 2 m ahead of the middle camera, the outer ones stand 2 m to its sides: 45 degrees each way.
    # Point 20 from (0, 0, 1) is (1, 4, 1) and from (2, 0, 1) is (-1, 4, 1): cos = 16 / 18.
    angles = [90, np.degrees(np.arccos(16 / 18)), np.degrees(np.arctan(4 / 5))]
    assert_allclose(landmarks.triangulation_angle_deg, angles, rtol=1e-5)
    assert landmarks.descriptors is None and np.isnan(landmarks.ambiguity).all()
    kinds = [landmarks.ids, landmarks.points, landmarks.track_length, landmarks.mapping_direction]
    assert [k.dtype for k in kinds] == [np.int64, np.float64, np.int32, np.float32]


def test_descriptors_are_means_over_the_track(tmp_path, model_dir):
    model, keypoints = hand_written_model()
    descriptors = random_descriptors([len(k) for k in keypoints])
    database = write_database(tmp_path / "database.db", model, keypoints, descriptors)
    landmarks = load_colmap_landmarks(model_dir, database, max_reprojection_error_px=0.5)
    # Keypoints in the order in which the points were added, after an unused one.
    seen = [[(0, 1), (1, 1), (2, 1)], [(1, 2), (2, 2)], [(0, 3), (2, 4)]]
    expected = []
    for track in seen:
        unit = [d / np.linalg.norm(d) for d in (descriptors[i][k].astype(np.float64) for i, k in track)]
        mean = np.mean(unit, axis=0)
        expected.append(np.minimum(np.rint(512 * mean / np.linalg.norm(mean)), 255))
    assert_array_equal(landmarks.descriptors, np.array(expected))
    assert landmarks.descriptors.dtype == np.uint8
    unit = np.array(expected) / np.linalg.norm(expected, axis=1, keepdims=True)
    cosine = unit @ unit.T - 2 * np.eye(3)
    assert_allclose(landmarks.ambiguity, cosine.max(1), atol=1e-6)


@pytest.mark.filterwarnings("ignore::wheretolook.utils.errors.MapWarning")
def test_sift_in_a_database_above_the_model_is_used(tmp_path, model_dir):
    model, keypoints = hand_written_model()
    descriptors = random_descriptors([len(k) for k in keypoints])
    database = write_database(tmp_path / "database.db", model, keypoints, descriptors)
    assert Map.open(model_dir).landmarks.features == "sift"
    database.unlink()
    write_database(database, model, [k[:2] for k in keypoints], [d[:2] for d in descriptors])  # of another model
    with pytest.warns(MapWarning, match="disagree on the number"):
        assert Map.open(model_dir).landmarks.features == ""
    with pytest.raises(MapError):
        Map.open(model_dir, database)


@pytest.mark.parametrize("n", [2, 500, 3001])
def test_ambiguity_against_brute_force(n):
    descriptors = random_descriptors([n])[0]
    descriptors[-1] = descriptors[0]  # twins, in different blocks if there are several
    unit = descriptors / np.linalg.norm(descriptors.astype(np.float64), axis=1, keepdims=True)
    rows = np.unique(np.linspace(0, n - 1, 200).astype(int))
    cosine = unit[rows] @ unit.T
    cosine[np.arange(len(rows)), rows] = -1
    ambiguity = max_cosine_to_other(descriptors)
    assert_allclose(ambiguity[rows], cosine.max(1), atol=1e-6)
    assert ambiguity[0] == ambiguity[-1] == pytest.approx(1, abs=1e-6)


def test_long_and_short_tracks_against_a_plain_loop(tmp_path):
    """Attributes of many random landmarks, one observation at a time."""
    rng = np.random.default_rng(4)
    n_images = 40
    n_points = 300
    centers = rng.uniform(-3, 3, (n_images, 3))
    points = rng.uniform(-3, 3, (n_points, 3)) + np.array([0, 12, 0])
    tracks = [rng.choice(n_images, rng.integers(2, n_images), replace=False) for _ in range(n_points)]
    poses = poses_looking_along(centers, np.tile([0.0, 1.0, 0.0], (n_images, 1)))
    images = [(f"{i}", 1, pose, np.zeros((n_points, 2))) for i, pose in enumerate(poses)]
    seen = [(point, [(i, p) for i in track]) for p, (point, track) in enumerate(zip(points, tracks, strict=True))]
    model = model_of([camera(1, "PINHOLE", 640, 480, 300, 300, 320, 240)], images, seen, 0.1)
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
        assert_allclose(landmarks.mapping_direction[p], mean / np.linalg.norm(mean), atol=1e-6)


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
            assert_allclose(other, value, rtol=rtol, atol=1e-7 if compact else 0)
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
