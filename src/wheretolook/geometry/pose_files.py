"""Reads and writes poses as text: TUM trajectories, CSV tables, COLMAP's images.txt and lines of the benchmark's files.

World in metres. TUM trajectories and tables of selected views hold world_from_cam, the other formats cam_from_world.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.poses import Float, invert_poses, quaternion_from_rotation, rotation_from_quaternion
from wheretolook.utils.errors import TableError
from wheretolook.utils.files import MAX_TEXT_BYTES, read_text

QUATERNION_COLUMNS = ("qw", "qx", "qy", "qz")
TRANSLATION_COLUMNS = ("tx", "ty", "tz")
POSE_COLUMNS = (*QUATERNION_COLUMNS, *TRANSLATION_COLUMNS)
FORMATS = (
    "CSV with columns x, y, z (and id, if there is one; a line of names or none), the Active Localization Benchmark's text "
    '"id x y z", a TUM trajectory "t x y z qx qy qz qw", COLMAP\'s images.txt, or "x y z"; lines that start with # are comments'
)
NAME_COLUMNS = ("image", "id", "waypoint", "name", "t", "timestamp")
_TUM_ORDER = (*TRANSLATION_COLUMNS, "qx", "qy", "qz", "qw")
_IMAGE_COLUMNS = ("image_id", *POSE_COLUMNS, "camera_id", "name")
MAX_ROWS = 500_000  # of a text table


def pose_values(cam_from_world: ArrayLike) -> Float:
    """Return qw qx qy qz tx ty tz (N, 7) of poses (N, 3, 4)."""
    poses = np.asarray(cam_from_world, dtype=np.float64)
    return np.concatenate([quaternion_from_rotation(poses[..., :3]), poses[..., 3]], axis=-1)


def poses_of_values(values: ArrayLike) -> Float:
    """Return poses (N, 3, 4) of qw qx qy qz tx ty tz (N, 7); quaternions are normalized."""
    table = np.asarray(values, dtype=np.float64)
    return np.concatenate([rotation_from_quaternion(table[..., :4]), table[..., 4:, None]], axis=-1)


def read_rows(path: Path, text: str | None = None) -> list[tuple[int, list[str]]]:
    """Read the rows of a text table, or of the `text` that was read from it, as pairs of line number, from 1, and cells; lines starting with # are comments.

    If the first row has a semicolon or comma, cells are separated by it and may be quoted; else by blanks. Commas between
    semicolons are decimal points. Raises TableError if the file is missing, no UTF-8 text, too large, or has no rows.
    """
    try:
        lines = enumerate(map(str.strip, (read_text(path) if text is None else text).splitlines()), 1)
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
        cells = [*csv.reader((line for _, line in rows), delimiter=separator, skipinitialspace=True)]
        if len(cells) < len(rows):
            raise ValueError("a quoted cell has several lines")
        return [(number, [*map(str.strip, row)]) for (number, _), row in zip(rows, cells, strict=True)]
    except (OSError, ValueError, csv.Error) as error:
        raise TableError(f"the file cannot be read: {error}", path=path, fix="Give a text file of rows.") from error


@dataclass(frozen=True, eq=False)
class NamedRows:
    """Rows of a text table: pairs of line number, from 1, and cells."""

    path: Path
    header: tuple[str, ...]  # names of the columns
    rows: list[tuple[int, list[str]]]

    @cached_property
    def columns(self) -> dict[str, int]:
        """Columns by name."""
        return {name: column for column, name in enumerate(self.header)}

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each row: that of its column of names, or else a count from 0."""
        column = next((self.columns[name] for name in NAME_COLUMNS if name in self.columns), None)
        return tuple(str(row) if column is None else cells[column] for row, (_, cells) in enumerate(self.rows))

    def numbers(self, names: Sequence[str]) -> Float:
        """Return the numbers in some columns (N, len(names)). Raises TableError, with the line, if one is not finite."""
        table = np.empty((len(self.rows), len(names)))
        for row, (number, cells) in enumerate(self.rows):
            try:
                if len(cells) != len(self.header):
                    raise ValueError(
                        f"{len(cells)} cells for {len(self.header)} columns (decimal commas need semicolons)"
                    )
                table[row] = [float(cells[self.columns[name]]) for name in names]
                if not np.isfinite(table[row]).all():
                    raise ValueError("a value is not finite")
            except (ValueError, LookupError) as error:
                problem = f"there is no column {error}" if isinstance(error, KeyError) else str(error)
                value = f"line {number}: {' '.join(cells)[:80]}"
                raise TableError(problem, path=self.path, value=value, fix=f"Give {FORMATS}.") from error
        return table


