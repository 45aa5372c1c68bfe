"""Read and write the benchmark's text files: poses "id qw qx qy qz tx ty tz" and errors "id metres degrees"."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.poses import Float, quaternion_from_rotation, rotation_from_quaternion
from wheretolook.utils.errors import TableError
from wheretolook.utils.files import write_text

IMAGE_ENDING = ".png"
_UNIT_TOLERANCE = 1e-5  # of a quaternion's length, as numpy.isclose's in evaluate_plan.py


@dataclass(frozen=True, eq=False)
class PoseFile:
    """N poses in the order of the file."""

    ids: tuple[str, ...]
    quaternions: Float  # (N, 4) wxyz, cam_from_world, as in the file
    translations: Float  # (N, 3) metres, cam_from_world

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def cam_from_world(self) -> Float:
        """(N, 3, 4)."""
        return np.concatenate([rotation_from_quaternion(self.quaternions), self.translations[:, :, None]], axis=2)


@dataclass(frozen=True, eq=False)
class ErrorFile:
    """N errors of estimated poses in the order of the file."""

    ids: tuple[str, ...]  # without the image's suffix
    metres: Float  # (N,) distance between camera centres; NaN without a pose
    degrees: Float  # (N,) angle between orientations

    def __len__(self) -> int:
        return len(self.ids)


def write_poses(path: Path, ids: Sequence[str], cam_from_world: ArrayLike) -> None:
    """Write poses (N, 3, 4) atomically, creating the folder if missing."""
    poses = np.asarray(cam_from_world, dtype=np.float64).reshape(-1, 3, 4)
    values = np.concatenate([quaternion_from_rotation(poses[:, :, :3]), poses[:, :, 3]], axis=1).tolist()
    lines = [" ".join([name, *map(repr, row)]) for name, row in zip(ids, values, strict=True)]
    write_text(path, "\n".join(["# id qw qx qy qz tx ty tz", *lines]) + "\n")


def read_poses(path: Path) -> PoseFile:
    """Read a file of poses. Raises a TableError if it is missing, a line is not a pose, or ids repeat."""
    ids, values = _read(path, 8, "a pose is id qw qx qy qz tx ty tz")
    table = np.array(values, dtype=np.float64).reshape(-1, 7)
    is_unit = np.abs(np.linalg.norm(table[:, :4], axis=1) - 1) <= _UNIT_TOLERANCE
    invalid = np.flatnonzero(~(is_unit & np.isfinite(table).all(axis=1)))
    if len(invalid):
        fix = "Write finite numbers and quaternions qw qx qy qz of length 1, or omit the pose."
        value = f"{ids[invalid[0]]}: {table[invalid[0]]}"
        raise TableError("this is not a pose", path=path, value=value, fix=fix)
    return PoseFile(ids, table[:, :4], table[:, 4:])


def write_errors(path: Path, ids: Sequence[str], metres: ArrayLike, degrees: ArrayLike) -> None:
    """Write errors (N,) in metres and degrees, NaN without a pose, in the order of the images' file names (1, 10, 2)."""
    rows = zip(ids, np.asarray(metres).tolist(), np.asarray(degrees).tolist(), strict=True)
    ordered = sorted(rows, key=lambda row: row[0] + IMAGE_ENDING)
    write_text(path, "".join(f"{name} {m!r} {deg!r}\n" for name, m, deg in ordered))


def read_errors(path: Path) -> ErrorFile:
    """Read a file of errors, from `write_errors` or match_and_localize.py, which keeps the suffix of failed images.

    Raises a TableError if it is missing or empty, a line is not an error, or ids repeat.
    """
    ids, values = _read(path, 3, "an error is id, metres and degrees")
    table = np.array(values, dtype=np.float64).reshape(-1, 2)
    return ErrorFile(ids, table[:, 0], table[:, 1])


def _read(path: Path, n_cells: int, what: str) -> tuple[tuple[str, ...], list[list[float]]]:
    if not path.is_file():
        raise TableError("there is no such file", path=path, fix=f"In this file, {what}.")
    ids: list[str] = []
    values: list[list[float]] = []
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
        cells = line.split()
        if not cells or line.startswith("#"):
            continue
        try:
            numbers = [float(cell) for cell in cells[1:]]
        except ValueError:
            numbers = []
        if len(cells) != n_cells or len(numbers) != n_cells - 1:
            raise TableError(what, path=path, value=f"line {number}: {line[:80]}", fix="Correct the line.")
        ids.append(cells[0].removesuffix(IMAGE_ENDING))
        values.append(numbers)
    if not ids:
        raise TableError("the file is empty", path=path, fix=f"In this file, {what}.")
    if len({*ids}) < len(ids):
        twice = next(name for row, name in enumerate(ids) if name in ids[:row])
        raise TableError("an id appears twice", path=path, value=twice, fix="Keep one line per id.")
    return tuple(ids), values
