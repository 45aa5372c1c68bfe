"""Reads and writes poses as text: TUM trajectories, CSV tables, COLMAP's images.txt and lines of the benchmark's files.

World in metres. TUM trajectories and tables of selected views hold world_from_cam, the other formats cam_from_world.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.poses import Float, invert_poses, quaternion_from_rotation, rotation_from_quaternion
from wheretolook.utils.errors import TableError
from wheretolook.utils.reading import read_text

QUATERNION_COLUMNS = ("qw", "qx", "qy", "qz")
TRANSLATION_COLUMNS = ("tx", "ty", "tz")
POSE_COLUMNS = (*QUATERNION_COLUMNS, *TRANSLATION_COLUMNS)
NAME_COLUMNS = ("id", "waypoint", "name", "t", "timestamp")
_TUM_COLUMNS = ("t", *"xyz", "qx", "qy", "qz", "qw")
_IMAGE_COLUMNS = ("image_id", *POSE_COLUMNS, "camera_id", "name")
_FIXED_COLUMNS = {len(columns): columns for columns in (_TUM_COLUMNS, _IMAGE_COLUMNS)}
MAX_ROWS = 500_000  # of a text table
MAX_IMAGES_BYTES = 100_000_000  # of an images.txt, which also has the keypoints
UNIT_TOLERANCE = 0.01  # of a quaternion's length
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

    If the first row has a semicolon or comma, cells are separated by it and may be quoted; else by blanks. Commas between
    semicolons are decimal points. Raises TableError if the file is missing, no UTF-8 text, too large, or has no rows.
    """
    try:
        lines = enumerate(map(str.strip, read_text(path).removeprefix("\ufeff").splitlines()), 1)
        rows = [*islice(((number, line) for number, line in lines if line and not line.startswith("#")), MAX_ROWS + 1)]
        if not rows:
            raise ValueError("it has no rows")
        if len(rows) > MAX_ROWS:
            raise ValueError(f"it has more than {MAX_ROWS:,} rows")
        separator = next((mark for mark in ";," if mark in rows[0][1]), None)
        if separator is None:
            return [(number, line.split()) for number, line in rows]
        if separator == ";":  # of spreadsheets where a comma is the decimal point
            rows = [(number, line.replace(",", ".")) for number, line in rows]
        cells = csv.reader((line for _, line in rows), delimiter=separator, skipinitialspace=True)
        return [(number, [*map(str.strip, row)]) for (number, _), row in zip(rows, cells, strict=True)]
    except (OSError, ValueError, csv.Error) as error:
        raise TableError(f"the file cannot be read: {error}", path=path, fix="Give a text file of rows.") from error


class NamedPoses(NamedTuple):
    """N poses and their names."""

    names: tuple[str, ...]
    cam_from_world: Float  # (N, 3, 4)


def read_poses(path: Path) -> NamedPoses:
    """Read poses and their names from a TUM trajectory, COLMAP's images.txt, or a CSV with a line of column names.

    A CSV holds x, y, z, qw, qx, qy, qz (world_from_cam) or qw, qx, qy, qz, tx, ty, tz (cam_from_world). Raises
    TableError, with the line, if the file is missing or holds no poses.
    """
    number = 0
    try:
        rows = _image_rows(path) if path.suffix == ".txt" else []
        if not rows or len(rows[0][1]) < len(_IMAGE_COLUMNS):
            rows = read_rows(path)
        names = _FIXED_COLUMNS.get(len(rows[0][1]), ())
        if is_header(rows[0][1]):
            names = tuple(cell.strip("\"' ").lower() for cell in rows.pop(0)[1])
        columns = {name: column for column, name in reversed([*enumerate(names)])}
        wanted = POSE_COLUMNS if {*POSE_COLUMNS} <= {*columns} else (*"xyz", *QUATERNION_COLUMNS)
        table = np.empty((len(rows), len(wanted)))
        for row, (line, cells) in enumerate(rows):
            number = line
            table[row] = [float(cells[columns[name]]) for name in wanted]
            length = np.linalg.norm(table[row, [wanted.index(name) for name in QUATERNION_COLUMNS]])
            if not (np.isfinite(table[row]).all() and abs(length - 1) < UNIT_TOLERANCE):
                raise ValueError("a pose has finite numbers and a quaternion of length 1")
        number = 0
        if not rows:
            raise ValueError("there are none below the line of names")
        poses = poses_of_values(table) if wanted == POSE_COLUMNS else _poses_in_world(table[:, :3], table[:, 3:])
        named = next((columns[name] for name in NAME_COLUMNS if name in columns), None)
        texts = range(len(rows)) if named is None else (cells[named] for _, cells in rows)
        return NamedPoses(tuple(map(str, texts)), poses)
    except (OSError, ValueError, LookupError) as error:
        fix = "Give a TUM trajectory t x y z qx qy qz qw, COLMAP's images.txt, or a CSV of views or of a path."
        problem = f"no column {error}" if isinstance(error, KeyError) else str(error)
        value = f"line {number}" if number else None
        raise TableError(f"no poses can be read: {problem}", path=path, value=value, fix=fix) from error


def _image_rows(path: Path) -> list[tuple[int, list[str]]]:
    """Read the first line of each image in an images.txt; a second one, which may be empty, holds its keypoints."""
    lines = enumerate(read_text(path, MAX_IMAGES_BYTES).splitlines(), 1)
    rows = []
    for number, line in lines:
        if line.strip() and not line.startswith("#"):
            rows.append((number, line.split(maxsplit=len(_IMAGE_COLUMNS) - 1)))
            next(lines, None)
    return rows


def is_header(row: list[str]) -> bool:
    """Return whether cells of a table's first row are names: several, and none a number."""
    return len(row) > 1 and not any(map(is_number, row))


def is_number(text: str) -> bool:
    """Return whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


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