def read_named_rows(path: str | Path) -> NamedRows:
    """Read a file in one of `FORMATS`, detected from its first row. Raises TableError if it is missing or another."""
    path = Path(path)
    may_be_images = path.suffix == ".txt"
    try:  # once, since it may be a pipe
        max_bytes = 100_000_000 if may_be_images else MAX_TEXT_BYTES  # an images.txt has the keypoints, too
        text = read_text(path, max_bytes, pipes=True)
    except (OSError, ValueError) as error:
        raise TableError(f"the file cannot be read: {error}", path=path, fix="Give a text file of rows.") from error
    rows = _image_rows(text) if may_be_images else []
    if not rows or len(rows[0][1]) < len(_IMAGE_COLUMNS):
        rows = read_rows(path, text)
    first = rows[0][1]
    fixed = (tuple("xyz"), ("id", *"xyz"), ("t", *"xyz", "qx", "qy", "qz", "qw"), _IMAGE_COLUMNS)
    names = next((columns for columns in fixed if len(columns) == len(first)), ())
    if len(first) > 1 and not any(map(_is_number, first)):
        names = tuple(cell.strip("\"' ").lower() for cell in first)
        rows = rows[1:]
    if not rows or not names:
        raise TableError(
            "the file has no rows of a known format", path=path, value=" ".join(first)[:80], fix=f"Give {FORMATS}."
        )
    if twice := next((name for name in names if name and names.count(name) > 1), None):
        raise TableError("two columns have the same name", path=path, value=twice, fix="Name or remove one.")
    return NamedRows(path, names, rows)


def poses_of_rows(table: NamedRows, orientations_only: bool = False) -> Float:
    """Return the poses cam_from_world (N, 3, 4) in rows, of the columns that `wheretolook.geometry.views.Views.read` names.

    With `orientations_only` positions may be missing, and are then 0. Raises TableError, with the line, for others.
    """
    path = table.path
    quaternions = table.numbers(QUATERNION_COLUMNS)
    lengths = np.linalg.norm(quaternions, axis=1)
    for row in np.flatnonzero(np.abs(lengths - 1) > 0.01).tolist():
        value = f"line {table.rows[row][0]}: {lengths[row]:.4g}"
        raise TableError("a quaternion is not of length 1", path=path, value=value, fix="Correct the order of columns.")
    locations: Float = np.zeros((len(quaternions), 3))
    if not orientations_only or {"x", "tx"} & {*table.columns}:
        locations = table.numbers(TRANSLATION_COLUMNS if {*TRANSLATION_COLUMNS} <= {*table.columns} else "xyz")
    poses = poses_of_values(np.concatenate([quaternions, locations], axis=1))
    return poses if holds_cam_from_world(table) else invert_poses(poses)


def holds_cam_from_world(table: NamedRows) -> bool:
    """Return whether the columns are COLMAP's world-to-camera poses. Raises TableError for tx, ty, tz in another order than COLMAP's or TUM's."""
    if not {*POSE_COLUMNS} <= {*table.columns}:
        return False
    order = tuple(sorted(POSE_COLUMNS, key=lambda name: table.columns[name]))
    if order not in (POSE_COLUMNS, _TUM_ORDER):
        problem = "the order of the columns does not show whether poses are camera-to-world or world-to-camera"
        fix = f"Order them as TUM, {','.join(_TUM_ORDER)}, camera-to-world, or COLMAP, {','.join(POSE_COLUMNS)}, world-to-camera."
        raise TableError(problem, path=table.path, value=",".join(order), fix=fix)
    return order == POSE_COLUMNS


def _image_rows(text: str) -> list[tuple[int, list[str]]]:
    """Read the first line of each image in an images.txt; a second one, which may be empty, holds its keypoints."""
    lines = enumerate(text.splitlines(), 1)
    rows = []
    for number, line in lines:
        if line.strip() and not line.startswith("#"):
            rows.append((number, line.split(maxsplit=len(_IMAGE_COLUMNS) - 1)))
            next(lines, None)
    return rows


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def pose_texts(cam_from_world: ArrayLike, exact: bool = False) -> list[str]:
    """Return the text "qw qx qy qz tx ty tz" of each pose (N, 3, 4), with 9 decimals or, if `exact`, with all.

    Far from the origin quaternions get 15 decimals, since the camera's centre follows from them and the translation.
    """
    values = pose_values(cam_from_world)
    decimals = 9 if np.abs(values[:, 4:]).max(initial=0) < 1000.0 else 15
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
