"""Reads and writes poses as text: TUM trajectories, CSV tables, COLMAP's images.txt and lines of the benchmark's files.

World in metres. TUM trajectories and tables of selected views hold world_from_cam, the other formats cam_from_world.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.poses import Float, invert_poses, quaternion_from_rotation, rotation_from_quaternion
from wheretolook.utils.errors import TableError
from wheretolook.utils.reading import read_text

QUATERNION_COLUMNS = ("qw", "qx", "qy", "qz")
TRANSLATION_COLUMNS = ("tx", "ty", "tz")
POSE_COLUMNS = (*QUATERNION_COLUMNS, *TRANSLATION_COLUMNS)
MAX_ROWS = 500_000  # of a text table
FAR_M = 1000.0  # of a camera from the origin, from where on its quaternion needs more decimals


def pose_values(cam_from_world: ArrayLike) -> Float:
    """Return qw qx qy qz tx ty tz (N, 7) of poses (N, 3, 4)."""
    poses = np.asarray(cam_from_world, dtype=np.float64)
    return np.concatenate([quaternion_from_rotation(poses[..., :3]), poses[..., 3]], axis=-1)


def poses_of_values(values: ArrayLike) -> Float:
    """Return poses (N, 3, 4) of qw qx qy qz tx ty tz (N, 7); quaternions are normalized."""
    table = np.asarray(values, dtype=np.float64)
    return np.concatenate([rotation_from_quaternion(table[..., :4]), table[..., 4:, None]], axis=-1)


def read_rows(path: Path) -> list[tuple[int, list[str]]]:
    """Read the rows of a text table as pairs of line number, from 1, and cells; lines starting with # are comments.

    If the first row has a comma or semicolon, cells are separated by it and may be quoted; else by blanks. Raises
    TableError if the file is missing, no UTF-8 text, too large, or has no rows.
    """
    try:
        lines = enumerate(map(str.strip, read_text(path).removeprefix("\ufeff").splitlines()), 1)
        rows = [(number, line) for number, line in lines if line and not line.startswith("#")]
        if not 0 < len(rows) <= MAX_ROWS:
            raise ValueError(f"it has {len(rows):,} rows, not 1 to {MAX_ROWS:,}")
        separator = next((mark for mark in ",;" if mark in rows[0][1]), None)
        if separator is None:
            return [(number, line.split()) for number, line in rows]
        cells = csv.reader((line for _, line in rows), delimiter=separator, skipinitialspace=True)
        return [(number, [*map(str.strip, row)]) for (number, _), row in zip(rows, cells, strict=True)]
    except (OSError, ValueError, csv.Error) as error:
        raise TableError(f"the file cannot be read: {error}", path=path, fix="Give a text file of rows.") from error


def read_poses(path: Path) -> Float:
    """Read cam_from_world (N, 3, 4) from a CSV of a planned path or of selected views, or else from a TUM trajectory.

    Raises TableError if the file is missing or holds no poses.
    """
    import pandas as pd

    try:
        if path.suffix == ".csv":
            table = pd.read_csv(path, comment="#")
            if {*POSE_COLUMNS} <= {*table}:
                return poses_of_values(table[[*POSE_COLUMNS]])
            return _poses_in_world(table[[*"xyz"]].to_numpy(float), table[[*QUATERNION_COLUMNS]].to_numpy(float))
        rows = np.array([cells for _, cells in read_rows(path)], dtype=np.float64)
        if rows.shape[1:] != (8,):
            raise ValueError("a TUM trajectory has eight columns")
        return _poses_in_world(rows[:, 1:4], rows[:, [7, 4, 5, 6]])
    except (OSError, ValueError, KeyError, TypeError) as error:
        fix = "Give a TUM trajectory t x y z qx qy qz qw, or a CSV of a path or of selected views."
        raise TableError(f"no poses can be read: {error}", path=path, fix=fix) from error


def _poses_in_world(centers: Float, quaternions_wxyz: Float) -> Float:
    """Convert world_from_cam, centres (N, 3) m and quaternions (N, 4), to cam_from_world (N, 3, 4)."""
    return invert_poses(np.concatenate([rotation_from_quaternion(quaternions_wxyz), centers[..., None]], axis=-1))


def pose_texts(cam_from_world: ArrayLike, exact: bool = False) -> list[str]:
    """Return the text "qw qx qy qz tx ty tz" of each pose (N, 3, 4), with 9 decimals or, if `exact`, with all.

    Far from the origin quaternions get 15 decimals, since the camera's centre follows from them and the translation.
    """
    values = pose_values(cam_from_world)
    decimals = 9 if np.abs(values[:, 4:]).max(initial=0) < FAR_M else 15
    pattern = ["{!r}"] * 7 if exact else [f"{{:.{decimals}f}}"] * 4 + ["{:.9f}"] * 3
    return [" ".join(pattern).format(*row) for row in values.tolist()]


def tum_text(stamps: Iterable[str], cam_from_world: ArrayLike) -> str:
    """Return a TUM trajectory of poses (N, 3, 4), a line "t x y z qx qy qz qw" each."""
    world_from_cam = invert_poses(cam_from_world)
    quaternions = np.roll(quaternion_from_rotation(world_from_cam[:, :, :3]), -1, axis=1)
    values = np.concatenate([world_from_cam[:, :, 3], quaternions], axis=1).tolist()
    return "".join(" ".join([t, *(f"{v:.9f}" for v in row)]) + "\n" for t, row in zip(stamps, values, strict=True))


def images_text(names: Iterable[str], cam_from_world: ArrayLike) -> str:
    """Return the content of COLMAP's images.txt for images of camera 1, without points, at poses (N, 3, 4)."""
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# an empty line follows: no points"]
    for number, (name, pose) in enumerate(zip(names, pose_texts(cam_from_world), strict=True), 1):
        lines += [f"{number} {pose} 1 {name}", ""]
    return "\n".join(lines) + "\n"
