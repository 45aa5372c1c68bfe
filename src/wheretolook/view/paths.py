"""Paths to play: a planned or compared one as this project writes it, or any file of poses."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import (
    Float,
    camera_centers,
    invert_poses,
    poses_looking_along,
    rotation_from_quaternion,
)
from wheretolook.planning.config import FORWARD, PathsConfig
from wheretolook.utils.errors import TableError
from wheretolook.utils.reading import MAX_TEXT_BYTES

if TYPE_CHECKING:
    import pandas as pd

FAR_M = 1e9  # from the origin; no map has such coordinates
COMPARED = PathsConfig()  # its limits of errors, by which a view of a path counts as localized
MOST_POSES = 5000
MOST_METHODS = 20
_FIX = """\
Give the folder or path.csv of `wheretolook plan`, a scene's folder in results/paths of `wheretolook compare-paths`, a
TUM trajectory (t x y z qx qy qz qw, camera-to-world), or a CSV of selected views."""


@dataclass(frozen=True, eq=False)
class Played:
    """The views of one method along a path."""

    cam_from_world: Float  # (W, 3, 4)
    localized: NDArray[np.bool_] | None = None  # (W,) whether each localized, as compared paths count it, if tried

    def __len__(self) -> int:
        return len(self.cam_from_world)


Paths = dict[str, Played]
"""By the method that chose the views."""


def read_paths(path: Path, pair: int = 0) -> Paths:
    """The views along a path by method; of compared paths those of one pair, planned by each.

    Where there is but one, the same places seen by a camera that looks ahead stand beside it, as `FORWARD`. Raises
    TableError if there is no such file, or it holds no poses.
    """
    if path.is_dir():
        for name in ("path.csv", "views.parquet"):
            if (path / name).is_file():
                return read_paths(path / name, pair)
        raise TableError("no path lies in this folder", path=path, fix=_FIX)
    if not path.is_file():
        raise TableError("there is no such path", path=path, fix=_FIX)
    if path.suffix != ".parquet" and path.stat().st_size > MAX_TEXT_BYTES:
        raise TableError(f"a path has at most {MAX_TEXT_BYTES:,} bytes", path=path, value=path.stat().st_size, fix=_FIX)
    if path.suffix == ".parquet":
        found = _compared(path, pair)
    elif path.suffix == ".csv":
        found = {_name(path): Played(_table(path))}
    else:
        found = {_name(path): Played(_trajectory(path))}
    for along in (played.cam_from_world for played in found.values()):
        if not 2 <= len(along) <= MOST_POSES or not is_rigid(along):
            raise TableError(f"a path has 2 to {MOST_POSES} finite poses", path=path, value=len(along), fix=_FIX)
    if len(found) > MOST_METHODS:
        raise TableError(f"paths of at most {MOST_METHODS} methods are played", path=path, value=len(found), fix=_FIX)
    if len(found) == 1:
        name, told = next(iter(found.items()))
        return {FORWARD: Played(looking_ahead(camera_centers(told.cam_from_world))), name: told}
    return found


def looking_ahead(positions: Float) -> Float:
    """Poses (W, 3, 4) at places (W, 3) m of a camera that looks where it goes, level, and before it stops as before."""
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
    """Whether poses (W, 3, 4) are turns and shifts of places that there are."""
    turns = poses[:, :, :3]
    return bool((np.abs(poses) < FAR_M).all() and np.allclose(turns @ np.swapaxes(turns, 1, 2), np.eye(3), atol=1e-3))


def _name(path: Path) -> str:
    """What a path is called: of a plan, "planned"."""
    return "planned" if path.name == "path.csv" else path.stem


def _compared(path: Path, pair: int) -> Paths:
    """The paths of a pair, as each method planned them, or where one found none, its views along the given one."""
    from wheretolook.dataset.viewpoint_table import UNLABELLED, is_good, poses
    from wheretolook_paper.paths.path_comparison import GIVEN, PLANNED

    try:
        table = _labelled(path)
        table = table[table["pair"] == pair].sort_values("waypoint", kind="stable")
        methods = [name for name in table["method"].unique() if " " not in name]  # others choose by another rule
        planned, given = (table[table["task"] == task] for task in (PLANNED, GIVEN))
        chosen = planned if {*methods} <= {*planned["method"]} else given
        found = {}
        for name in methods:
            rows = chosen[chosen["method"] == name]
            tried = "status" in rows and not (rows["status"] == UNLABELLED).any()
            good = is_good(rows, COMPARED.max_error_m, COMPARED.max_error_deg) if tried else None
            found[str(name)] = Played(poses(rows), good)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TableError(f"no compared paths: {error}", path=path, fix=_FIX) from error
    if not found:
        raise TableError("there is no such pair of a start and a goal", path=path, value=pair, fix="Give --pair.")
    return found


def _labelled(path: Path) -> pd.DataFrame:
    """Compared paths of a scene, with their labels, which stand in the table of all scenes beside its folder."""
    from wheretolook.utils.parquet_files import read_parquet

    everything = path.parent.parent / path.name
    if everything.is_file():
        table = read_parquet(everything)
        table = table[table["scene"] == path.parent.name]
        if len(table):
            return table
    return read_parquet(path)


def _table(path: Path) -> Float:
    """Poses of a CSV: of a plan (cam_from_world), or of selected views (x, y, z, qw..., camera-to-world)."""
    import pandas as pd

    from wheretolook.dataset.viewpoint_table import POSE_COLUMNS, poses

    try:
        table = pd.read_csv(path, comment="#")
        if {*POSE_COLUMNS} <= {*table}:
            return poses(table)
        return _from_centers(table[list("xyz")].to_numpy(float), table[["qw", "qx", "qy", "qz"]].to_numpy(float))
    except (OSError, ValueError, KeyError) as error:
        raise TableError(f"no poses in this table: {error}", path=path, fix=_FIX) from error


def _trajectory(path: Path) -> Float:
    try:
        with warnings.catch_warnings(action="ignore"):  # of an empty file, which has no eight columns
            rows = np.loadtxt(path, comments="#", ndmin=2)
    except (OSError, ValueError) as error:
        raise TableError(f"no trajectory: {error}", path=path, fix=_FIX) from error
    if rows.ndim != 2 or rows.shape[1] != 8:
        raise TableError("a TUM trajectory has eight columns", path=path, value=rows.shape[-1], fix=_FIX)
    try:
        return _from_centers(rows[:, 1:4], rows[:, [7, 4, 5, 6]])
    except ValueError as error:  # a quaternion of zeros
        raise TableError(f"no trajectory: {error}", path=path, fix=_FIX) from error


def _from_centers(centers: Float, wxyz: Float) -> Float:
    """cam_from_world of centres (W, 3) m and camera-to-world quaternions (W, 4)."""
    return invert_poses(np.concatenate([rotation_from_quaternion(wxyz), centers[..., None]], axis=-1))
