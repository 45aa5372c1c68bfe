"""Checks of COLMAP's model files around pycolmap's readers, and fast access to the points in them.

pycolmap trusts the counts in binary files and can loop for hours or run out of memory on a corrupt one, so these are
compared with the file's size before it reads, and values are checked afterwards. The formats are those of https://colmap.github.io/format.html.
"""

from __future__ import annotations

import itertools
import re
from codecs import BOM_UTF8
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from struct import Struct
from struct import error as StructError
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from wheretolook.geometry.camera import MAX_SIDE_PX
from wheretolook.utils.errors import MapError
from wheretolook.utils.files import temporary_folder

REBUILD = "Copy or build the model again."
# A point without its track. The track's elements follow: image id and index of the keypoint, uint32 each.
POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("n", "<u8")])
_FILES = ("cameras", "images", "points3D", "rigs", "frames")
_UINT32 = Struct("<I")
_UINT64 = Struct("<Q")
_MAX_COORDINATE = 1e12  # of a point or a camera; its square is still finite in single precision
_ROTATION_TOLERANCE = 0.01  # of the entries of R R^T: some tools write few decimals
# Patterns in pycolmap's errors, and the file that they are about.
_FILES_BY_ERROR = (
    (r"Camera model|VerifyParams|cameras_|camera\.camera_id", "cameras"),
    ("point2D.point3D_id|line_stream[12]|utf-8", "images"),
    ("Image with ID|vector::|point3D.xyz", "points3D"),
    ("rig_from_world|data_id|unordered_map", "frames"),
    ("[Rr]ig|[Cc]amera|[Ss]ensor", "rigs"),
    ("[Ff]rame", "frames"),
)


def check_binary(folder: Path) -> None:
    """Raise MapError if counts in a folder's binary model do not match the files' sizes, or a point is not finite."""
    for name, record_length in _RECORD_LENGTHS.items():
        path = folder / f"{name}.bin"
        if path.is_file():  # models from before COLMAP 3.12 have no frames
            data = path.read_bytes()
            starts = _record_starts(data, record_length, path)
            if name == "points3D":
                check_coordinates(_point_heads(np.frombuffer(data, dtype=np.uint8), starts), path)


def check_coordinates(points: NDArray[Any], path: Path) -> None:
    """Raise MapError if points (P,) of dtype `POINT` are not finite or farther away than any scene."""
    wrong = points[~(np.abs(points["xyz"]) <= _MAX_COORDINATE).all(axis=1)]
    if len(wrong):
        problem = f"point {wrong[0]['id']} is NaN, infinite or too far away"
        raise MapError(problem, path=path, value=wrong[0]["xyz"].tolist(), fix="Leave such points out of the model.")


def read_points(path: Path) -> tuple[NDArray[Any], NDArray[np.uint32]]:
    """Read a points3D.bin: points (P,) of dtype `POINT`, sorted by id, and their tracks, (O, 2) image id and keypoint.

    Reading 500,000 points one by one with pycolmap takes 15 seconds.
    """
    data = np.fromfile(path, dtype=np.uint8)
    starts = _record_starts(data.tobytes(), _point_length, path)
    points = _point_heads(data, starts)
    order = np.argsort(points["id"])
    points = points[order]
    n = points["n"].astype(np.int64)
    track_start = starts[:-1][order] + POINT.itemsize
    at = np.repeat(track_start - 8 * (np.cumsum(n) - n), n) + 8 * np.arange(n.sum())
    return points, _records(data, at, np.dtype(("<u4", 2)))


@contextmanager
def without_marks(folder: Path, suffix: str) -> Iterator[Path]:
    """Yield a model's folder, or a copy of its texts without the byte-order marks that pycolmap cannot read."""
    texts = [path for name in _FILES if (path := folder / (name + suffix)).is_file()] if suffix == ".txt" else []
    if not any(map(_has_mark, texts)):
        yield folder
        return
    with temporary_folder() as copy:
        for path in texts:
            (copy / path.name).write_bytes(path.read_bytes().removeprefix(BOM_UTF8))
        yield copy


def check_text_complete(path: Path, n_read: int) -> None:
    """Raise MapError if fewer entries were read than the number that COLMAP writes at the top of a text file."""
    with path.open(errors="replace") as file:
        head = "".join(line for line in itertools.islice(file, 6) if line.startswith("#"))
    announced = re.search(r"# Number of \w+: (\d+)", head)
    if announced and n_read < int(announced[1]):
        raise MapError(f"the file is truncated: it announces {announced[1]}", path=path, value=n_read, fix=REBUILD)


