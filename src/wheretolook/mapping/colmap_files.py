"""Checks the files of a COLMAP model before pycolmap reads them, so that an error names the file and what is wrong.

pycolmap believes every count that a file tells: from a damaged one it may not come back. The formats are those of
https://colmap.github.io/format.html.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from struct import Struct
from typing import Any, NoReturn

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from wheretolook.geometry.camera import MAX_SIDE_PX
from wheretolook.utils.errors import MapError

REBUILD = "Copy or build the model again."
# A point, which the track's elements follow: image id and index of the keypoint, uint32 each.
POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("n", "<u8")])
_TRACK_LENGTH = Struct("<Q")
_POINT_2D = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
_MAX_COORDINATE = 1e12  # of a point or a camera: its square is still a number in single precision
# What pycolmap says of a model whose files contradict one another, and the file that says it.
_CONTRADICTIONS = (
    ("point2D.point3D_id", "images"),
    ("Image with ID|vector::|point3D.xyz", "points3D"),
    ("[Rr]ig|[Cc]amera", "rigs"),
    ("[Ff]rame|unordered_map", "frames"),
)
_SENSORS = ("CAMERA", "IMU")
_UNIT = 0.01  # by which the length of a quaternion may differ from 1: some tools write few decimals


@dataclass(frozen=True)
class _Found:
    """What the files checked so far tell, for those that refer to it."""

    cameras: set[int] = field(default_factory=set)
    images: dict[int, int] = field(default_factory=dict)  # number of keypoints by image_id
    rigs: dict[int, set[int]] = field(default_factory=dict)  # cameras by rig_id


def check_binary(folder: Path, said: Path, suffix: str = ".bin") -> None:
    """Raise MapError if the binary model in a folder is truncated, corrupt, or holds what no model can.

    Errors name the file of that name in `said`, with `suffix`: of a text model, its binary copy is checked.
    """
    found = _Found()
    checks = {"cameras": _cameras, "images": _images, "points3D": _points, "rigs": _rigs, "frames": _frames}
    for name, check in checks.items():
        source = folder / f"{name}.bin"
        if source.is_file():  # models from before COLMAP 3.12 have no rigs and frames
            check(_Bytes(source.read_bytes(), said / (name + suffix)), found)


def blame_binary(folder: Path) -> None:
    """Raise MapError if what pycolmap cannot have read are the tracks, which `check_binary` leaves to it."""
    found = _Found()
    for name, check in (("cameras", _cameras), ("images", _images), ("points3D", _tracks)):
        path = folder / f"{name}.bin"
        check(_Bytes(path.read_bytes(), path), found)


def contradicting(error: Exception) -> str:
    """Name of the file, without suffix, that an error of pycolmap is about; empty if it tells nothing."""
    return next((name for says, name in _CONTRADICTIONS if re.search(says, str(error))), "")


def check_text(folder: Path) -> None:
    """Raise MapError if a text model's rigs, frames, cameras or images are no such lists.

    Points and keypoints have no counts to lie about, and are checked when they have been read.
    """
    for name, check in (("cameras", _camera_line), ("rigs", _rig_line), ("frames", _frame_line)):
        path = folder / f"{name}.txt"
        if path.is_file():
            _each_line(path, _lines(path), check)
    path = folder / "images.txt"
    _each_line(path, _lines(path, every_other=True), _image_line)


def blame_text(folder: Path) -> None:
    """Raise MapError that names the line which pycolmap cannot have read, if points or keypoints have one."""
    path = folder / "points3D.txt"
    _each_line(path, _lines(path), _point_line)
    path = folder / "images.txt"
    _each_line(path, _lines(path, every_other=True, first=False), _keypoint_line)


def check_text_count(path: Path, found: int) -> None:
    """Compare with the number that COLMAP writes at the top of a text file, if it is there."""
    with path.open(errors="replace") as file:
        head = "".join(line for line in itertools.islice(file, 6) if line.startswith("#"))
    told = re.search(r"# Number of \w+: (\d+)", head)
    if told and found < int(told[1]):
        raise MapError(f"the file is truncated: it tells of {told[1]}", path=path, value=found, fix=REBUILD)


def point_starts(data: bytes) -> NDArray[np.int64]:
    """Offsets of the points in the content of a points3D.bin, and where the last one ends; -1 if its end is missing."""
    count = _TRACK_LENGTH.unpack_from(data)[0]
    end = 8
    starts: list[int] = []
    for _ in range(count):
        if end + POINT.itemsize > len(data):
            return np.array([*starts, -1], dtype=np.int64)
        starts.append(end)
        end += POINT.itemsize + 8 * _TRACK_LENGTH.unpack_from(data, end + POINT.itemsize - 8)[0]
    return np.array([*starts, end if end <= len(data) else -1], dtype=np.int64)


def point_heads(data: NDArray[np.uint8], starts: NDArray[np.int64]) -> NDArray[Any]:
    """What a points3D.bin (bytes) tells of its points, (P,) of `POINT`, without the tracks."""
    if len(starts) < 2:
        return np.zeros(0, dtype=POINT)
    return sliding_window_view(data, POINT.itemsize)[starts[:-1]].view(POINT).reshape(-1)


def track_elements(data: NDArray[np.uint8], starts: NDArray[np.int64]) -> NDArray[np.uint32]:
    """The tracks of a points3D.bin (bytes), (O, 2) image id and index of the keypoint, track after track."""
    step = np.zeros(len(data) + 1, dtype=np.int8)  # up where a point begins, down where its track does
    step[starts[:-1]] += 1
    step[starts[:-1] + POINT.itemsize] -= 1
    in_track = np.cumsum(step[:-1], dtype=np.int8) == 0
    in_track[:8] = False
    return data[in_track].view("<u4").reshape(-1, 2)


class _Bytes:
    """A file's content, read from its beginning on. MapError where it ends too early."""

    def __init__(self, data: bytes, path: Path) -> None:
        self.data = data
        self.path = path
        self.at = 0

    def take(self, layout: Struct) -> tuple[Any, ...]:
        begin = self.skip(layout.size)
        return layout.unpack_from(self.data, begin)

    def skip(self, n_bytes: int) -> int:
        """Go on by so many bytes. Returns where they begin."""
        begin = self.at
        if begin + n_bytes > len(self.data):
            self.fail_whole()
        self.at += n_bytes
        return begin

    def count(self) -> range:
        return range(self.take(_COUNT)[0])

    def text(self) -> None:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            self.fail_whole()
        try:
            self.data[self.at : end].decode()
        except UnicodeDecodeError as error:
            value = self.data[self.at : end][:100]
            fix = "Write names in UTF-8."
            raise MapError("the name of an image is not text", path=self.path, value=value, fix=fix) from error
        self.at = end + 1

    def end(self) -> None:
        if self.at != len(self.data):
            self.fail_whole()

    def fail_whole(self) -> NoReturn:
        size = f"{len(self.data)} bytes"
        raise MapError("the file is truncated or corrupt", path=self.path, value=size, fix=REBUILD)


