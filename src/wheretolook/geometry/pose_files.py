"""Reads tables of poses, locations and rotations, and writes poses as text.

`read_named_rows` is the reader of all files that users give: its formats are recognized by their content, not by the
file's name. Tables are in the unit and frame of their map. TUM and KITTI trajectories and tables of selected views hold
world_from_cam, the other formats cam_from_world.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from mmap import ACCESS_READ, mmap
from pathlib import Path
from struct import Struct, error as StructError
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.poses import (
    Float,
    are_rotations,
    camera_centers,
    invert_poses,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from wheretolook.utils.errors import TableError
from wheretolook.utils.files import MAX_TEXT_BYTES, check_file, parse_json, read_text

QUATERNION_COLUMNS = ("qw", "qx", "qy", "qz")
TRANSLATION_COLUMNS = ("tx", "ty", "tz")
POSE_COLUMNS = (*QUATERNION_COLUMNS, *TRANSLATION_COLUMNS)
FORMATS = (
    'a table with a line of names (x, y, z or qw, qx, qy, qz, tx, ty, tz, and others), "x y z", "name x y z", a TUM '
    'trajectory "t x y z qx qy qz qw", hloc\'s results "name qw qx qy qz tx ty tz", KITTI\'s matrices of 12 numbers, '
    "COLMAP's images.txt, images.bin or folder, or JSON as select writes it; lines that start with # are comments"
)
NAME_COLUMNS = ("image", "id", "waypoint", "name", "t", "timestamp")
_IMAGE_COLUMNS = ("image_id", *POSE_COLUMNS, "camera_id", "name")
_SYNONYMS = {
    **dict.fromkeys(("label", "filename", "file_name", "image_name"), "image"),
    **dict.fromkeys(("x/easting", "easting"), "x"),
    **dict.fromkeys(("y/northing", "northing"), "y"),
    **dict.fromkeys(("z/altitude", "altitude"), "z"),
}
MAX_ROWS = 500_000  # of a table
CAM_FROM_BASE = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # a camera that looks along x of a body whose z is up


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

    If the first row has a semicolon, tabulators or a comma, cells are separated by them and may be quoted; else by
    blanks. Commas in numbers between semicolons are decimal points. Raises TableError if the file is missing, no UTF-8
    text, too large, or has no rows.
    """
    try:
        lines = enumerate(map(str.strip, (read_text(path) if text is None else text).splitlines()), 1)
        rows = [*islice(((number, line) for number, line in lines if line and not line.startswith("#")), MAX_ROWS + 1)]
        if not rows:
            raise ValueError("it has no rows")
        if len(rows) > MAX_ROWS:
            raise ValueError(f"it has more than {MAX_ROWS:,} rows")
        separator = _separator(rows[0][1])
        if separator is None:
            return [(number, line.split()) for number, line in rows]
        cells = [*csv.reader((line for _, line in rows), delimiter=separator, skipinitialspace=True)]
        if len(cells) < len(rows):
            raise ValueError("a quoted cell has several lines")
        cells = [[*map(str.strip, row)] for row in cells]
        if separator == ";":  # of spreadsheets where a comma is the decimal point
            cells = [[_with_point(cell) for cell in row] for row in cells]
        return [(number, row) for (number, _), row in zip(rows, cells, strict=True)]
    except (OSError, ValueError, csv.Error) as error:
        raise TableError(f"the file cannot be read: {error}", path=path, fix="Give a text file of rows.") from error


def _separator(line: str) -> str | None:
    """Return what separates the cells of a line; None for blanks."""
    tabs = line.count("\t") > 1 and "\t\t" not in line  # names may have blanks
    marks = (";" in line, ";"), (tabs, "\t"), ("," in line, ",")
    return next((mark for is_used, mark in marks if is_used), None)


def _with_point(cell: str) -> str:
    number = cell.replace(",", ".")
    return number if _is_number(number) else cell


