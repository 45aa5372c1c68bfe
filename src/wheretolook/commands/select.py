"""`wheretolook select`: the best views at waypoints of your own map."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from wheretolook.commands.options import CameraOptions, OcclusionOptions, ScorerOptions
from wheretolook.select.request import SelectionRequest
from wheretolook.utils.errors import ConfigError

if TYPE_CHECKING:
    from wheretolook.geometry.camera import Camera
    from wheretolook.select.views import SelectedViews
    from wheretolook.select.waypoints import Waypoints
    from wheretolook.select.where_to_look import WhereToLook


@dataclass(frozen=True, kw_only=True)
class Select(SelectionRequest, CameraOptions, OcclusionOptions, ScorerOptions):
    """Select the best views at waypoints of your own COLMAP model; needs no dataset.

    Waypoints (--at):
      CSV          columns x, y, z, and id if there is one; with a line of names or without (then x,y,z alone)
      benchmark    "id x y z", the waypoints of the Active Localization Benchmark; or "x y z"
      TUM          "t x y z qx qy qz qw"; orientations are not used, the views keep the time stamps
      numbers      --at 1,2,1.5 -0.5,2,1.5

    Frames: the world is the map's, metres, z up. Camera: x right, y down, z forward; it does not roll. yaw_deg is 0
    along the world's x and 90 along y; pitch_deg is 90 straight up. By format (--format, or the ending of --out):
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
      wheretolook select --map sparse/0 --grid 0.5 --mesh house.glb --fov 60 --out views.csv

    Args:
        map: folder of a COLMAP model, binary or text, in metres with z up.
        at: waypoints: a file, or x,y,z in metres, any number of them.
        grid: instead, waypoints this many metres apart in all free space.
        out: file of the views; its ending decides the format.
        format: csv, json, tum, colmap or benchmark.
        fov: instead of a camera, horizontal field of view of a pinhole in degrees.
        size: image size of that pinhole in pixels, such as 640x480.
        depth: folder of depth images, named like the map's images.
        depth_scale: units of integer depth images in a metre.
        database: the map's database, whose descriptors show which landmarks look alike.
        directions: number of directions scored at each waypoint.
        lattice: fibonacci (even), or yaw-pitch (ActLoc's 6 x 18).
        max_error: leave out landmarks with a larger mean reprojection error, in pixels.
        device: where to compute: auto, cpu, cuda, or cuda:<index>.
    """

    SHORT: ClassVar = {"pitch": "pitch_deg", "max-turn": "max_turn_deg", "max-total-turn": "max_total_turn_deg"}

    map: Path
    out: Path
    at: tuple[str, ...] = ()
    grid: float | None = None
    format: str | None = None
    fov: float | None = None
    size: str | None = None
    depth: Path | None = None
    depth_scale: float = 1000.0
    database: Path | None = None
    directions: int = 500
    lattice: Literal["fibonacci", "yaw-pitch"] = "fibonacci"
    max_error: float | None = None
    device: str = "auto"

    def __post_init__(self) -> None:
        from wheretolook.select.formats import check_format

        super().__post_init__()
        check_format(self.out, self.format, max(self.n, self.looks or 1))
        if bool(self.at) == (self.grid is not None):
            raise ConfigError("waypoints are given by either --at or --grid")
        self.named_camera()

    def named_camera(self) -> Camera | int | None:
        """Return the camera asked for: one, a camera_id of the map, or None for the map's own."""
        from wheretolook.geometry.camera import PinholeCamera, parse_size

        described = super().named_camera()
        if self.fov is None:
            if self.size is not None:
                raise ConfigError("an image size belongs to a field of view, --fov", value=self.size)
            return described
        if described is not None:
            raise ConfigError("the camera is described in several ways", value=self.fov, fix="Give one of them.")
        return PinholeCamera.of_field_of_view(self.fov, *parse_size(self.size or "640x480"))

    def run(self) -> SelectedViews:
        """Select the views, write them to `out` and print a summary."""
        from wheretolook.mapping.colmap_model import model_suffix
        from wheretolook.utils.devices import usable_device
        from wheretolook.utils.warp import start_warp
        from wheretolook.visibility.listing import compile_kernels

        start = time.monotonic()
        waypoints = self._waypoints()
        model_suffix(self.map)
        device = usable_device(self.device)
        with ThreadPoolExecutor(1) as executor:  # kernels compile, if they must, during imports and reading
            compiled = executor.submit(compile_kernels, start_warp(device))
            from wheretolook.select.where_to_look import WhereToLook

            selector = WhereToLook.from_colmap(
                self.map,
                weights=self.weights,
                method=self.method,
                camera=self.named_camera(),
                mesh=self.mesh,
                depth=self.depth,
                depth_scale=self.depth_scale,
                occlusion=self.occlusion,
                database=self.database,
                directions=self.directions,
                lattice=self.lattice,
                max_reprojection_error_px=self.max_error,
                device=device,
                anywhere=self.anywhere,
            )
            compiled.result()
        if waypoints is None:
            assert self.grid is not None
            waypoints = selector.grid(self.grid)
        request = {field.name: getattr(self, field.name) for field in fields(SelectionRequest)}
        views = selector.best(waypoints, progress=True, **request)
        views.save(self.out, self.format)
        _print_summary(selector, views, len(waypoints))
        print(f"{len(views)} views in {time.monotonic() - start:.1f} s: {self.out}")
        return views

    def _waypoints(self) -> Waypoints | None:
        """Return the waypoints, None for a grid."""
        from wheretolook.select.waypoints import parse_points, read_waypoints

        if len(self.at) == 1 and (Path(self.at[0].strip()).exists() or self.at[0].count(",") != 2):
            return read_waypoints(self.at[0].strip())
        return parse_points(self.at) if self.at else None


def _print_summary(selector: WhereToLook, views: SelectedViews, n_waypoints: int) -> None:
    localization_map = selector.localization_map
    n_used = len({*views.waypoint.tolist()})
    skipped = f", {n_waypoints - n_used} left out" if n_used < n_waypoints else ""
    landmarks = f"{len(localization_map.landmarks):,} landmarks"
    print(f"{landmarks}, occlusion: {localization_map.occlusion.name}, method: {views.method}")
    best = views.rank == 1
    scores = views.score[best]
    print(f"{n_used} waypoints{skipped}; best scores {scores.min():.3g} to {scores.max():.3g}")
    counts = {
        "best views see no landmark": views.n_visible[best] == 0,
        "best views are outside the training distribution (column in_range)": ~views.in_range[best],
    }
    for what, rows in counts.items():
        if rows.any():
            print(f"{rows.sum()} of the {what}")
