"""List the frames of an RGB-D recording in the layout of 7-Scenes or of the TUM RGB-D benchmark.

Shotton et al., "Scene Coordinate Regression Forests for Camera Relocalization in RGB-D Images", CVPR 2013; Sturm et
al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from wheretolook.geometry.poses import Float, invert_poses, rotation_from_quaternion
from wheretolook.utils.confine import path_within
from wheretolook.utils.errors import SceneError
from wheretolook.utils.reading import read_text

_MAX_APART_S = 0.02  # between a colour image and its depth image or pose, as in TUM's associate.py
_RIGID_TOLERANCE = 1e-2  # of a rotation's entries
_MAX_COORDINATE_M = 1e9
_MAX_FRAMES = 100_000  # rows of a list: an hour at 30 Hz
_MAX_POSES = 400_000  # an hour at 100 Hz
_IMAGES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class Layout:
    """Default properties of a layout's images; intrinsics are fx, fy, cx, cy in pixels."""

    name: str
    depth_scale: float  # units in a metre
    camera: tuple[float, float, float, float]
    depth_camera: tuple[float, float, float, float] | None  # None: depth images are registered to the colour images
    color_from_depth_m: tuple[float, float, float]


# Kinect's nominal cameras, 2.5 cm apart. The pose is the depth camera's.
SEVEN_SCENES = Layout(
    "7-scenes", 1000.0, (525.0, 525.0, 320.0, 240.0), (585.0, 585.0, 320.0, 240.0), (-0.025, 0.0, 0.0)
)
TUM = Layout("tum", 5000.0, (525.0, 525.0, 320.0, 240.0), None, (0.0, 0.0, 0.0))  # ROS's defaults, as TUM advises


@dataclass(frozen=True, eq=False)
class FrameFiles:
    """One frame."""

    name: str  # path of the colour image, relative to the recording
    color: Path
    depth: Path
    cam_from_world: Float  # (3, 4) of the recording's depth camera, or of a model's image
    in_model: str = ""  # the name of that image


@dataclass
class Skipped:
    """Numbers of frames that were not used, by reason."""

    reasons: dict[str, int] = field(default_factory=dict)

    def add(self, reason: str) -> None:
        """Count a frame."""
        self.reasons[reason] = self.reasons.get(reason, 0) + 1

    def describe(self) -> str:
        """Text such as "3 without a pose, 1 without depth"."""
        return ", ".join(f"{number} {reason}" for reason, number in self.reasons.items())


def find_layout(folder: Path) -> Layout:
    """Detect the layout of a recording. Raises SceneError if it is of neither kind."""
    if not folder.is_dir():
        raise SceneError("there is no such folder", path=folder, fix="Name the folder of an RGB-D recording.")
    if (folder / "rgb.txt").is_file() and (folder / "depth.txt").is_file():
        return TUM
    if any(_color_files(folder)):
        return SEVEN_SCENES
    fix = "A recording has frame-*.color.png, frame-*.depth.png and frame-*.pose.txt, as in 7-Scenes, or rgb.txt, "
    raise SceneError("this is no RGB-D recording", path=folder, fix=fix + "depth.txt and groundtruth.txt, as in TUM.")


def frame_files(folder: Path, layout: Layout, need_poses: bool = True) -> tuple[list[FrameFiles], Skipped]:
    """List the frames of a recording that have all their files and a pose, and count the others.

    Unless poses are needed, they are the identity. Raises SceneError if a list of files or all poses are missing.
    """
    skipped = Skipped()
    read = _tum_frames if layout is TUM else _seven_scenes_frames
    frames = list(read(folder, skipped, need_poses))
    if not frames:
        where = "groundtruth.txt" if layout is TUM else "frame-*.pose.txt (world_from_cam, four rows of four)"
        fix = f"Each frame needs a colour image, a depth image and a pose, here from {where}; "
        fix += "poses of a COLMAP model of the colour images will do: --scenes.rgbd.model SPARSE."
        raise SceneError("no frame can be used", path=folder, value=skipped.describe(), fix=fix)
    return frames, skipped


def _color_files(folder: Path) -> Iterator[Path]:
    for pattern in ("frame-*.color.*", "seq-*/frame-*.color.*"):
        yield from (path for path in folder.glob(pattern) if path.suffix.lower() in _IMAGES)


def _seven_scenes_frames(folder: Path, skipped: Skipped, need_poses: bool) -> Iterator[FrameFiles]:
    for color in sorted(_color_files(folder)):
        stem = color.name.partition(".color.")[0]
        depth = color.with_name(f"{stem}.depth.png")
        pose = color.with_name(f"{stem}.pose.txt")
        found = _read_pose(pose) if need_poses else np.eye(3, 4)
        if not depth.is_file():
            skipped.add("without a depth image")
        elif found is None:
            skipped.add("without a pose" if not pose.is_file() else "whose pose is lost (not finite, or no rotation)")
        else:
            yield FrameFiles(color.relative_to(folder).as_posix(), color, depth, found)


