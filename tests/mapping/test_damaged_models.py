"""Corrupt COLMAP models give a typed error that names the file, without delay."""

import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest

import wheretolook
from mapping.test_own_models import rig_model, written
from wheretolook.mapping.colmap_model import colmap_poses, read_model, registered_names
from wheretolook.utils.errors import MapError, MapWarning

NAN = float("nan")
# File, offset in the binary model of `rig_model`, layout and value of the change.
CHANGES = [
    ("rigs", 12, "<I", 4_000_000_000),  # sensors of a rig
    ("frames", 72, "<I", 4_000_000_000),  # images of a frame
    ("images", 0, "<Q", 2**62),
    ("points3D", 8 + 43, "<Q", 2**63),  # length of a track
    ("points3D", 16, "<d", 1e300),
    ("points3D", 16, "<d", NAN),
    ("cameras", 16, "<Q", 2**40),
    ("cameras", 12, "<i", 99),  # camera model
    *[("cameras", 32, "<d", focal) for focal in (NAN, 0.0, -320.0)],
    ("points3D", 8 + 51, "<I", 99),  # image of a track
]


@pytest.mark.parametrize(("name", "offset", "layout", "value"), CHANGES)
def test_corrupt_binary_models_are_rejected_by_file(tmp_path, name, offset, layout, value):
    path = written(rig_model(), tmp_path / "model") / f"{name}.bin"
    content = bytearray(path.read_bytes())
    struct.pack_into(layout, content, offset, value)
    path.write_bytes(content)
    with pytest.raises(MapError) as caught:
        read_model(path.parent)
    assert caught.value.path == path and caught.value.fix


def test_frames_with_images_that_are_missing_are_older_than_the_images(tmp_path):
    path = written(rig_model(), tmp_path / "model", text=True)
    with (path / "frames.txt").open("a") as file:
        file.write("99 1 1 0 0 0 0 0 0 1 CAMERA 1 999\n")
    expected = written(rig_model(), tmp_path / "expected", text=True)
    (expected / "frames.txt").unlink()
    (expected / "rigs.txt").unlink()
    with pytest.warns(MapWarning, match="frames"):
        found = read_model(path)
    np.testing.assert_array_equal(colmap_poses(path, found), colmap_poses(expected, read_model(expected)))


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("rigs", "1 2 CAMERA", "1 4000000000 CAMERA"),
        ("frames", " 2 CAMERA 1 11", " 4000000000 CAMERA 1 11"),
        ("frames", "1 1 0.707", "1 1 nan 0.707"),
        ("cameras", "640 480 320 ", "640 480 -320 "),
        ("cameras", "SIMPLE_PINHOLE", "MAGIC"),
        ("cameras", "640 480 320 ", "wide 480 320 "),
        ("images", "1 0.707", "one 0.707"),
        ("points3D", "1 -1 2 0.5", "1 1e300 2 0.5"),
    ],
)
def test_corrupt_text_models_are_rejected_by_file(tmp_path, name, old, new):
    path = written(rig_model(), tmp_path / "model", text=True) / f"{name}.txt"
    content = path.read_text()
    assert old in content
    path.write_text(content.replace(old, new, 1))
    with pytest.raises(MapError) as caught:
        read_model(path.parent)
    assert caught.value.path == path


def test_text_models_with_marks_and_ends_of_lines_of_windows(tmp_path):
    folder = written(rig_model(), tmp_path / "model", text=True)
    for path in folder.glob("*.txt"):
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    read, model = read_model(folder), rig_model()
    np.testing.assert_array_equal(colmap_poses(folder, read), colmap_poses(folder, model))
    assert registered_names(read) == registered_names(model)
    assert read.num_points3D() == model.num_points3D()


@pytest.mark.parametrize("name", ["points3D.bin", "frames.bin", "images.bin", "points3D.txt", "frames.txt"])
def test_sparse_files_of_terabytes_are_not_read(tmp_path, name):
    """A billion records of zeros are announced; the file takes no space on the disk."""
    folder = written(rig_model(), tmp_path / "model", text=name.endswith("txt"))
    with (folder / name).open("r+b") as file:
        if name.endswith("bin"):
            file.truncate(0)
            file.write(struct.pack("<Q", 10**9))
        file.truncate(2**41)
    with pytest.raises(MapError) as caught:
        read_model(folder)
    assert caught.value.path == folder / name


