"""List the frames of an RGB-D recording in the layout of 7-Scenes or of the TUM RGB-D benchmark.

Shotton et al., "Scene Coordinate Regression Forests for Camera Relocalization in RGB-D Images", CVPR 2013; Sturm et
al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from wheretolook.geometry.poses import Float, invert_poses, rotation_from_quaternion
from wheretolook.io.poses import read_rows
from wheretolook.utils.errors import SceneError
from wheretolook.utils.files import path_within, read_text

_MAX_APART_S = 0.02  # between a colour image and its depth image or pose, as in TUM's associate.py
_RIGID_TOLERANCE = 1e-2  # of a rotation's entries
_MAX_COORDINATE_M = 1e9
_IMAGES = (".png", ".jpg", ".jpeg")
_LOST = np.full((3, 4), np.nan)  # a pose that cannot be read

Intrinsics = tuple[float, ...]  # fx, fy, cx, cy in pixels


@dataclass(frozen=True)
class Layout:
    """Default properties of a layout's images."""

    name: str
    depth_scale: float  # units in a metre
    camera: Intrinsics
    depth_camera: Intrinsics = ()  # empty: depth images are registered to the colour images
    color_from_depth_m: tuple[float, ...] = (0.0, 0.0, 0.0)


# Kinect's nominal cameras, 2.5 cm apart. The pose is the depth camera's.
SEVEN_SCENES = Layout("7-scenes", 1000.0, (525, 525, 320, 240), (585, 585, 320, 240), (-0.025, 0.0, 0.0))
TUM = Layout("tum", 5000.0, (525, 525, 320, 240))  # ROS's defaults, as TUM advises


@dataclass(frozen=True, eq=False)
class FrameFiles:
    """One frame."""

    name: str  # path of the colour image, relative to the recording
    color: Path
    depth: Path
    cam_from_world: Float  # (3, 4) of the recording's depth camera, or of a model's image
    name_in_model: str = ""  # of that image


_Listed = tuple[str, Path, Path | None, Float | None]
"""Name and path of a colour image, path of its depth image, world_from_cam (3, 4) of the depth camera."""


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


def frame_files(folder: Path, layout: Layout, need_poses: bool = True) -> tuple[list[FrameFiles], Counter[str]]:
    """List the frames of a recording that have all their files and a pose, and count the others by reason.

    Unless poses are needed, they are the identity. Raises SceneError if all frames lack something or a row of a list is
    invalid, TableError if a list cannot be read.
    """
    skipped = Counter[str]()
    frames = []
    for name, color, depth, world_from_cam in (_list_tum if layout is TUM else _list_seven_scenes)(folder, need_poses):
        if not color.is_file():
            skipped["without a colour image"] += 1
        elif depth is None or not depth.is_file():
            skipped["without a depth image"] += 1
        elif world_from_cam is None:
            skipped["without a pose"] += 1
        elif (pose := _inverse(world_from_cam)) is None:
            skipped["whose pose is lost (not finite, or no rotation)"] += 1
        else:
            frames.append(FrameFiles(name, color, depth, pose))
    if not frames:
        where = "groundtruth.txt" if layout is TUM else "frame-*.pose.txt (world_from_cam, four rows of four)"
        fix = f"Each frame needs a colour image, a depth image and a pose, here from {where}; "
        fix += "poses of a COLMAP model of the colour images will do: --scenes.rgbd.model SPARSE."
        raise SceneError("no frame can be used", path=folder, value=dict(skipped), fix=fix)
    return frames, skipped


def _color_files(folder: Path) -> Iterator[Path]:
    for pattern in ("frame-*.color.*", "seq-*/frame-*.color.*"):
        yield from (path for path in folder.glob(pattern) if path.suffix.lower() in _IMAGES)


def _list_seven_scenes(folder: Path, need_poses: bool) -> Iterator[_Listed]:
    for color in sorted(_color_files(folder)):
        stem = color.name.partition(".color.")[0]
        pose = _read_pose(color.with_name(f"{stem}.pose.txt")) if need_poses else np.eye(3, 4)
        yield color.relative_to(folder).as_posix(), color, color.with_name(f"{stem}.depth.png"), pose


def _read_pose(path: Path) -> Float | None:
    """Read world_from_cam (3, 4) from four rows of four numbers; None if the file is missing."""
    try:
        return np.array(read_text(path, 10_000).split(), dtype=np.float64).reshape(4, 4)[:3]
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        return _LOST


def _list_tum(folder: Path, need_poses: bool) -> Iterator[_Listed]:
    table = _read_list(folder / "rgb.txt", "color", 1)
    others = [_read_list(folder / "depth.txt", "depth", 1)]
    if need_poses:
        others.append(_read_list(folder / "groundtruth.txt", "pose", 7))
    for other in others:
        apart: Any = _MAX_APART_S  # the stubs of pandas know no floats here
        table = pd.merge_asof(table, other, on="time", direction="nearest", tolerance=apart)
    for row in table.to_dict("records"):
        (name,) = row["color"]
        # without a counterpart, cells are NaN
        depth = path_within(folder, row["depth"][0], "a depth image") if isinstance(row["depth"], list) else None
        pose = _pose_of(row["pose"]) if need_poses else np.eye(3, 4)
        yield name, path_within(folder, name, "a colour image"), depth, pose


def _pose_of(cells: Any) -> Float | None:
    """Convert texts tx, ty, tz, qx, qy, qz, qw to a matrix (3, 4); None if there are none."""
    if not isinstance(cells, list):
        return None
    try:
        values = np.array(cells, dtype=np.float64)
    except ValueError:
        return _LOST
    if not abs(np.linalg.norm(values[3:]) - 1) <= _RIGID_TOLERANCE:
        return _LOST
    return np.column_stack([rotation_from_quaternion(values[[6, 3, 4, 5]]), values[:3]])


def _inverse(world_from_cam: Float) -> Float | None:
    """Invert world_from_cam (3, 4) to cam_from_world with an exact rotation; None if it is not a pose."""
    rotation = world_from_cam[:, :3]
    orthonormal = np.allclose(rotation @ rotation.T, np.eye(3), atol=_RIGID_TOLERANCE)
    if not orthonormal or not (np.abs(world_from_cam) < _MAX_COORDINATE_M).all():
        return None
    u, _, vt = np.linalg.svd(rotation)
    if np.linalg.det(u @ vt) < 0:
        return None
    return invert_poses(np.column_stack([u @ vt, world_from_cam[:, 3]]))


def _read_list(path: Path, column: str, n_values: int) -> pd.DataFrame:
    """Read a list of TUM's layout, by time in seconds; `column` holds the texts of each row's values."""
    rows = [cells for _, cells in read_rows(path)]
    time = pd.to_numeric(pd.Series([cells[0] for cells in rows]), errors="coerce").to_numpy(np.float64)
    valid = np.isfinite(time) & np.array([len(cells) == 1 + n_values for cells in rows])
    if not valid.all():
        problem = f"a row of this list is not a time and {n_values} value{'s' * (n_values > 1)}"
        value = " ".join(rows[int(np.argmin(valid))])
        raise SceneError(problem, path=path, value=value, fix="Copy the recording again.")
    return pd.DataFrame({"time": time, column: [cells[1:] for cells in rows]}).sort_values("time", kind="stable")