_COUNT = Struct("<Q")
_CAMERA = Struct("<IiQQ")
_POSE = Struct("<7d")
_IMAGE = Struct("<I7dI")
_RIG = Struct("<II")
_SENSOR = Struct("<iI")
_FRAME = Struct("<II")
_DATA = Struct("<iIQ")
_N = Struct("<I")
_HAS_POSE = Struct("<B")
_IS_CAMERA = 0  # COLMAP's number of this kind of sensor


def _cameras(file: _Bytes, found: _Found) -> None:
    for _ in file.count():
        number, model_id, width, height = file.take(_CAMERA)
        model = _models().get(model_id)
        if model is None:
            fix = "Update pycolmap, or export the model with another camera."
            raise MapError(f"camera {number} is of no known model", path=file.path, value=model_id, fix=fix)
        params = file.take(Struct(f"<{_params(model)[0]}d"))
        _check_camera(file.path, number, model, width, height, params)
        _add(file.path, "camera", found.cameras, number)
    file.end()


def _images(file: _Bytes, found: _Found) -> None:
    seen: set[int] = set()
    for _ in file.count():
        number, *pose, camera = file.take(_IMAGE)
        _check_pose(file.path, f"image {number}", pose)
        if camera not in found.cameras:
            raise MapError(f"image {number} is of no camera in the model", path=file.path, value=camera, fix=REBUILD)
        file.text()
        n = file.take(_COUNT)[0]
        keypoints = (
            np.frombuffer(file.data, _POINT_2D, n, file.skip(n * _POINT_2D.itemsize))["xy"] if n else np.empty(0)
        )
        if not np.isfinite(keypoints).all():
            raise MapError(f"a keypoint of image {number} is NaN or infinite", path=file.path, fix=REBUILD)
        _add(file.path, "image", seen, number)
        found.images[number] = n
    file.end()