def _read_pose(path: Path) -> Float | None:
    """Read cam_from_world from a file of world_from_cam, four rows of four numbers; None if it is missing or invalid."""
    try:
        matrix = np.array(read_text(path, 10_000).split(), dtype=np.float64)
    except (OSError, ValueError):
        return None
    return _checked(matrix.reshape(4, 4)[:3]) if matrix.size == 16 else None


def _checked(world_from_cam: Float) -> Float | None:
    """Invert world_from_cam to cam_from_world with an exact rotation; None if it is not a pose."""
    rotation = world_from_cam[:, :3]
    if not (np.abs(world_from_cam) < _MAX_COORDINATE_M).all() or not np.allclose(
        rotation @ rotation.T, np.eye(3), atol=_RIGID_TOLERANCE
    ):
        return None
    u, _, vt = np.linalg.svd(rotation)
    if np.linalg.det(u @ vt) < 0:
        return None
    return invert_poses(np.column_stack([u @ vt, world_from_cam[:, 3]]))


def _tum_frames(folder: Path, skipped: Skipped, need_poses: bool) -> Iterator[FrameFiles]:
    rgb, depth = (_read_list(folder / name, 1, _MAX_FRAMES) for name in ("rgb.txt", "depth.txt"))
    times = list[float]()
    poses = np.zeros((0, 7))
    if need_poses:
        rows = _read_list(folder / "groundtruth.txt", 7, _MAX_POSES)
        times = [time for time, _ in rows]
        poses = np.array([[_number(value) for value in values] for _, values in rows])
    depth_of = _Times([time for time, _ in depth])
    pose_of = _Times(times)
    for time, (name,) in rgb:
        at = depth_of.nearest(time)
        pose = pose_of.nearest(time)
        color = path_within(folder, name, "the name of a colour image")
        distance = None if at is None else path_within(folder, depth[at][1][0], "the name of a depth image")
        if not color.is_file():
            skipped.add("without a colour image")
        elif distance is None or not distance.is_file():
            skipped.add("without a depth image")
        elif not need_poses:
            yield FrameFiles(name, color, distance, np.eye(3, 4))
        elif pose is None:
            skipped.add("without a pose")
        else:
            found = _tum_pose(poses[pose])
            if found is None:
                skipped.add("whose pose is lost (not finite, or no rotation)")
            else:
                yield FrameFiles(name, color, distance, found)


def _tum_pose(values: Float) -> Float | None:
    """Convert tx, ty, tz, qx, qy, qz, qw of world_from_cam to cam_from_world; None if it is not a pose."""
    if not np.isfinite(values).all() or abs(np.linalg.norm(values[3:]) - 1) > _RIGID_TOLERANCE:
        return None
    rotation = rotation_from_quaternion(values[[6, 3, 4, 5]])
    return _checked(np.column_stack([rotation, values[:3]]))


class _Times:
    """Times of a list in any order."""

    def __init__(self, times: Iterable[float]) -> None:
        self.times = np.array([*times], dtype=np.float64)
        self.order = np.argsort(self.times, kind="stable")
        self.times = self.times[self.order]

    def nearest(self, time: float) -> int | None:
        """Row of the nearest time, the first of equals; None if none is within the limit."""
        end = int(np.searchsorted(self.times, time))
        near = [at for at in (end - 1, end) if 0 <= at < len(self.times)]
        at = min(near, key=lambda at: abs(self.times[at] - time), default=None)
        if at is None or abs(self.times[at] - time) > _MAX_APART_S:
            return None
        return int(self.order[np.searchsorted(self.times, self.times[at])])


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _read_list(path: Path, n_values: int, at_most: int) -> list[tuple[float, list[str]]]:
    """Read rows of a TUM list: a time and `n_values` values. Raises SceneError if it is missing, invalid or too long."""
    try:
        text = read_text(path)
        if text.count("\n") > at_most:
            raise ValueError(f"it has more than {at_most:,} rows")
        lines = [line.replace(",", " ").split() for line in text.splitlines()]
    except (OSError, ValueError) as error:
        problem = f"a list of the recording cannot be read: {error}"
        raise SceneError(problem, path=path, fix="A recording of TUM's layout has it.") from error
    rows = [(_number(words[0]), words[1:]) for words in lines if words and not words[0].startswith("#")]
    for time, values in rows:
        if not np.isfinite(time) or len(values) != n_values:
            problem = f"a row of this list is not a time and {n_values} value{'s' * (n_values > 1)}"
            raise SceneError(problem, path=path, value=(time, values), fix="Copy the recording again.")
    return rows
