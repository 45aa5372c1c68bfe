"""Locations to look from: read from files, on a grid in free space, and checked against a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.geometry.pose_files import (
    QUATERNION_COLUMNS,
    holds_cam_from_world,
    locations_of_rows,
    poses_of_rows,
    read_named_rows,
)
from wheretolook.geometry.poses import Float, pan_tilt_angles, quaternion_from_rotation, rotation_from_quaternion
from wheretolook.looks.selection import MAX_VIEWS
from wheretolook.utils.errors import ConfigError, SceneError, TableError, check_limits, check_pitch, check_range, reject

if TYPE_CHECKING:
    from wheretolook.inputs.localization_map import LocalizationMap

MAX_LOCATIONS = 1_000_000  # voxels of a grid


@dataclass(frozen=True, eq=False)
class Waypoints:
    """W locations, in the order given."""

    points: Float  # (W, 3) float64, in the map's own frame and unit
    ids: tuple[str, ...]  # W names: those of the file, a trajectory's time stamps, or 0, 1, ...
    lines: tuple[int, ...] = ()  # line of the file that each is in, counted from 1; empty without a file
    path: Path | None = None  # the file
    # The robot's heading: (W, 1) yaws in degrees in the upright map, or (W, 4) quaternions wxyz, map_from_robot.
    headings: Float | None = None
    read_as: str = ""  # format of the file
    of_base: bool | None = None  # whether quaternions are of a robot's base, not of a camera; None as `is_of_base`

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: NDArray[np.integer] | NDArray[np.bool_]) -> Waypoints:
        """Return some of them."""
        kept = np.arange(len(self))[rows]
        lines = tuple(self.lines[row] for row in kept) if self.lines else ()
        headings = None if self.headings is None else self.headings[kept]
        ids = tuple(self.ids[row] for row in kept)
        return replace(self, points=self.points[kept], ids=ids, lines=lines, headings=headings)

    def heading_deg(self, world_from_map: Float) -> Float:
        """Return the robot's yaw in degrees at each waypoint, (W,), in the world, by the rotation (3, 3) to it.

        A quaternion is that of a camera, which looks along z, or of a robot's base, which heads along x: see `of_base`.
        Raises a TableError if a heading is unknown.
        """
        yaw = np.full(len(self), np.nan) if self.headings is None else self.headings[:, 0]
        if self.headings is not None and self.headings.shape[1] == 4:
            is_known = np.linalg.norm(self.headings, axis=1) > 0
            axes = world_from_map @ rotation_from_quaternion(self.headings + ~is_known[:, None])
            is_base = (axes[is_known, 2, 2] > np.sqrt(0.5)).all() if self.of_base is None else self.of_base
            forward = axes[..., 0] if is_base else axes[..., 2]
            yaw = np.where(is_known, np.degrees(pan_tilt_angles(forward)[0]), np.nan)
        for row in np.flatnonzero(~np.isfinite(yaw)).tolist():
            fix = "Give a TUM trajectory or a CSV with heading_deg or qw, qx, qy, qz, in Python heading_deg; or leave pan out."
            raise TableError("a limit on pan needs the heading", path=self.path, value=self.where(row), fix=fix)
        return yaw

    def where(self, row: int) -> str:
        """Describe a waypoint by its line or name, and its coordinates."""
        at = ", ".join(f"{value:.10g}" for value in self.points[row])
        return f"{self.label(row)}: ({at})"

    def label(self, row: int) -> str:
        """Return the line of a waypoint, or its name."""
        return f"line {self.lines[row]}" if self.lines and self.lines[row] else f"waypoint {self.ids[row]}"

    @classmethod
    def of(
        cls, points: ArrayLike | Waypoints, ids: Sequence[str] = (), heading_deg: ArrayLike | None = None
    ) -> Waypoints:
        """Make waypoints from coordinates (W, 3) or (3,), optional names and optional headings (W,) in degrees.

        Raises a TableError if there are none, they have another shape, or one is not finite.
        """
        if isinstance(points, Waypoints):
            return points
        try:
            at = np.atleast_2d(np.asarray(points, dtype=np.float64))
        except (TypeError, ValueError) as error:
            raise TableError(f"waypoints are numbers: {error}", fix="Give x, y, z.") from error
        if at.ndim != 2 or at.shape[1] != 3 or len(at) == 0:
            fix = "Give x,y,z of each, as 1,2,1.5 or a row of an array (W, 3)."
            raise TableError("waypoints have three coordinates each", value=at.shape, fix=fix)
        if ids and len(ids) != len(at):
            raise TableError("as many names as waypoints are needed", value=(len(ids), len(at)))
        headings = None if heading_deg is None else np.asarray(heading_deg, dtype=np.float64).reshape(-1, 1)
        if headings is not None and len(headings) != len(at):
            raise TableError("as many headings as waypoints are needed", value=(len(headings), len(at)))
        return cls(at, tuple(ids) or tuple(map(str, range(len(at)))), headings=headings)._checked()

    def _checked(self) -> Waypoints:
        for row in np.flatnonzero(~np.isfinite(self.points).all(axis=1)).tolist():
            raise TableError("a waypoint is not finite", path=self.path, value=self.where(row), fix="Correct it.")
        return self


def read_waypoints(path: str | Path, frame: str | None = None) -> Waypoints:
    """Read a file in one of `geometry.pose_files.FORMATS`, recognized by its content.

    `frame` states whose orientations it holds, "base" or "camera"; None as `is_of_base`. Raises a TableError, with the
    line, if the file is missing, empty, has other columns, or a value is not a number.
    """
    table = read_named_rows(path)
    points = locations_of_rows(table)
    kinds = (("heading_deg",), ("yaw_deg",), QUATERNION_COLUMNS)
    known = next((table.numbers(kind) for kind in kinds if {*kind} <= {*table.columns}), None)
    if known is not None and known.shape[1] == 4 and holds_cam_from_world(table):
        known = quaternion_from_rotation(np.swapaxes(poses_of_rows(table)[:, :, :3], 1, 2))
    of_base = frame == "base" if frame or table.of_cameras else None
    lines = tuple(number for number, _ in table.rows)
    return Waypoints(points, table.names, lines, table.path, known, table.format, of_base)


def given_waypoints(texts: Sequence[str], frame: str | None = None) -> Waypoints:
    """Return the waypoints of texts "x,y,z", or of one that names a file or the folder of a viewpoint map.

    Raises as `read_waypoints`, `parse_points` and `ViewpointMap.load`.
    """
    if len(texts) == 1 and (Path(texts[0].strip()) / "viewpoint_map.json").is_file():
        from wheretolook.planning.viewpoint_map import ViewpointMap

        return Waypoints.of(ViewpointMap.load(texts[0].strip()).locations)
    if len(texts) == 1 and (Path(texts[0].strip()).exists() or texts[0].count(",") != 2):
        return read_waypoints(texts[0].strip(), frame)
    return parse_points(texts)


def parse_points(texts: Sequence[str]) -> Waypoints:
    """Parse texts "x,y,z". Raises TableError if one is not three numbers."""
    parts = [text.split(",") for text in texts]
    if len(texts) > 1 and any(len(part) != 3 or not all(part) for part in parts):
        joined = ",".join(filter(None, ",".join(texts).split(",")[:6]))
        fix = f"Write {','.join(joined.split(',')[:3])} without blanks; blanks separate waypoints."
        raise TableError("the coordinates of a waypoint are separated by commas", value=" ".join(texts)[:80], fix=fix)
    return Waypoints.of(parts)


def grid_waypoints(
    localization_map: LocalizationMap, space: Any, spacing_m: float, height_m: float | None = None
) -> Waypoints:
    """Return locations in the world, `spacing_m` apart in all free space, or at one height; their names are voxel ids.

    Raises a ConfigError if the spacing is no length or makes too many, or the height is outside the map or its unit
    unknown, a SceneError if none is free.
    """
    if not 0 < spacing_m < np.inf:
        raise ConfigError("the spacing of a grid is a length in metres", value=spacing_m, fix="Such as 0.5.")
    low, high = np.array(space.bounds, dtype=np.float64)
    if height_m is not None:
        localization_map.frame.check_metric("--camera-z is")
        problem = f"--camera-z is outside the map, whose z is {low[2]:.3g} to {high[2]:.3g} m"
        reject((not low[2] <= height_m <= high[2], problem, height_m))
        low[2] = high[2] = height_m
    cells = np.maximum(np.ceil((high - low) / spacing_m), 1)
    if np.prod(cells) > MAX_LOCATIONS:
        fix = f"The map is {high[0] - low[0]:.3g} x {high[1] - low[1]:.3g} x {high[2] - low[2]:.3g} m; widen the grid."
        raise ConfigError(f"the grid has more than {MAX_LOCATIONS:,} locations", value=spacing_m, fix=fix)
    nx, ny, nz = (int(n) for n in cells)
    middle = (low + high) / 2
    half = cells * spacing_m / 2
    centers = VoxelGrid.over(np.stack([middle - half, middle + half]), (nx, ny, nz)).centers()
    free = np.flatnonzero(space.is_free(centers))
    free = free[~localization_map.occlusion.inside_geometry(centers[free])]
    if len(free) == 0:
        raise SceneError(
            "no location of the grid is free", value=spacing_m, fix="Narrow the grid, or correct --camera-z."
        )
    return Waypoints(centers[free], tuple(map(str, free)))


@dataclass(frozen=True)
class SelectionRequest:
    """Which views are selected at each waypoint.

    Args:
        n: number of best views of each waypoint.
        looks: instead of n, number of views that are chosen to be localized jointly, for a camera that turns there.
        pitch_deg: lowest and highest pitch in degrees, 90 straight up.
        pan_deg: lowest and highest yaw in degrees relative to the robot's heading at the waypoint, positive to its left.
        apart_deg: with n, least angle between the best views of a waypoint, in degrees.
        max_turn_deg: greatest rotation between a view and the next, in the order of the waypoints. The views are then
            the sequence with the greatest sum of scores within the limit, exactly.
        max_total_turn_deg: with looks, how far the camera turns in all from the first to the last.
        least_score: with max_turn_deg and looks: where the sequence's view scores less, the waypoint becomes a stop
            with the fewest further looks that reach this score jointly, `looks` in all at most.
        sigma_m: standard deviation in metres of the robot's x and y each: reports the views' expected scores.
        yaw_sigma_deg: the same of its yaw in degrees.
        skip: leave out waypoints outside the map or inside geometry.
    """

    n: int = 1
    looks: int | None = None
    pitch_deg: tuple[float, float] | None = None
    pan_deg: tuple[float, float] | None = None
    apart_deg: float | None = None
    max_turn_deg: float | None = None
    max_total_turn_deg: float | None = None
    least_score: float | None = None
    sigma_m: float | None = None
    yaw_sigma_deg: float | None = None
    skip: bool = False

    def __post_init__(self) -> None:
        check_pitch("pitch_deg", self.pitch_deg or (-90.0, 90.0))
        low, high = check_limits("pan_deg", self.pan_deg or (-180.0, 180.0))
        fix = "Give degrees, the lowest first, such as -60 60, or 150 210 for the back."
        if not (-360 <= low < high <= 360 and high - low <= 360):
            raise ConfigError("pan_deg is a lowest and a highest yaw", value=(low, high), fix=fix)
        joint = self.looks is not None
        in_order = self.max_turn_deg is not None
        stopping = self.least_score is not None
        for name, high in (
            ("max_turn_deg", inf),
            ("max_total_turn_deg", inf),
            ("sigma_m", 1e4),
            ("yaw_sigma_deg", 360),
        ):
            check_range(name, getattr(self, name) or 0, 0, high)  # draws beyond any map
        reject(
            (self.apart_deg is not None and self.n == 1, "apart_deg needs an n of at least 2", self.apart_deg),
            (not 0 <= (self.apart_deg or 0) <= 180, "apart_deg must be 0 to 180", self.apart_deg),
            (not isinstance(self.n, Integral) or self.n < 1, "n must be a whole number of at least 1", self.n),
            (joint and self.looks not in range(1, MAX_VIEWS + 1), f"looks must be 1 to {MAX_VIEWS}", self.looks),
            (stopping and not (joint and in_order), "least_score needs looks and max_turn_deg", self.least_score),
            (stopping and not 0 < (self.least_score or 0) <= 1, "least_score must be above 0, to 1", self.least_score),
            (joint and self.n > 1, "n and looks exclude each other", (self.n, self.looks)),
            (in_order and self.n > 1, "max_turn_deg is for one view of each waypoint: leave n out", self.n),
            (joint and in_order and not stopping, "looks with max_turn_deg need least_score", self.looks),
        )
        if self.max_total_turn_deg is not None and (stopping or not joint):
            problem = "max_total_turn_deg needs looks, and excludes least_score"
            raise ConfigError(problem, value=self.max_total_turn_deg)
