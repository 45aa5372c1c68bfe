"""COLMAP models of other versions and tools, with rigs, several cameras and doubtful frames."""

import sqlite3
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from colmap_models import camera
from mapping.marker_rooms import hand_held_poses
from mapping.test_landmarks import hand_written_model, random_descriptors, write_database
from synthetic_dataset import CAMERA, make_mapping_poses, make_scene
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import camera_centers, poses_looking_along
from wheretolook.geometry.similarity import Similarity
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.colmap_model import load_mapping_poses, model_arrays, read_model, save_mapping_poses
from wheretolook.mapping.config import place_name
from wheretolook.mapping.landmarks import load_colmap_landmarks
from wheretolook.mapping.map_frame import scale_warning, up_axis_warning
from wheretolook.utils.errors import MapError, MapWarning

pytestmark = pytest.mark.filterwarnings("error::wheretolook.utils.errors.MapWarning")


def written(model, folder, text=False):
    folder.mkdir(parents=True)
    (model.write_text if text else model.write_binary)(str(folder))
    return folder


def rig_model():
    """Two frames of a rig of two cameras 0.2 m apart that look along +y, with points 2 to 5 m ahead."""
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    for camera_id, width in ((1, 640), (2, 320)):
        model.add_camera(
            camera(camera_id, "SIMPLE_PINHOLE", width, 3 * width // 4, width / 2, width / 2, 0.375 * width)
        )
    sensors = [pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id) for camera_id in (1, 2)]
    rig.add_ref_sensor(sensors[0])
    rig.add_sensor(sensors[1], pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-0.2, 0, 0])))
    model.add_rig(rig)
    first_poses = poses_looking_along([[0.0, 0, 1], [1.0, 0, 1]], np.tile([0.0, 1, 0], (2, 1)))
    for frame_id, pose in enumerate(first_poses, 1):
        frame = pycolmap.Frame(frame_id=frame_id, rig_id=1)
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3])
        for sensor, camera_id in zip(sensors, (1, 2), strict=True):
            frame.add_data_id(pycolmap.data_t(sensor, 10 * frame_id + camera_id))
        model.add_frame(frame)
    points = np.column_stack([np.linspace(-1, 2, 12), np.linspace(2, 5, 12), np.linspace(0.5, 1.5, 12)])
    for frame_id in (1, 2):
        for camera_id in (1, 2):
            image = pycolmap.Image(
                name=f"cam{camera_id}/{frame_id}.png", camera_id=camera_id, image_id=10 * frame_id + camera_id
            )
            image.frame_id = frame_id
            model.add_image(image)
    for frame_id in (1, 2):
        model.register_frame(frame_id)
    for image_id, image in model.images.items():
        at = [image.camera.img_from_cam(image.cam_from_world() * point) for point in points]
        model.images[image_id].points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in at])
    for row, point in enumerate(points):
        track = pycolmap.Track()
        for image_id in model.images:
            track.add_element(image_id, row)
        model.add_point3D(point, track)
    return model


@pytest.mark.parametrize("text", [False, True])
def test_a_rig_of_two_cameras_asks_which_one_looks(tmp_path, text):
    folder = written(rig_model(), tmp_path / "rig", text)
    with pytest.raises(MapError):
        LocalizationMap.from_colmap(folder, scale=1)
    with pytest.raises(MapError):
        LocalizationMap.from_colmap(folder, camera=7, scale=1)
    found = LocalizationMap.from_colmap(folder, camera=2, scale=1)
    assert found.camera == PinholeCamera(320, 240, 160.0) and len(found.landmarks) == 12
    centers = camera_centers(found.mapping_poses.astype(np.float64))
    assert_allclose(centers, [[0, 0, 1], [0.2, 0, 1], [1, 0, 1], [1.2, 0, 1]], atol=1e-6)
    assert_array_equal(found.landmarks.track_length, 4)
    assert_allclose(found.landmarks.reprojection_error_px, 0, atol=1e-3)