def _points(file: _Bytes, found: _Found) -> None:
    if len(file.data) < 8:
        file.fail_whole()
    starts = point_starts(file.data)
    if starts[-1] != len(file.data):
        file.fail_whole()
    data = np.frombuffer(file.data, dtype=np.uint8)
    heads = point_heads(data, starts)
    wrong = ~(np.abs(heads["xyz"]) <= _MAX_COORDINATE).all(axis=1)
    if wrong.any():
        first = heads[np.flatnonzero(wrong)[0]]
        problem = f"point {first['id']} is NaN, infinite or too far away"
        fix = "Leave such points out of the model."
        raise MapError(problem, path=file.path, value=first["xyz"].tolist(), fix=fix)


def _tracks(file: _Bytes, found: _Found) -> None:
    data = np.frombuffer(file.data, dtype=np.uint8)
    for image, keypoint in track_elements(data, point_starts(file.data)).tolist():
        if keypoint >= found.images.get(image, 0):
            problem = "a point was observed by an image, or at a keypoint, that the model does not have"
            value = f"image {image}, keypoint {keypoint}"
            raise MapError(problem, path=file.path, value=value, fix=REBUILD)


def _rigs(file: _Bytes, found: _Found) -> None:
    for _ in file.count():
        rig, n_sensors = file.take(_RIG)
        cameras = found.rigs.setdefault(rig, set())
        for index in range(n_sensors):
            kind, sensor = file.take(_SENSOR)
            if kind == _IS_CAMERA and sensor not in found.cameras:
                raise MapError(f"rig {rig} has no camera of the model", path=file.path, value=sensor, fix=REBUILD)
            if kind == _IS_CAMERA:
                cameras.add(sensor)
            if index and file.take(_HAS_POSE)[0]:
                _check_pose(file.path, f"sensor {sensor} of rig {rig}", list(file.take(_POSE)))
    file.end()


def _frames(file: _Bytes, found: _Found) -> None:
    framed: set[int] = set()
    for _ in file.count():
        frame, rig = file.take(_FRAME)
        if rig not in found.rigs:
            raise MapError(f"frame {frame} is of no rig of the model", path=file.path, value=rig, fix=REBUILD)
        _check_pose(file.path, f"frame {frame}", list(file.take(_POSE)))
        for _ in range(file.take(_N)[0]):
            kind, sensor, image = file.take(_DATA)
            if kind == _IS_CAMERA:
                if sensor not in found.rigs[rig]:
                    problem = f"frame {frame} is of a camera that is not in its rig"
                    raise MapError(problem, path=file.path, value=sensor, fix=REBUILD)
                framed.add(image)
    file.end()
    alone = sorted(set(found.images) - framed)
    if alone:
        raise MapError("an image is in no frame", path=file.path, value=f"image {alone[0]}", fix=REBUILD)


def _add(path: Path, what: str, seen: set[int], number: int) -> None:
    if number in seen:
        raise MapError(f"two of the file have the same {what} id", path=path, value=number, fix=REBUILD)
    seen.add(number)


def _check_camera(path: Path, number: int, model: str, width: int, height: int, params: tuple[float, ...]) -> None:
    fix = "Give the model of images, with their size and focal length in pixels."
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
        raise MapError(f"camera {number}: no image has this size", path=path, value=(width, height), fix=fix)
    n, focal = _params(model)
    if len(params) != n or not np.isfinite(params).all() or not all(params[i] > 0 for i in focal):
        problem = f"camera {number}: {model} needs {n} finite parameters, and a positive focal length"
        raise MapError(problem, path=path, value=params, fix=fix)