def check_cameras_and_images(model: Any, folder: Path, suffix: str) -> None:
    """Raise MapError, which names the file, if a `pycolmap.Reconstruction` has an impossible camera or pose."""
    path = folder / f"cameras{suffix}"
    n_bytes = 8 + sum(24 + 8 * len(camera.params) for camera in model.cameras.values())
    if suffix == ".bin" and n_bytes != path.stat().st_size:
        raise MapError("the file is truncated or corrupt", path=path, value=f"not {n_bytes} bytes", fix=REBUILD)
    for number, camera in model.cameras.items():
        sides = (camera.width, camera.height)
        focal = camera.params[camera.focal_length_idxs()]
        if not (0 < min(sides) <= max(sides) <= MAX_SIDE_PX and np.isfinite(camera.params).all() and (focal > 0).all()):
            problem = f"camera {number} needs an image size, finite parameters and a positive focal length"
            raise MapError(problem, path=path, value=(*sides, *camera.params), fix="Correct the camera.")
    for number, image in model.images.items():
        _ = image.name  # raises UnicodeDecodeError if it is not in UTF-8
        if image.has_pose and not _is_pose(image.cam_from_world()):
            path = folder / f"frames{suffix}"
            path = path if path.is_file() else folder / f"images{suffix}"
            raise MapError(f"the pose of image {number} is not a rotation and translation", path=path, fix=REBUILD)


def _point_heads(data: NDArray[np.uint8], starts: NDArray[np.int64]) -> NDArray[Any]:
    """Points (P,) of dtype `POINT` in the bytes of a points3D.bin, without their tracks."""
    return _records(data, starts[:-1], POINT)


def _records(data: NDArray[np.uint8], starts: NDArray[np.int64], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Records of one type at offsets of bytes that need not be aligned."""
    if len(starts) == 0:
        return np.zeros(0, dtype=dtype)
    return sliding_window_view(data, dtype.itemsize)[starts].view(dtype.base).reshape(-1, *dtype.shape)


def _has_mark(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(BOM_UTF8)) == BOM_UTF8


def _is_pose(rigid: Any) -> bool:
    """Whether a `pycolmap.Rigid3d` is a rotation and a translation of usual size."""
    matrix = rigid.matrix()
    with np.errstate(over="ignore", invalid="ignore"):
        is_rotation = np.abs(matrix[:, :3] @ matrix[:, :3].T - np.eye(3)).max() <= _ROTATION_TOLERANCE
    return bool(is_rotation and np.abs(matrix[:, 3]).max() <= _MAX_COORDINATE)


def _record_starts(data: bytes, record_length: Callable[[bytes, int], int], path: Path) -> NDArray[np.int64]:
    """Offsets of the records after a file's count, and of its end. Raises MapError if they do not fill the file."""
    starts = [_UINT64.size]
    try:
        for _ in range(_UINT64.unpack_from(data)[0]):
            starts.append(starts[-1] + record_length(data, starts[-1]))
    except (StructError, IndexError, ValueError, OverflowError):
        starts.append(-1)
    if starts[-1] != len(data):
        raise MapError("the file is truncated or corrupt", path=path, value=f"{len(data)} bytes", fix=REBUILD)
    return np.array(starts, dtype=np.int64)


def model_error(error: Exception, folder: Path, suffix: str) -> MapError:
    """Convert an error of pycolmap about a model's files to a MapError that names the file, where the error does."""
    name = next((name for pattern, name in _FILES_BY_ERROR if re.search(pattern, str(error))), None)
    path = folder / f"{name}{suffix}" if name else folder
    return MapError(f"pycolmap cannot read the model: {error}", path=path, fix=REBUILD)


def _image_length(data: bytes, start: int) -> int:
    name_end = data.index(b"\0", start + 64) + 1
    return name_end + 8 + 24 * int(_UINT64.unpack_from(data, name_end)[0]) - start


def _point_length(data: bytes, start: int) -> int:
    return POINT.itemsize + 8 * int(_UINT64.unpack_from(data, start + POINT.itemsize - 8)[0])


def _frame_length(data: bytes, start: int) -> int:
    return 68 + 16 * int(_UINT32.unpack_from(data, start + 64)[0])


_RECORD_LENGTHS = {"images": _image_length, "points3D": _point_length, "frames": _frame_length}