@dataclass(frozen=True, eq=False)
class NamedRows:
    """Rows of a table: pairs of line number, from 1, and cells; the number is 0 in files that are not lines of text."""

    path: Path
    header: tuple[str, ...]  # names of the columns
    rows: list[tuple[int, list[str]]]
    format: str = ""  # in words
    of_cameras: bool = False  # whether the format is of cameras, z forward, not of a robot's base

    @cached_property
    def columns(self) -> dict[str, int]:
        """Columns by name."""
        return {name: column for column, name in enumerate(self.header)}

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each row: that of its column of names, or else a count from 0."""
        column = next((self.columns[name] for name in NAME_COLUMNS if name in self.columns), None)
        return tuple(str(row) if column is None else cells[column] for row, (_, cells) in enumerate(self.rows))

    def label(self, row: int) -> str:
        """Return the line of a row, or its first cell."""
        number, cells = self.rows[row]
        return f"line {number}" if number else " ".join(cells[:1])

    def numbers(self, names: Sequence[str]) -> Float:
        """Return the numbers in some columns (N, len(names)). Raises TableError, with the line, if one is not finite."""
        table = np.empty((len(self.rows), len(names)))
        for row, (_, cells) in enumerate(self.rows):
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
                value = f"{self.label(row)}: {' '.join(cells)[:80]}"
                raise TableError(problem, path=self.path, value=value, fix=f"Give {FORMATS}.") from error
        return table


def read_named_rows(path: str | Path) -> NamedRows:
    """Read a file in one of `FORMATS`, or a folder of a COLMAP model, recognized by its content.

    Raises TableError if it is missing, in none of these formats, or in several that its numbers do not tell apart.
    """
    path = Path(path)
    if path.is_dir():
        path = next((path / name for name in ("images.bin", "images.txt") if (path / name).is_file()), path)
    try:  # once, since it may be a pipe
        if path.suffix == ".bin":
            return _read_images_binary(path)
        max_bytes = 100_000_000 if path.suffix == ".txt" else MAX_TEXT_BYTES  # an images.txt has the keypoints, too
        text = read_text(path, max_bytes, pipes=True)
        if text.lstrip().startswith(("{", "[")):
            return _json_rows(path, parse_json(text))
    except (OSError, ValueError, OverflowError, StructError) as error:
        raise TableError(f"the file cannot be read: {error}", path=path, fix=f"Give {FORMATS}.") from error
    if images := _image_rows(text):
        return NamedRows(path, _IMAGE_COLUMNS, images, "COLMAP's images.txt, world-to-camera", True)
    rows = read_rows(path, text)
    first = rows[0][1]
    if len(first) > 1 and not any(map(_is_number, first)):
        header = _names_of(first)
        rows = rows[1:]
    else:
        header = _commented_names(text, len(first))
    of_cameras = "camera-to-world" in text.partition("\n")[0]  # as select writes it
    if rows and not header:
        return _without_names(path, rows, of_cameras)
    if rows:
        if twice := next((name for name in header if name and header.count(name) > 1), None):
            raise TableError("two columns have the same name", path=path, value=twice, fix="Name or remove one.")
        return _with_names(path, header, rows, of_cameras)
    raise TableError("the file has no rows", path=path, value=" ".join(first)[:80], fix=f"Give {FORMATS}.")


def _names_of(cells: Sequence[str]) -> tuple[str, ...]:
    """Return names of columns in lower case, without metres as their unit, and synonyms by their usual names."""
    plain = [re.sub(r"\s*[\[(](m|s|)[\])]$", "", cell.strip("\"' ").lower()) for cell in cells]
    for prefix, kind in (("", "(p|pos|(.*[.])?position)"), ("q", "(q|quat|(.*[.])?orientation)")):  # EuRoC's, ROS's
        plain = [re.sub(rf"^{kind}[._](.*_)?([wxyz])$", rf"{prefix}\4", name) for name in plain]
    return tuple(name if _SYNONYMS.get(name) in plain else _SYNONYMS.get(name, name) for name in plain)


def _commented_names(text: str, n: int) -> tuple[str, ...]:
    """Return the names of n columns in the last such comment before the first row; empty if there is none."""
    found: tuple[str, ...] = ()
    for line in map(str.strip, text.splitlines()):
        if line and not line.startswith("#"):
            break
        comment = line.strip("# \t")
        names = _names_of(comment.split(_separator(comment)))
        if len(names) == n and ({*"xyz"} <= {*names} or {*TRANSLATION_COLUMNS} <= {*names}):
            found = names
    return found


def _with_names(path: Path, header: tuple[str, ...], rows: list[tuple[int, list[str]]], of_cameras: bool) -> NamedRows:
    """Describe rows whose columns have names. Raises TableError for degrees, and orders of poses of no convention."""
    degrees = [name for name in header if "longitude" in name or name in ("lon", "lng")]
    if degrees and "x" not in header:
        fix = "Convert longitude and latitude to metres, such as UTM's easting and northing, named x and y."
        raise TableError("positions are in metres, not degrees", path=path, value=degrees[0], fix=fix)
    table = NamedRows(path, header, rows)
    about = f"columns {', '.join(header[:8])}{', ...' if len(header) > 8 else ''}"
    of_cameras |= "quaternion_xyzw" in header  # of selected views
    if {*QUATERNION_COLUMNS} <= {*header}:
        is_inverse = holds_cam_from_world(table)
        of_cameras |= is_inverse
        about += f", {'world-to-camera' if is_inverse else 'camera-to-world'}"
    return NamedRows(path, header, rows, about, of_cameras)


def _without_names(path: Path, rows: list[tuple[int, list[str]]], of_cameras: bool) -> NamedRows:
    """Recognize rows without names of their columns by the number of cells, unit quaternions and rotations."""
    n = len(rows[0][1])
    if n == 4 and all(_is_number(cells[0]) for _, cells in rows):
        ids = NamedRows(path, ("id", *"xyz"), rows).numbers(["id"])[:, 0]
        is_time = (np.diff(ids) > 0).all()
        is_number = not (ids % 1).any() and len({*ids}) == len(ids)
        if not is_time and not is_number:
            fix = "Start the file with '# x y z yaw_deg' or '# id x y z'."
            problem = "four columns of numbers do not show whether they are id x y z, or x y z and a yaw"
            raise TableError(problem, path=path, value=" ".join(rows[0][1])[:80], fix=fix)
    if n in (3, 4):
        return NamedRows(path, ("id", *"xyz")[4 - n :], rows, "name x y z" if n == 4 else "x y z")
    if n in (12, 13, 16, 17):
        return _matrix_rows(path, rows)
    if n != 8:
        value = " ".join(rows[0][1])[:80]
        raise TableError("the rows are of no known format", path=path, value=value, fix=f"Give {FORMATS}.")
    values = NamedRows(path, ("name", *"1234567"), rows).numbers("1234567")
    units = [np.abs(np.linalg.norm(part, axis=1) - 1) < 0.01 for part in (values[:, :4], values[:, 3:])]
    first, last = (float(unit.mean()) for unit in units)
    is_named = not all(_is_number(cells[0]) for _, cells in rows)
    if first > last or (first == last > 0 and is_named):
        return NamedRows(
            path, ("name", *POSE_COLUMNS), rows, "name qw qx qy qz tx ty tz (hloc's results), world-to-camera", True
        )
    is_tied = first == last and path.suffix == ".tum"
    if not is_named and (last > first or is_tied or not values[:, 3:].any()):
        header = ("t", *"xyz", "qx", "qy", "qz", "qw")
        return NamedRows(path, header, rows, "TUM trajectory t x y z qx qy qz qw, camera-to-world", of_cameras)
    problem = "unit quaternions do not show in which order the eight columns are"
    fix = "Start the file with '# name qw qx qy qz tx ty tz' (world-to-camera) or '# t tx ty tz qx qy qz qw' (camera-to-world)."
    raise TableError(problem, path=path, value=" ".join(rows[0][1])[:80], fix=fix)


def _matrix_rows(path: Path, rows: list[tuple[int, list[str]]]) -> NamedRows:
    """Convert KITTI's matrices world_from_cam, of 12 or 16 numbers by row, and perhaps a number of the frame before."""
    n = len(rows[0][1])
    named = n % 4
    columns = tuple(f"m{column}" for column in range(n - named))
    values = NamedRows(path, ("t",) * named + columns, rows).numbers(columns)
    poses = values[:, :12].reshape(-1, 3, 4)
    rotations = poses[:, :, :3]
    rigid = are_rotations(rotations, 0.01) & (values[:, 12:] == (0, 0, 0, 1)[: n - named - 12]).all(1)
    for row in np.flatnonzero(~rigid).tolist():
        value = f"line {rows[row][0]}: {' '.join(rows[row][1])[:80]}"
        raise TableError("a matrix is no rotation and translation", path=path, value=value, fix=f"Give {FORMATS}.")
    numbers = np.concatenate([poses[:, :, 3], quaternion_from_rotation(rotations)], axis=1).tolist()
    cells = [(line, [*row[:named], *map(repr, v)]) for (line, row), v in zip(rows, numbers, strict=True)]
    header = ("t",) * named + ("x", "y", "z", *QUATERNION_COLUMNS)
    return NamedRows(path, header, cells, f"KITTI's matrices of {n - named} numbers, camera-to-world")


