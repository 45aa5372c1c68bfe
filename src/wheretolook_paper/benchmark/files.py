"""The benchmark's text files: poses, "id qw qx qy qz tx ty tz" (world-to-camera), and errors, "id metres degrees"."""

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
_UNIT = (
    1e-5  # that the length of a quaternion may be off 1, relatively; numpy.isclose's, by which evaluate_plan.py stops
)


@dataclass(frozen=True, eq=False)
class PoseFile:
    """N poses, in the order of the file."""

    ids: tuple[str, ...]
    quaternions: Float  # (N, 4) wxyz, world-to-camera, as they stand in the file
    translations: Float  # (N, 3) metres, world-to-camera

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def cam_from_world(self) -> Float:
        """(N, 3, 4)."""
        return np.concatenate([rotation_from_quaternion(self.quaternions), self.translations[:, :, None]], axis=2)


@dataclass(frozen=True, eq=False)
class ErrorFile:
    """N errors of estimated poses, in the order of the file."""

    ids: tuple[str, ...]  # without the image's ending
    metres: Float  # (N,) distance between camera centres; NaN where no pose was found
    degrees: Float  # (N,) angle between orientations

    def __len__(self) -> int:
        return len(self.ids)


def write_poses(path: Path, ids: Sequence[str], cam_from_world: ArrayLike) -> None:
    """Write poses (N, 3, 4), atomically; the folder is made if missing."""
    poses = np.asarray(cam_from_world, dtype=np.float64).reshape(-1, 3, 4)
    values = np.concatenate([quaternion_from_rotation(poses[:, :, :3]), poses[:, :, 3]], axis=1).tolist()
    lines = [" ".join([name, *map(repr, row)]) for name, row in zip(ids, values, strict=True)]
    write_text(path, "\n".join(["# id qw qx qy qz tx ty tz", *lines]) + "\n")


def read_poses(path: Path) -> PoseFile:
    """Read a file of poses. Raises a TableError, with the line, if it is missing, a line is no pose, or ids repeat."""
    ids, values = _read(path, 8, "a pose is id qw qx qy qz tx ty tz")
    table = np.array(values, dtype=np.float64).reshape(-1, 7)
    off = ~(np.abs(np.linalg.norm(table[:, :4], axis=1) - 1) <= _UNIT)  # nor NaN
    lost = ~np.isfinite(table).all(axis=1)
    if lost.any():
        row = int(np.flatnonzero(lost)[0])
        value = f"{ids[row]}: {table[row]}"
        fix = "Leave such a pose out."
        raise TableError("a pose is NaN or infinite", path=path, value=value, fix=fix)
    if off.any():
        row = int(np.flatnonzero(off)[0])
        fix = "Write qw qx qy qz, of length 1."
        raise TableError(
            "a quaternion is not of unit length", path=path, value=f"{ids[row]}: {table[row, :4]}", fix=fix
        )
    return PoseFile(ids, table[:, :4], table[:, 4:])


def write_errors(path: Path, ids: Sequence[str], metres: ArrayLike, degrees: ArrayLike) -> None:
    """Write errors (N,) in metres and degrees, NaN where there is no pose, in the order of the images' file names.

    That is the order in which the benchmark's own script writes them: 1, 10, 2.
    """
    rows = zip(ids, np.asarray(metres).tolist(), np.asarray(degrees).tolist(), strict=True)
    ordered = sorted(rows, key=lambda row: row[0] + IMAGE_ENDING)
    write_text(path, "".join(f"{name} {m!r} {deg!r}\n" for name, m, deg in ordered))


def read_errors(path: Path) -> ErrorFile:
    """Read a file of errors, of ours or of match_and_localize.py, which writes the image's name where it found no pose.

    Raises a TableError, with the line, if it is missing, empty, a line is none, or ids repeat.
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
        raise TableError("an id stands there twice", path=path, value=twice, fix="Each id needs one line.")
    return tuple(ids), values
