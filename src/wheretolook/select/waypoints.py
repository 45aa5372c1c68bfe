"""Places to look from: read from a file in any of the usual formats, or given as numbers."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import TableError

FORMATS = """\
CSV with columns x, y, z (and id, if there is one; a line of names or none), the Active Localization Benchmark's text
"id x y z", a TUM trajectory "t x y z qx qy qz qw", or "x y z"; lines that start with # are comments"""

_NAMES = {"x": ("x", "tx"), "y": ("y", "ty"), "z": ("z", "tz")}
_IDS = ("id", "waypoint", "name", "t", "timestamp")


@dataclass(frozen=True, eq=False)
class Waypoints:
    """W places, in the order given."""

    points: Float  # (W, 3) float64, world, metres
    ids: tuple[str, ...]  # W names: those of the file, a trajectory's time stamps, or 0, 1, ...
    lines: tuple[int, ...] = ()  # line of the file that each stands in, counted from 1; empty if they are of no file
    path: Path | None = None  # the file

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: NDArray[np.integer] | NDArray[np.bool_]) -> Waypoints:
        """Some of them."""
        kept = np.arange(len(self))[rows]
        lines = tuple(self.lines[row] for row in kept) if self.lines else ()
        return Waypoints(self.points[kept], tuple(self.ids[row] for row in kept), lines, self.path)

    def where(self, row: int) -> str:
        """A waypoint in words: its line or name, and its coordinates."""
        at = ", ".join(f"{value:.10g}" for value in self.points[row])
        return f"{f'line {self.lines[row]}' if self.lines else f'waypoint {self.ids[row]}'}: ({at})"

    @classmethod
    def of(cls, points: ArrayLike | Waypoints, ids: Sequence[str] = ()) -> Waypoints:
        """From coordinates (W, 3) or (3,) in metres; their names, if they have any.

        Raises a TableError if there are none, they have another shape, or one is not finite.
        """
        if isinstance(points, Waypoints):
            return points
        try:
            at = np.atleast_2d(np.asarray(points, dtype=np.float64))
        except (TypeError, ValueError) as error:
            raise TableError(f"waypoints are numbers: {error}", fix="Give x, y, z in metres.") from error
        if at.ndim != 2 or at.shape[1] != 3 or len(at) == 0:
            fix = "Give an array (W, 3) of x, y, z in metres."
            raise TableError("waypoints have three coordinates each", value=at.shape, fix=fix)
        if ids and len(ids) != len(at):
            raise TableError("as many names as waypoints are needed", value=(len(ids), len(at)))
        return cls(at, tuple(ids) or tuple(map(str, range(len(at)))))._checked()

    def _checked(self) -> Waypoints:
        for row in np.flatnonzero(~np.isfinite(self.points).all(axis=1)).tolist():
            raise TableError("a waypoint is not finite", path=self.path, value=self.where(row), fix="Correct it.")
        return self


def read_waypoints(path: str | Path) -> Waypoints:
    """Read a file in one of `FORMATS`, detected from its columns.

    Raises a TableError, with the line, if the file is missing, empty, has other columns, or a value is not a number.
    """
    path = Path(path)
    if not path.is_file():
        fix = "Give a file, or coordinates such as 1,2,1.5."
        raise TableError("there is no such file of waypoints", path=path, fix=fix)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise TableError("not a UTF-8 text file", path=path, fix=f"Give {FORMATS}.") from error
    stripped = [(number, line.strip()) for number, line in enumerate(text.splitlines(), 1)]
    rows = [(number, line) for number, line in stripped if line and not line.startswith("#")]
    if not rows:
        raise TableError("there are no waypoints in the file", path=path, fix=f"Give {FORMATS}.")
    separator = next((mark for mark in ",;" if mark in rows[0][1]), None)
    cells = [(number, _cells(line, separator)) for number, line in rows]
    header = cells[0][1] if not any(map(_is_number, cells[0][1])) and len(cells[0][1]) > 1 else None
    if header is not None:
        columns, id_column = _columns_from_header(header, path)
        cells = cells[1:]
        if not cells:
            raise TableError("there are no waypoints below the header", path=path, fix=f"Give {FORMATS}.")
    else:
        columns, id_column = _columns_by_count(*cells[0], path)
    n_named = 1 + max(*columns, id_column or 0)  # a header may be longer than what stands below it
    points: list[list[float]] = []
    ids: list[str] = []
    for number, row in cells:
        width = len(cells[0][1])
        if len(row) != width or width < n_named or not all(_is_number(row[column]) for column in columns):
            value = f"line {number}: {(separator or ' ').join(row)[:80]}"
            n, like = (n_named, "the header names") if width < n_named else (width, "as the first has")
            problem = f"a waypoint needs numbers in {n} columns, {like}"
            raise TableError(problem, path=path, value=value, fix=f"Give {FORMATS}.")
        points.append([float(row[column]) for column in columns])
        ids.append(str(len(ids)) if id_column is None else row[id_column])
    found = Waypoints(np.array(points), tuple(ids), tuple(number for number, _ in cells), path)
    return found._checked()


def parse_points(texts: Sequence[str]) -> Waypoints:
    """Parse texts "x,y,z". Raises TableError if one is not three numbers."""
    points = []
    for text in texts:
        cells = text.strip().split(",")
        if len(cells) != 3 or not all(map(_is_number, cells)):
            fix = "Write x,y,z in metres without blanks, such as 1.5,-2,1.2, or name a file."
            raise TableError("a waypoint is three numbers", value=text.strip(), fix=fix)
        points.append([float(cell) for cell in cells])
    return Waypoints.of(points)


def _cells(line: str, separator: str | None) -> list[str]:
    """Cells of a line; between commas or semicolons they may stand in quotes."""
    if separator is None:
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True))]
    except csv.Error:  # longer than any table's cell
        return line.split(separator)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _columns_from_header(header: list[str], path: Path) -> tuple[list[int], int | None]:
    """Return the columns of x, y, z and of the ids (or None) from the header."""
    names = [cell.strip("\"' ").lower() for cell in header]
    columns = [next((names.index(name) for name in known if name in names), None) for known in _NAMES.values()]
    if None in columns:
        fix = "Name the columns x, y and z."
        raise TableError("the columns of waypoints are missing", path=path, value=",".join(header)[:80], fix=fix)
    return [c for c in columns if c is not None], next((names.index(name) for name in _IDS if name in names), None)


def _columns_by_count(number: int, row: list[str], path: Path) -> tuple[list[int], int | None]:
    """Return the columns of x, y, z and of the ids (or None) from the number of columns."""
    if len(row) not in (3, 4, 8):
        value = f"line {number}: {' '.join(row)[:80]}"
        problem = f"waypoints have 3, 4 or 8 columns, these have {len(row)}"
        raise TableError(problem, path=path, value=value, fix=f"Give {FORMATS}.")
    return ([0, 1, 2], None) if len(row) == 3 else ([1, 2, 3], 0)
