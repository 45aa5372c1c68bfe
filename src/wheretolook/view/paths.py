"""Read paths to play: a planned path, compared paths, or any file of poses."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import (
    Float,
    camera_centers,
    invert_poses,
    poses_looking_along,
    rotation_from_quaternion,
)
from wheretolook.planning.config import FORWARD
from wheretolook.utils.errors import TableError
from wheretolook.utils.reading import MAX_TEXT_BYTES

MAX_COORDINATE_M = 1e9
GOOD_M = 0.25
GOOD_DEG = 2.0
"""Errors of a view below which it counts as localized, as in compared paths."""
MAX_POSES = 5000
MAX_METHODS = 20
_FIX = """\
Give the folder or path.csv of `wheretolook plan`, a scene's folder in results/paths of `wheretolook compare-paths`, a
TUM trajectory (t x y z qx qy qz qw, camera-to-world), or a CSV of selected views."""


@dataclass(frozen=True, eq=False)
class RecordedPath:
    """Views along a path."""

    cam_from_world: Float  # (W, 3, 4)
    localized: NDArray[np.bool_] | None = None  # (W,) whether each view localized; None if unknown

    def __len__(self) -> int:
        return len(self.cam_from_world)


Paths = dict[str, RecordedPath]
"""Paths by method."""


def read_paths(path: Path, pair: int = 0) -> Paths:
    """Read the views along a path by method; of compared paths those of one start-goal pair.

    A single path is accompanied by `FORWARD`: the same locations seen by a camera that looks ahead. Raises TableError
    if the file is missing or has no valid poses.
    """
    if path.is_dir():
        for name in ("path.csv", "views.parquet"):
            if (path / name).is_file():
                return read_paths(path / name, pair)
        raise TableError("this folder has no path", path=path, fix=_FIX)
    if not path.is_file():
        raise TableError("no such path", path=path, fix=_FIX)
    if path.suffix != ".parquet" and path.stat().st_size > MAX_TEXT_BYTES:
        raise TableError(f"a path has at most {MAX_TEXT_BYTES:,} bytes", path=path, value=path.stat().st_size, fix=_FIX)
    try:
        if path.suffix == ".parquet":
            paths = _compared_paths(path, pair)
        else:
            poses = _read_csv(path) if path.suffix == ".csv" else _read_tum(path)
            paths = {"planned" if path.name == "path.csv" else path.stem: RecordedPath(poses)}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TableError(f"no path can be read: {error}", path=path, fix=_FIX) from error
    if not paths:
        raise TableError("no such pair of start and goal", path=path, value=pair, fix="Correct --pair.")
    if len(paths) > MAX_METHODS:
        raise TableError(f"at most {MAX_METHODS} methods can be played", path=path, value=len(paths), fix=_FIX)
    for along in paths.values():
        if not 2 <= len(along) <= MAX_POSES or not is_rigid(along.cam_from_world):
            raise TableError(f"a path has 2 to {MAX_POSES} finite poses", path=path, value=len(along), fix=_FIX)
    if len(paths) == 1:
        (only,) = paths.values()
        return {FORWARD: RecordedPath(looking_ahead(camera_centers(only.cam_from_world))), **paths}
    return paths


def looking_ahead(positions: Float) -> Float:
    """Return level poses (W, 3, 4) at positions (W, 3) m that look along the path; stationary ones keep direction."""
    steps = np.diff(positions, axis=0, append=positions[-1:])
    steps[:, 2] = 0
    still = np.linalg.norm(steps, axis=1) < 1e-6
    moving = np.flatnonzero(~still)
    if len(moving) == 0:
        steps[:] = (1.0, 0.0, 0.0)
    else:
        last = np.maximum.accumulate(np.where(still, -1, np.arange(len(steps))))
        steps = steps[np.where(last < 0, moving[0], last)]
    return poses_looking_along(positions, steps)


def is_rigid(poses: Float) -> bool:
    """Test whether all poses (W, 3, 4) are finite rigid transforms."""
    rotations = poses[:, :, :3]
    orthonormal = np.allclose(rotations @ np.swapaxes(rotations, 1, 2), np.eye(3), atol=1e-3)
    return bool((np.abs(poses) < MAX_COORDINATE_M).all() and orthonormal)


def _compared_paths(path: Path, pair: int) -> Paths:
    """Read the paths that every method planned, or its views along the given path if any method planned none."""
    from wheretolook.dataset.viewpoint_table import UNLABELLED, is_good, poses
    from wheretolook.utils.parquet_files import read_parquet

    table = read_parquet(path)
    all_scenes = path.parent.parent / path.name  # has labels, too
    if all_scenes.is_file():
        labelled = read_parquet(all_scenes)
        labelled = labelled[labelled["scene"] == path.parent.name]
        table = labelled if len(labelled) else table
    table = table[table["pair"] == pair].sort_values("waypoint", kind="stable")
    methods = [name for name in table["method"].unique() if " " not in name]  # others name a second selection rule
    planned = table[table["task"] == "planned"]
    chosen = planned if {*methods} <= {*planned["method"]} else table[table["task"] == "given"]
    paths = {}
    for name in methods:
        rows = chosen[chosen["method"] == name]
        has_labels = "status" in rows and not (rows["status"] == UNLABELLED).any()
        paths[str(name)] = RecordedPath(poses(rows), is_good(rows, GOOD_M, GOOD_DEG) if has_labels else None)
    return paths


def _read_csv(path: Path) -> Float:
    """Read poses of a plan (cam_from_world) or of selected views (x, y, z, qw..., camera-to-world)."""
    import pandas as pd

    from wheretolook.dataset.viewpoint_table import POSE_COLUMNS, poses

    table = pd.read_csv(path, comment="#")
    if {*POSE_COLUMNS} <= {*table}:
        return poses(table)
    return _from_world_poses(table[list("xyz")].to_numpy(float), table[["qw", "qx", "qy", "qz"]].to_numpy(float))


def _read_tum(path: Path) -> Float:
    with warnings.catch_warnings(action="ignore"):  # about an empty file
        rows = np.loadtxt(path, comments="#", ndmin=2)
    if rows.ndim != 2 or rows.shape[1] != 8:
        raise ValueError("a TUM trajectory has eight columns")
    return _from_world_poses(rows[:, 1:4], rows[:, [7, 4, 5, 6]])


def _from_world_poses(centers: Float, wxyz: Float) -> Float:
    """Convert centres (W, 3) m and camera-to-world quaternions (W, 4) to cam_from_world (W, 3, 4)."""
    return invert_poses(np.concatenate([rotation_from_quaternion(wxyz), centers[..., None]], axis=-1))
