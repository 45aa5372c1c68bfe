"""Read and write the benchmark's text files: poses "id qw qx qy qz tx ty tz" and errors "id metres degrees"."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.pose_files import pose_texts, poses_of_values, read_rows
from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import TableError
from wheretolook.utils.files import write_text

IMAGE_ENDING = ".png"
_UNIT_TOLERANCE = 1e-5  # of a quaternion's length, as numpy.isclose's in evaluate_plan.py


@dataclass(frozen=True, eq=False)
class PoseFile:
    """N poses in the order of the file."""

    ids: tuple[str, ...]
    quaternions: Float  # (N, 4) wxyz, cam_from_world, as in the file
    cam_from_world: Float  # (N, 3, 4)


@dataclass(frozen=True, eq=False)
class ErrorFile:
    """N errors of estimated poses in the order of the file."""

    ids: tuple[str, ...]  # without the image's suffix
    metres: Float  # (N,) distance between camera centres; NaN without a pose
    degrees: Float  # (N,) angle between orientations


def write_poses(path: Path, ids: Sequence[str], cam_from_world: ArrayLike) -> None:
    """Write poses (N, 3, 4) atomically, creating the folder if missing."""
    lines = [f"{name} {pose}\n" for name, pose in zip(ids, pose_texts(cam_from_world, exact=True), strict=True)]
    write_text(path, "".join(["# id qw qx qy qz tx ty tz\n", *lines]))


def read_poses(path: Path) -> PoseFile:
    """Read a file of poses. Raises a TableError if it is missing, a line is not a pose, or ids repeat."""
    ids, values = _read(path, "id qw qx qy qz tx ty tz")
    is_unit = np.abs(np.linalg.norm(values[:, :4], axis=1) - 1) <= _UNIT_TOLERANCE
    invalid = np.flatnonzero(~(is_unit & np.isfinite(values).all(axis=1)))
    if len(invalid):
        fix = "Write finite numbers and quaternions of length 1, or omit the pose."
        raise TableError("this is not a pose", path=path, value=ids[invalid[0]], fix=fix)
    return PoseFile(ids, values[:, :4], poses_of_values(values))


def write_errors(path: Path, ids: Sequence[str], metres: ArrayLike, degrees: ArrayLike) -> None:
    """Write errors (N,) in metres and degrees, NaN without a pose, in the order of the images' file names (1, 10, 2)."""
    rows = zip(ids, np.asarray(metres).tolist(), np.asarray(degrees).tolist(), strict=True)
    ordered = sorted(rows, key=lambda row: row[0] + IMAGE_ENDING)
    write_text(path, "".join(f"{name} {m!r} {deg!r}\n" for name, m, deg in ordered))


def read_errors(path: Path) -> ErrorFile:
    """Read a file of errors, from `write_errors` or match_and_localize.py, which keeps the suffix of failed images.

    Raises a TableError if it is missing or empty, a line is not an error, or ids repeat.
    """
    ids, values = _read(path, "id metres degrees")
    return ErrorFile(ids, values[:, 0], values[:, 1])


def _read(path: Path, columns: str) -> tuple[tuple[str, ...], Float]:
    """Read the ids (N,) and numbers (N, C) of a file whose lines have the named columns."""
    rows = [cells for _, cells in read_rows(path)]
    ids = tuple(cells[0].removesuffix(IMAGE_ENDING) for cells in rows)
    try:
        values = np.array([cells[1:] for cells in rows], dtype=np.float64)
    except ValueError as error:
        raise TableError(f"its lines are not {columns!r}: {error}", path=path) from error
    if values.shape[1:] != (columns.count(" "),) or len({*ids}) < len(ids):
        raise TableError(f"its lines are not {columns!r}, each id once", path=path)
    return ids, values
