"""The mesh of a recording of a known room: its place, orientation and colours."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from tests.disks import file_limit

from scans.recordings import COLOR, HIGH, LOW, room, turned, walk, write_seven_scenes, write_tum
from wheretolook.geometry.poses import camera_centers, transform
from wheretolook.mapping.colmap_model import colmap_poses
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scans.config import RgbdConfig
from wheretolook.scans.fusion import make_scan
from wheretolook.utils.errors import ConfigError, MapError, MapWarning, SceneError, StorageError, TableError

VOXEL_M = 0.03
Y_DOWN = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # takes a world with y down to the room's


@pytest.fixture(scope="module")
def mesh():
    return room()


@pytest.fixture(scope="module")
def seven_scenes(mesh, tmp_path_factory):
    folder = tmp_path_factory.mktemp("seven") / "room"
    write_seven_scenes(folder, mesh, walk(), Y_DOWN)
    return folder


@pytest.fixture(scope="module")
def tum(mesh, tmp_path_factory):
    folder = tmp_path_factory.mktemp("tum") / "room"
    write_tum(folder, mesh, walk())
    return folder


def scan(folder, **options):
    return make_scan(RgbdConfig(folder=folder, **{"voxel_m": VOXEL_M, "max_depth_m": 5.0, **options}))


def copied(folder, to, every=1):
    to.mkdir()
    for path in sorted(folder.glob("*")):
        if int(path.name[6:12]) % every == 0:
            (to / path.name).write_bytes(path.read_bytes())
    return to


def distances_m(scanned, truth):
    """Distances of scanned vertices to the truth, and of points on walls that over three frames see to the scan."""
    caster = MeshRaycaster(truth)
    rng = np.random.default_rng(1)
    poses = walk()
    walls = rng.uniform(np.add(LOW, 0.1), np.subtract(HIGH, 0.1), (3000, 3))
    axis = rng.integers(0, 3, 3000)
    walls[np.arange(3000), axis] = np.stack([LOW, HIGH])[rng.integers(0, 2, 3000), axis]
    in_camera = transform(poses, walls)
    pixels = COLOR.project(in_camera)
    within = (in_camera[..., 2] > 0) & ((pixels > 6) & (pixels < (COLOR.width - 6, COLOR.height - 6))).all(-1)
    seen = (within & ~caster.occluded(camera_centers(poses), walls)).sum(0) > 3
    assert seen.sum() > 500
    to_scan = MeshRaycaster(scanned).distance_to_surface(walls[seen], 1.0)
    return caster.distance_to_surface(scanned.vertices, 1.0), to_scan


@pytest.mark.parametrize("offset", [(0, 0, 0), (5e6, 5e6, 300)])
def test_a_recording_of_7_scenes_is_the_room_within_a_voxel_wherever_its_origin(seven_scenes, mesh, tmp_path, offset):
    folder = copied(seven_scenes, tmp_path / "shifted")
    for path in folder.glob("*.pose.txt"):
        pose = np.loadtxt(path)
        pose[:3, 3] += offset
        np.savetxt(path, pose)
    result = scan(folder)
    assert len(result.frames) == 60 and result.frames.skipped == {}
    assert np.degrees(np.arccos(result.up @ Y_DOWN.T @ (0, 0, 1))) < 1.0  # z of the room, in the recording's world
    # from the scan's world to the room's: the offset undone, and the upright rotation
    place = result.mesh.origin - result.rotation @ offset
    vertices = (result.mesh.vertices + place) @ result.rotation @ Y_DOWN.T
    moved = replace(result.mesh, vertices=vertices.astype(np.float32), origin=np.zeros(3))
    to_room, to_scan = distances_m(moved, mesh)
    assert np.quantile(to_room, 0.99) < VOXEL_M and np.median(to_room) < VOXEL_M / 4
    assert np.quantile(to_scan, 0.9) < VOXEL_M
    truth, rendered = (WarpRenderer(one).render(COLOR, walk()[[10]]).rgb.astype(float) for one in (mesh, moved))
    seen = rendered.any(-1)
    assert seen.mean() > 0.55 and np.abs(truth - rendered)[seen].mean() < 28


@pytest.mark.parametrize(("appearance", "most_off"), [("texture", 16), ("colors", 28)])
def test_a_recording_of_tum_is_the_room_in_its_own_world(tum, mesh, appearance, most_off):
    found = scan(tum, up="auto", appearance=appearance)
    assert len(found.frames) == 60 and found.frames.depth_scale == 5000
    assert np.array_equal(found.rotation, np.eye(3))  # its z is up to within a degree
    to_room, to_scan = distances_m(found.mesh, mesh)
    assert np.quantile(to_room, 0.99) < VOXEL_M and np.quantile(to_scan, 0.9) < VOXEL_M
    poses = walk()[[10, 40]]
    truth, rendered = (WarpRenderer(one).render(COLOR, poses).rgb.astype(float) for one in (mesh, found.mesh))
    seen = rendered.any(-1)
    assert seen.mean() > 0.85
    assert np.abs(truth - rendered)[seen].mean() < most_off  # levels of 255; the mean level of an image is 45 off
    assert (len(found.mesh.textures) > 3) == (appearance == "texture")


@pytest.mark.parametrize(
    ("written", "depth_scale", "suggested"),
    [({"depth_scale": 5000.0}, 1000.0, "depth_scale (4[89]|5[012])"), ({"poses_scale": 1000.0}, 0.0, "depth_scale 1")],
)
def test_depth_in_another_unit_is_rejected_with_the_right_scale(mesh, tmp_path, written, depth_scale, suggested):
    write_seven_scenes(tmp_path / "room", mesh, walk(30), **written)
    with pytest.raises(SceneError, match=suggested):
        scan(tmp_path / "room", depth_scale=depth_scale)


def edited(pattern, edit):
    """A change of all files of a pattern."""

    def change(folder):
        for path in folder.glob(pattern):
            edit(path)

    return change


def depth_of_8_bits(path):
    cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))


def as_tum(rgb, truth="1 0 0 0 0 0 0 1\n"):
    def change(folder):
        (folder / "a").write_text("")
        for name, text in (("rgb", rgb), ("depth", "1 a\n"), ("groundtruth", truth)):
            (folder / f"{name}.txt").write_text(text)

    return change


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (edited("*.pose.txt", lambda path: np.savetxt(path, np.linalg.inv(np.loadtxt(path)))), SceneError),
        (edited("*.pose.txt", Path.unlink), SceneError),
        (edited("*.depth.png", depth_of_8_bits), SceneError),
        (edited("*", Path.unlink), SceneError),
        (as_tum("1 ../a\n"), ConfigError),
        (as_tum("1.0 a.png b.png\n"), SceneError),
        (as_tum("1 a\n", truth="1 1e300 0 0 0 0 0 1\n"), SceneError),
        (as_tum("1 a\n" * 600_000), TableError),
    ],
)
def test_invalid_recordings_are_rejected(seven_scenes, tmp_path, change, error):
    folder = copied(seven_scenes, tmp_path / "some", every=2)
    change(folder)
    with pytest.raises(error):
        scan(folder)


def test_frames_that_cannot_be_used_are_counted(seven_scenes, tmp_path):
    folder = copied(seven_scenes, tmp_path / "some", every=2)
    (folder / "frame-000000.pose.txt").write_text("-inf " * 16)
    (folder / "frame-000002.pose.txt").unlink()
    (folder / "frame-000004.depth.png").unlink()
    cv2.imwrite(str(folder / "frame-000006.depth.png"), np.full((120, 160), 65535, dtype=np.uint16))
    cv2.imwrite(str(folder / "frame-000008.color.png"), np.zeros((60, 80, 3), dtype=np.uint8))
    color = folder / "frame-000010.color.png"
    color.write_bytes(color.read_bytes()[:100])
    found = scan(folder)
    assert len(found.frames) == 30 - 6
    assert found.frames.skipped == {
        "whose pose is lost (not finite, or no rotation)": 1,
        "without a pose": 1,
        "without a depth image": 1,
        "without depth": 1,
        "of another size": 1,
        "with an image that cannot be read": 1,
    }


def test_up_can_be_given_and_a_wrong_one_is_warned_of(seven_scenes):
    with warnings.catch_warnings():
        warnings.simplefilter("error", MapWarning)
        found = scan(seven_scenes, up="-y", max_frames=30)
    assert len(found.frames) == 30
    assert np.allclose(found.rotation @ (0, -1, 0), (0, 0, 1))
    with pytest.warns(MapWarning, match="90 degrees"):
        found = scan(seven_scenes, up="0 0 2", max_frames=30)
    assert np.array_equal(found.rotation, np.eye(3))
    for wrong in ("w", "0 0 0", "1 2", "nan 1 1"):
        with pytest.raises(ConfigError):
            RgbdConfig(up=wrong)


def model_of(names, poses, points, scale=1.0):
    """A COLMAP model of images with poses that observe points (N, 3) where these are in the image."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, **COLOR.colmap.record()))
    tracks = [pycolmap.Track() for _ in points]
    for number, (name, pose) in enumerate(zip(names, poses, strict=True), 1):
        in_camera = transform(pose, points)
        pixels = COLOR.project(in_camera)
        seen = np.flatnonzero((in_camera[:, 2] > 0) & COLOR.in_image(pixels))
        image = pycolmap.Image(name=name, keypoints=pixels[seen], camera_id=1, image_id=number)
        cam_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), scale * pose[:, 3])
        model.add_image_with_trivial_frame(image, cam_from_world)
        for index, k in enumerate(seen):
            tracks[k].add_element(number, index)
    for point, track in zip(points, tracks, strict=True):
        if track.length() >= 2:
            model.add_point3D(scale * point, track)
    return model