def test_arrays_are_what_pycolmap_says_of_each_point(tmp_path):
    """Points are read from the file at once; ids here are in no order, and tracks of several lengths."""
    model = hand_written_model()[0]
    extra = pycolmap.Track()
    extra.add_element(1, 0)
    extra.add_element(3, 0)
    model.add_point3D_with_id(5, pycolmap.Point3D(xyz=np.array([1.0, 3.0, 0.5]), track=extra))
    model.update_point_3d_errors()
    arrays = model_arrays(read_model(written(model, tmp_path / "model")))
    assert list(arrays.point_ids) == [5, 10, 20, 30, 40]
    for row, point_id in enumerate(arrays.point_ids):
        point = model.points3D[int(point_id)]
        span = slice(*arrays.observation_start[row : row + 2])
        assert_array_equal(arrays.points[row], point.xyz)
        assert arrays.errors_px[row] == point.error
        elements = [(element.image_id, element.point2D_idx) for element in point.track.elements]
        images = arrays.image_ids[arrays.observation_image[span]]
        assert list(zip(images, arrays.observation_keypoint[span], strict=True)) == elements


@pytest.mark.parametrize("old", [False, True])
def test_all_points_are_landmarks_and_omitted_ones_are_counted(tmp_path, old):
    offsets_px = np.linspace(0, 3, 60)
    points = np.column_stack([np.linspace(-1, 1, 60), np.full(60, 3.0), np.ones(60)])
    model = hand_written_model(offsets_px=offsets_px, tracks=([0, 1, 2],) * 60, points=points)[0]
    model.add_point3D_with_id(9999, pycolmap.Point3D(xyz=np.array([0.0, 3.0, 1.0]), track=pycolmap.Track()))
    folder = written(model, tmp_path / "model")
    if old:  # models from before COLMAP 3.12 have no rigs and frames
        for name in ("rigs.bin", "frames.bin"):
            (folder / name).unlink()
    with pytest.warns(MapWarning, match="60 of 61 points"):
        kept = LocalizationMap.from_colmap(folder, PinholeCamera(), scale=1)
    assert len(kept.landmarks) == 60
    read = read_model(folder)
    read.update_point_3d_errors()
    n_bad = sum(point.error > 0.5 for point in read.points3D.values() if point.track.length())
    assert 0 < n_bad < 60
    with pytest.warns(MapWarning, match=f"{60 - n_bad} of 61 points"):
        fewer = LocalizationMap.from_colmap(folder, PinholeCamera(), scale=1, max_reprojection_error_px=0.5)
    assert len(fewer.landmarks) == 60 - n_bad


def test_missing_and_incomplete_models_are_rejected(tmp_path):
    folder = written(hand_written_model()[0], tmp_path / "sparse" / "0")
    (folder / "images.bin").unlink()
    for path in (tmp_path / "nowhere", tmp_path / "sparse", folder):
        with pytest.raises(MapError):
            read_model(path)


def test_a_database_gives_ambiguity_and_is_not_written_to(tmp_path):
    model, keypoints = hand_written_model()
    folder = written(model, tmp_path / "model")
    database = write_database(tmp_path / "db.db", model, keypoints, random_descriptors([len(k) for k in keypoints]))
    expected = load_colmap_landmarks(folder, database).ambiguity
    assert np.isfinite(expected).all()
    with sqlite3.connect(database) as db:  # as COLMAP 3 wrote it
        db.execute("ALTER TABLE descriptors DROP COLUMN type")
        for table in ("frame_data", "frames", "rig_sensors", "rigs"):
            db.execute(f"DROP TABLE {table}")
        db.execute("PRAGMA user_version = 3900")
    db.close()
    before = database.read_bytes()
    found = LocalizationMap.from_colmap(folder, camera=1, database=database, scale=1)
    assert_array_equal(found.landmarks.ambiguity, expected)
    assert database.read_bytes() == before and sorted(path.name for path in tmp_path.iterdir()) == ["db.db", "model"]


@pytest.mark.parametrize("change", ["DELETE FROM descriptors", "UPDATE descriptors SET type = 9"])
def test_without_sift_descriptors_ambiguity_is_unknown(tmp_path, change):
    model, keypoints = hand_written_model()
    folder = written(model, tmp_path / "model")
    database = write_database(tmp_path / "db.db", model, keypoints, random_descriptors([len(k) for k in keypoints]))
    with sqlite3.connect(database) as db:
        db.execute(change)
    db.close()
    with pytest.warns(MapWarning):
        landmarks = load_colmap_landmarks(folder, database)
    assert landmarks.descriptors is None and np.isnan(landmarks.ambiguity).all()