def _json_rows(path: Path, content: Any) -> NamedRows:
    """Convert views as `Views.save` writes them, a list of objects, or an object of names and coordinates."""
    fix = 'Give {"name": [x, y, z]}, or the views that select writes.'
    records = content.get("views", content) if isinstance(content, dict) else content
    rows: list[tuple[int, list[str]]] = []
    if isinstance(records, list) and records and all(isinstance(record, dict) for record in records):
        header = tuple(records[0])
        if all({*record} == {*header} for record in records):
            rows = [(0, [str(record[name]) for name in header]) for record in records]
    elif isinstance(records, dict):
        header = ("image", *"xyz")
        if all(isinstance(values, list) and len(values) == 3 for values in records.values()):
            rows = [(0, [name, *map(str, values)]) for name, values in records.items()]
    if not rows or len(rows) > MAX_ROWS:
        raise TableError("the JSON holds no poses or positions", path=path, value=str(content)[:80], fix=fix)
    return NamedRows(path, header, rows, f"JSON of {', '.join(header[:8])}", "cam_from_world" in header)


def _read_images_binary(path: Path) -> NamedRows:
    """Read the poses in COLMAP's images.bin. Raises ValueError or StructError if the file is truncated or corrupt."""
    check_file(path)
    record, count = Struct("<I7dI"), Struct("<Q")
    rows: list[tuple[int, list[str]]] = []
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        n_images = count.unpack_from(data)[0]
        if n_images > MAX_ROWS:
            raise ValueError(f"it has {n_images:,} images, more than {MAX_ROWS:,}")
        at = count.size
        for _ in range(n_images):
            values = record.unpack_from(data, at)
            end = data.find(b"\0", at + record.size)
            name = data[at + record.size : max(end, at + record.size)].decode()
            at = end + 9 + 24 * count.unpack_from(data, end + 1)[0]
            rows.append((0, [*map(repr, values), name]))
        if at != len(data):
            raise ValueError("it is truncated or corrupt, or no images.bin")
    if not rows:
        raise ValueError("it has no images")
    return NamedRows(path, _IMAGE_COLUMNS, rows, "COLMAP's images.bin, world-to-camera", True)