def test_poses_of_a_model_replace_those_of_the_recording(seven_scenes, mesh, tmp_path):
    folder = copied(seven_scenes, tmp_path / "some")
    edited("*.pose.txt", Path.unlink)(folder)
    names = [f"frame-{i:06d}.color.png" for i in range(50)]  # ten images were not placed
    y = np.random.default_rng(0).uniform(LOW, HIGH, (300, 3))
    y[:, 0] = LOW[0]  # points of a wall
    poses = turned(walk(), Y_DOWN)[:50]
    for scale in (1.0, 3.0):
        (tmp_path / f"{scale}").mkdir()
        model_of(names, poses, y @ Y_DOWN, scale).write_binary(str(tmp_path / f"{scale}"))
    found = scan(folder, model=tmp_path / "1.0")
    assert found.frames.skipped == {"without a pose in the model": 10}
    with file_limit(100), pytest.raises(StorageError):
        found.save_model(tmp_path / "frames")
    found.save_model(tmp_path / "frames")
    upright = colmap_poses(tmp_path / "frames")
    assert np.allclose(upright[:, :, :3] @ found.rotation, poses[:, :, :3], atol=1e-6)
    there = MeshRaycaster(found.mesh).distance_to_surface(y @ Y_DOWN @ found.rotation.T, 1.0)
    assert np.median(there) < VOXEL_M  # the model's points lie on the scan
    with pytest.raises(SceneError):
        scan(folder, model=tmp_path / "3.0")
    with pytest.raises(MapError):
        scan(folder, model=tmp_path)


