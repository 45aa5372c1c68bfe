"""`wheretolook select`: the best views at waypoints of your own map."""

from __future__ import annotations

import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from wheretolook.commands.selector_options import SelectorOptions, finish
from wheretolook.select.waypoints import SelectionRequest
from wheretolook.utils.errors import ConfigError

if TYPE_CHECKING:
    from wheretolook.select.views import SelectedViews
    from wheretolook.select.waypoints import Waypoints


@dataclass(frozen=True, kw_only=True)
class Select(SelectionRequest, SelectorOptions):
    """Select the best views at waypoints of your own COLMAP model; needs no dataset.

    Waypoints (--at):
      CSV          columns x, y, z, and id if there is one; with a line of names or without (then x,y,z alone)
      benchmark    "id x y z", the waypoints of the Active Localization Benchmark; or "x y z"
      TUM          "t x y z qx qy qz qw"; the views keep the time stamps
      COLMAP       images.txt, world-to-camera: the camera centres
      numbers      --at 1,2,1.5 -0.5,2,1.5

    Headings (for --pan): the column heading_deg or yaw_deg, or the orientation, of a TUM trajectory or in columns
    qw, qx, qy, qz: that of a camera (z forward), or of a robot (x forward, z up).

    Frames: the world of waypoints and views is the map's own frame, in its unit. Camera: x right, y down, z forward; it
    does not roll. yaw_deg is 0 along the map's x and 90 along y, of an upright map; pitch_deg is 90 straight up.
    Scores need metres: a map of this project states its scale, as do --scale, --distance, --positions and depth
    images. A map of unknown scale (column scale) is scored as if the median depth of its images were 5 m. A map whose
    cameras are clearly not level is turned upright for scoring, unless --up states what is up.
    By format (--format, or the ending of --out):
      csv, json    x, y, z: camera centre in the world; qw, qx, qy, qz: camera-to-world (quaternion_xyzw: x first)
      tum          t x y z qx qy qz qw, camera-to-world
      colmap       images.txt, world-to-camera; if --out is a folder, cameras.txt and an empty points3D.txt too
      benchmark    "# id qw qx qy qz tx ty tz", world-to-camera
    A view that is not in_range is outside the training distribution of the weights: its score is less reliable.

    Examples:
      wheretolook select --map sparse/0 --at waypoints.csv --out views.csv
      wheretolook select --map sparse/0 --at 1,2,1.5 -0.5,2,1.5 --n 3 --out views.json
      wheretolook select --map sparse/0 --at 1,2,1.5 --looks 3 --max-total-turn 180 --out looks.csv
      wheretolook select --map sparse/0 --at path.tum --max-turn 30 --pitch -30 30 --out views.tum
      wheretolook select --map sparse/0 --at path.tum --max-turn 30 --looks 3 --least-score 0.7 --out views.csv
      wheretolook select --map sparse/0 --at path.tum --pan -60 60 --n 3 --apart 20 --out views.csv
      wheretolook select --map sparse/0 --at waypoints.csv --sigma 0.5 --yaw-sigma 5 --out views.csv
      wheretolook select --map sparse/0 --grid 0.5 --mesh house.glb --fov 60 --out views.csv

    Args:
        at: waypoints: a file, or x,y,z, any number of them.
        grid: instead, waypoints this many metres apart in all free space.
        directions: number of directions scored at each waypoint.
        lattice: fibonacci (even), or yaw-pitch (ActLoc's 6 x 18).
    """

    SHORT: ClassVar = {
        "pitch": "pitch_deg",
        "pan": "pan_deg",
        "apart": "apart_deg",
        "max-turn": "max_turn_deg",
        "sigma": "sigma_m",
        "yaw-sigma": "yaw_sigma_deg",
        "max-total-turn": "max_total_turn_deg",
    }

    at: tuple[str, ...] = ()
    grid: float | None = None
    directions: int = 500
    lattice: Literal["fibonacci", "yaw-pitch"] = "fibonacci"

    def __post_init__(self) -> None:
        from wheretolook.select.views import check_format

        SelectionRequest.__post_init__(self)
        SelectorOptions.__post_init__(self)
        check_format(self.out, self.format, max(self.n, self.looks or 1))
        if self.looks is not None and self.accuracy is not None:
            raise ConfigError("looks are for the accuracy of the weights: leave --accuracy out", value=self.accuracy)
        if bool(self.at) == (self.grid is not None):
            raise ConfigError("waypoints are given by either --at or --grid")

    def run(self) -> SelectedViews:
        """Select the views, write them to `out` and print a summary."""
        start = time.monotonic()
        waypoints = self._waypoints()
        selector = self.open_map(directions=self.directions, lattice=self.lattice)
        if waypoints is None:
            assert self.grid is not None
            waypoints = selector.grid(self.grid)
        request = {field.name: getattr(self, field.name) for field in fields(SelectionRequest)}
        views = selector.best(waypoints, progress=True, **request)
        finish(self, selector, views, len(waypoints), "waypoints")
        print(f"views: {len(views)} in {time.monotonic() - start:.1f} s: {self.out}")
        return views

    def _waypoints(self) -> Waypoints | None:
        """Return the waypoints, None for a grid."""
        from wheretolook.select.waypoints import parse_points, read_waypoints

        if len(self.at) == 1 and (Path(self.at[0].strip()).exists() or self.at[0].count(",") != 2):
            return read_waypoints(self.at[0].strip())
        return parse_points(self.at) if self.at else None