def test_features_in_hdf5_of_hloc(tmp_path):
    h5py = pytest.importorskip("h5py")
    model, keypoints = hand_written_model()
    folder = written(model, tmp_path / "model")
    descriptors = random_descriptors([len(k) for k in keypoints])
    database = write_database(tmp_path / "db.db", model, keypoints, descriptors)
    with h5py.File(tmp_path / "feats.h5", "w") as file:
        for i in range(3):
            group = file.create_group(f"{i}.png")
            group["keypoints"] = keypoints[i] - 0.5  # hloc counts from the middle of the first pixel
            lengths = np.linalg.norm(descriptors[i].astype(np.float64), axis=1)
            group["descriptors"] = (descriptors[i] / lengths[:, None]).T
    found, expected = (load_colmap_landmarks(folder, path) for path in (tmp_path / "feats.h5", database))
    assert_allclose(found.ambiguity, expected.ambiguity, atol=0.01)


def test_scale_and_axes_are_doubted_where_they_are_implausible():
    poses = hand_held_poses(40)
    centers = camera_centers(poses)
    for distance_m in (0.5, 2.5, 30.0):
        assert scale_warning(np.full(100, distance_m), centers) == ""
    assert scale_warning(np.full(100, 37 * 2.5), 37 * centers) and scale_warning(np.full(100, 2.5 / 37), centers / 37)
    assert scale_warning(np.full(100, 20.0), 110 * centers)  # cameras metres apart
    assert scale_warning(np.full(100, 2.5), centers[:1]) == ""  # one camera has no distance from others
    assert up_axis_warning(poses) == ""
    for turn in ([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.diag([1, -1, -1])):
        assert up_axis_warning(np.concatenate([poses[:, :, :3] @ np.array(turn, float).T, poses[:, :, 3:]], axis=2))
    # a user who copies the direction from the warning states it in the map's own frame
    turned = Similarity(rotation=np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
    assert "(-0.01 0.00 1.00), 90 degrees from (0.00 1.00 0.00)" in up_axis_warning(
        turned.apply_to_poses(poses), turned
    )
    above = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0), [30.0]), -1).reshape(-1, 3)
    assert up_axis_warning(poses_looking_along(above, np.tile([1e-3, 0, -1.0], (25, 1)))) == ""  # looking down


@pytest.mark.parametrize(
    ("folder", "name"),
    [
        ("/data/fox/images", "fox"),
        ("/data/fox/sparse/0", "fox"),
        ("/data/demo/room-1/map", "room-1"),
        ("/data/kitchen", "kitchen"),
        ("/0", "model"),
    ],
)
def test_places_are_named_by_the_folder_that_has_a_name(folder, name):
    assert place_name(Path(folder)) == name


# Poses of mapping images: stored, read back, and read from the COLMAP model where there is no file of them.


@pytest.fixture
def scene(tmp_path):
    """A scene without a COLMAP model, as of a release."""
    return make_scene(tmp_path / "scene", "train", seed=0, n_locations=3, n_directions=4, n_landmarks=20)


def test_poses_come_back_from_disk_and_give_the_same_bytes(tmp_path):
    poses = make_mapping_poses(3)
    path = tmp_path / "cameras.npz"
    save_mapping_poses(poses, path)
    np.testing.assert_array_equal(load_mapping_poses(path), poses.astype(np.float32))
    content = path.read_bytes()
    save_mapping_poses(load_mapping_poses(path), path)
    assert path.read_bytes() == content and [file.name for file in tmp_path.iterdir()] == ["cameras.npz"]


def test_poses_are_unknown_without_a_file(scene):
    stored = scene.localization_map(CAMERA).mapping_poses
    np.testing.assert_array_equal(stored, load_mapping_poses(scene.mapping_cameras))
    scene.mapping_cameras.unlink()
    assert scene.localization_map(CAMERA).mapping_poses is None


def test_invalid_files_are_rejected(scene):
    path = scene.mapping_cameras
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(MapError):
        scene.localization_map(CAMERA)
    path.unlink()
    with pytest.raises(MapError):
        load_mapping_poses(path)