def _check_pose(path: Path, what: str, pose: list[float]) -> None:
    """Raise MapError unless w, x, y, z is a quaternion of unit length, and the translation not too long."""
    values = np.array(pose)
    with np.errstate(over="ignore", invalid="ignore"):
        good = abs(np.sqrt((values[:4] ** 2).sum()) - 1) <= _UNIT and (np.abs(values[4:]) <= _MAX_COORDINATE).all()
    if not good:
        problem = f"the pose of {what} is no rotation and translation"
        raise MapError(problem, path=path, value=pose, fix=REBUILD)


@cache
def _models() -> dict[int, str]:
    """COLMAP's camera models by their number."""
    import pycolmap

    return {int(number): name for name, number in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}


@cache
def _params(model: str) -> tuple[int, tuple[int, ...]]:
    """How many parameters a camera model has, and which of them are focal lengths."""
    import pycolmap

    camera = pycolmap.Camera.create_from_model_name(1, model, 1.0, 1, 1)
    return len(camera.params), tuple(camera.focal_length_idxs())


def _lines(path: Path, every_other: bool = False, first: bool = True) -> Iterator[tuple[int, str]]:
    """Lines of a text file with their numbers, without comments; of images.txt the first or second of each pair."""
    is_first = True
    with path.open(errors="replace") as file:
        for number, line in enumerate(file, 1):
            if line.startswith("#") or (is_first and not line.strip()):
                continue
            if not every_other or is_first is first:
                yield number, line
            is_first = not is_first if every_other else True


def _each_line(path: Path, lines: Iterator[tuple[int, str]], check: Callable[[Path, list[str]], None]) -> None:
    for number, line in lines:
        try:
            check(path, line.split())
        except (ValueError, IndexError, OverflowError) as error:
            raise MapError(f"line {number} cannot be read", path=path, value=line.strip()[:100], fix=REBUILD) from error


def _whole(text: str) -> int:
    number = int(text)
    if number < 0:
        raise ValueError(text)
    return number


def _numbers(texts: list[str], n: int) -> list[float]:
    if len(texts) < n:
        raise IndexError(n)
    return [float(text) for text in texts[:n]]


def _camera_line(path: Path, words: list[str]) -> None:
    number = int(words[0])
    model = words[1]
    width = _whole(words[2])
    height = _whole(words[3])
    if model not in _models().values():
        raise MapError(f"camera {number} is of no known model", path=path, value=model, fix=REBUILD)
    _check_camera(path, number, model, width, height, tuple(_numbers(words[4:], len(words) - 4)))


def _image_line(path: Path, words: list[str]) -> None:
    _check_pose(path, f"image {_whole(words[0])}", _numbers(words[1:], 7))
    _whole(words[8])


def _rig_line(path: Path, words: list[str]) -> None:
    rig = _whole(words[0])
    n_sensors = _whole(words[1])
    at = 2
    for index in range(n_sensors):
        sensor = f"{_SENSORS[_SENSORS.index(words[at])]} {_whole(words[at + 1])}"
        at += 2
        if index:
            has_pose = _whole(words[at])
            at += 1
            if has_pose:
                _check_pose(path, f"{sensor} of rig {rig}", _numbers(words[at:], 7))
                at += 7


def _frame_line(path: Path, words: list[str]) -> None:
    frame = _whole(words[0])
    _ = _whole(words[1])
    _check_pose(path, f"frame {frame}", _numbers(words[2:], 7))
    for index in range(_whole(words[9])):
        _SENSORS.index(words[10 + 3 * index])
        _whole(words[11 + 3 * index])
        _whole(words[12 + 3 * index])


def _point_line(path: Path, words: list[str]) -> None:
    _numbers(words[1:], 7)
    for word in (words[0], *words[8:]):
        _whole(word)
    if len(words) % 2:
        raise IndexError(len(words))


def _keypoint_line(path: Path, words: list[str]) -> None:
    _numbers(words, len(words))
    if len(words) % 3:
        raise IndexError(len(words))