def test_depths_are_corrected_by_the_landmarks_of_a_model(seven_scenes, mesh, tmp_path):
    folder = copied(seven_scenes, tmp_path / "off")
    for path in folder.glob("*.depth.png"):
        units = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(float)
        read = np.where(
            units == 65535, 65535, 1 / (1.02 / np.maximum(units / 1000, 1e-3) - 0.025) * 1000
        )  # +7 cm at 2 m
        cv2.imwrite(str(path), np.rint(read).astype(np.uint16))
    rng = np.random.default_rng(0)
    names = [f"frame-{i:06d}.color.png" for i in range(60)]
    walls = rng.uniform(LOW, HIGH, (600, 3))
    walls[:300, 0] = LOW[0]
    walls[300:, 1] = HIGH[1]
    model_of(names, turned(walk(), Y_DOWN), walls @ Y_DOWN, 1.0).write_binary(str(tmp_path))
    found = scan(folder, model=tmp_path, appearance="colors")
    correction = found.report()["depth_correction"]
    assert correction["factor"] == pytest.approx(1 / 1.02, abs=5e-3)
    assert correction["offset_per_m"] == pytest.approx(0.025 / 1.02, abs=4e-3)
    to_room = Y_DOWN @ found.rotation.T
    moved = replace(found.mesh, vertices=(found.mesh.vertices @ to_room.T).astype(np.float32))
    assert np.median(distances_m(moved, mesh)[0]) < VOXEL_M / 4