def test_a_frame_whose_quaternion_has_length_0(tmp_path):
    """Its matrix would be the identity."""
    path = written(rig_model(), tmp_path / "model") / "frames.bin"
    content = bytearray(path.read_bytes())
    content[16:48] = bytes(32)
    path.write_bytes(content)
    with pytest.raises(MapError, match="rotation") as caught:
        read_model(path.parent)
    assert caught.value.path == path


@pytest.mark.parametrize("text", [False, True])
def test_poses_of_images_replace_frames_that_contradict_the_points(tmp_path, text):
    """Programs from before COLMAP 3.12 write cameras, images and points, and leave older rigs and frames in the folder."""
    older = rig_model()
    older.transform(pycolmap.Sim3d(3.0, pycolmap.Rotation3d(np.array([0.0, 0, 0.6, 0.8])), np.array([5.0, 1, 2])))
    folder = written(rig_model(), tmp_path / "model", text)
    expected = colmap_poses(folder)
    (frames,) = folder.glob("frames.*")
    frames.write_bytes((written(older, tmp_path / "older", text) / frames.name).read_bytes())
    with pytest.warns(MapWarning, match="4 of 4 images"):
        model = read_model(folder)
    np.testing.assert_allclose(colmap_poses(folder, model), expected, atol=1e-9)
    points = next(folder.glob("points3D.*"))
    points.write_bytes((tmp_path / "older" / points.name).read_bytes())
    assert colmap_poses(folder, read_model(folder)).shape == (4, 3, 4)  # points and frames are of one reconstruction
    for path in (frames, frames.with_name(f"rigs{frames.suffix}")):
        path.unlink()
    with pytest.raises(MapError, match="contradict one another"):
        read_model(folder)


def test_observations_in_pixels_of_larger_images_are_reported(tmp_path):
    model = rig_model()
    for camera in model.cameras.values():
        camera.rescale(0.25)
    with pytest.warns(MapWarning, match="4 times as large"):
        assert read_model(written(model, tmp_path / "model")).num_points3D() == 12


FLIPS = """
import random, resource, sys
from pathlib import Path
from wheretolook.mapping.colmap_model import colmap_poses, model_arrays, read_model
from wheretolook.utils.errors import MapError
import numpy as np, pycolmap
resource.setrlimit(resource.RLIMIT_AS, (4 << 30,) * 2)
resource.setrlimit(resource.RLIMIT_CPU, (60, 60))
draw = random.Random(21)
for folder in map(Path, sys.argv[1:]):
    files, counts = sorted(folder.iterdir()), [0, 0]
    for _ in range(100):
        path = draw.choice(files)
        whole = path.read_bytes()
        bit = draw.randrange(8 * len(whole))
        flipped = bytearray(whole)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        try:
            model = read_model(folder)
            assert np.isfinite(model_arrays(model).points).all() and np.isfinite(colmap_poses(folder, model)).all()
            counts[0] += 1
        except MapError as error:
            assert Path(error.path).parent in (folder, folder.parent), (path, bit, error)
            counts[1] += 1
        path.write_bytes(whole)
    print(*counts)
"""


def test_flipped_bits_are_typed_errors_or_numbers(tmp_path):
    """In a process with limits on memory and time: a library in C++ that gives up would take this one along."""
    folders = [str(written(rig_model(), tmp_path / kind, text=kind == "text")) for kind in ("binary", "text")]
    env = {**os.environ, "PYTHONPATH": str(Path(wheretolook.__file__).parents[1])}
    done = subprocess.run([sys.executable, "-c", FLIPS, *folders], capture_output=True, text=True, timeout=120, env=env)
    assert done.returncode == 0, done.stderr[-3000:]
    counts = np.array([line.split() for line in done.stdout.splitlines() if line[:1].isdigit()], dtype=int)
    assert counts.shape == (2, 2) and (counts > 15).all()