def is_of_base(
    table: NamedRows, cam_from_world: Float, up: ArrayLike = (0.0, 0.0, 1.0), frame: str | None = None
) -> bool:
    """Return whether the poses (N, 3, 4) of a table are those of a robot's base (x forward, z up), not of a camera.

    `frame` states it, "base" or "camera". By default a file holds a base if all its z axes are within 45 degrees of
    `up` (3,), and the format is not of cameras.
    """
    if frame is not None or table.of_cameras:
        return frame == "base"
    return bool((cam_from_world[:, 2, :3] @ np.asarray(up, dtype=np.float64) > np.sqrt(0.5)).all())


def locations_of_rows(table: NamedRows) -> Float:
    """Return the locations (N, 3) in rows: coordinates, or the centres of cameras. Raises TableError as `poses_of_rows`."""
    if "x" not in table.columns and holds_cam_from_world(table):
        return camera_centers(poses_of_rows(table))
    return table.numbers(TRANSLATION_COLUMNS if "x" not in table.columns and "tx" in table.columns else "xyz")


def poses_of_rows(table: NamedRows, orientations_only: bool = False) -> Float:
    """Return the poses cam_from_world (N, 3, 4) in rows, of the columns that `wheretolook.geometry.views.Views.read` names.

    With `orientations_only` positions may be missing, and are then 0. Raises TableError, with the line, for others.
    """
    path = table.path
    quaternions = table.numbers(QUATERNION_COLUMNS)
    lengths = np.linalg.norm(quaternions, axis=1)
    for row in np.flatnonzero(np.abs(lengths - 1) > 0.01).tolist():
        value = f"{table.label(row)}: {lengths[row]:.4g}"
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
    tum = (*TRANSLATION_COLUMNS, "qx", "qy", "qz", "qw")
    if order not in (POSE_COLUMNS, tum):
        problem = "the order of the columns does not show whether poses are camera-to-world or world-to-camera"
        fix = f"Order them as TUM, {','.join(tum)}, camera-to-world, or COLMAP, {','.join(POSE_COLUMNS)}, world-to-camera."
        raise TableError(problem, path=table.path, value=",".join(order), fix=fix)
    return order == POSE_COLUMNS


def _image_rows(text: str) -> list[tuple[int, list[str]]]:
    """Read the line of each image in an images.txt, whose lines of keypoints may be missing; empty if it is none.

    A line of keypoints has three numbers each, so its number of cells is a multiple of three, as that of an image with
    a name that is no number is not.
    """
    rows: list[tuple[int, list[str]]] = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        cells = line.split(maxsplit=len(_IMAGE_COLUMNS) - 1)
        if not rows and not (len(cells) == 10 and cells[0].isdigit() and cells[8].isdigit() and not _is_matrix(line)):
            return []
        if not (rows and _is_points(line)):
            rows.append((number, cells))
    return rows


def _is_points(line: str) -> bool:
    cells = line.split(maxsplit=12)[:12]
    return len(cells) % 3 == 0 and all(map(_is_number, cells))


def _is_matrix(line: str) -> bool:
    cells = line.split()
    return len(cells) in (12, 13, 16, 17) and all(map(_is_number, cells))


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
    digits = [""] * 7 if exact else [f".{decimals}f"] * 4 + [".9f"] * 3
    return [" ".join(map(format, row, digits)) for row in values.tolist()]


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
