"""`wheretolook select` and `wheretolook score`: the best views at waypoints of your own map, and scores of your poses."""

from __future__ import annotations

import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from wheretolook.commands.options import CameraOptions, MaskOptions, ScorerOptions, select_options
from wheretolook.dataset.config import checked_accuracy
from wheretolook.figures import KINDS
from wheretolook.geometry.camera import Camera, PinholeCamera, describe_camera, parse_size
from wheretolook.geometry.pose_files import poses_of_rows, read_named_rows
from wheretolook.geometry.views import Views, check_format
from wheretolook.mapping.colmap_model import model_suffix
from wheretolook.mapping.config import FrameOptions
from wheretolook.select.waypoints import SelectionRequest, given_waypoints
from wheretolook.utils.devices import usable_device
from wheretolook.utils.errors import ConfigError, MapWarning, check_choice, reject

if TYPE_CHECKING:
    from wheretolook.select.where_to_look import WhereToLook


@dataclass(frozen=True, kw_only=True)
class OpenOptions(CameraOptions, ScorerOptions, FrameOptions):
    """A COLMAP model, and how its views are scored.

    Args:
        map: folder of a COLMAP model, binary or text.
        fov: instead of a camera, horizontal field of view of a pinhole in degrees.
        size: image size of that pinhole in pixels, such as 640x480.
        depth: folder of depth images, named like the map's images.
        depth_scale: units of integer depth images in a metre.
        database: COLMAP's database.db or hloc's feats-*.h5, whose descriptors show which landmarks look alike; by default
            hloc's near the model, or a database near it; of SIFT only for up to 30,000 points.
        max_error: leave out landmarks with a larger mean reprojection error, in pixels.
        device: where to compute: auto, cpu, cuda, or cuda:<index>.
    """

    map: Path
    fov: float | None = None
    size: str | None = None
    depth: Path | None = None
    depth_scale: float = 1000.0
    database: Path | None = None
    max_error: float | None = None
    device: str = "auto"

    def __post_init__(self) -> None:
        self.frame_options()
        if self.accuracy is not None:
            checked_accuracy(self.accuracy)
        self.named_camera()

    def named_camera(self) -> Camera | int | None:
        """Return the camera asked for: one, a camera_id of the map, or None for the map's own."""
        described = super().named_camera()
        if self.fov is None:
            if self.size is not None:
                raise ConfigError("an image size belongs to a field of view, --fov", value=self.size)
            return described
        if described is not None:
            raise ConfigError("the camera is described in several ways", value=self.fov, fix="Give one of them.")
        return PinholeCamera.of_field_of_view(self.fov, *parse_size(self.size or "640x480"))

    def open_map(self, path: Path | None = None, **options: Any) -> WhereToLook:
        """Open the map, or that of another path; `options` are further ones of `WhereToLook.from_colmap`."""
        from wheretolook.utils.warp import start_warp
        from wheretolook.visibility.counting import compile_kernels

        path = path or self.map
        model_suffix(path)
        device = usable_device(self.device)
        with ThreadPoolExecutor(1) as executor:  # kernels compile, if they must, during imports and reading
            compiled = executor.submit(compile_kernels, start_warp(device))
            from wheretolook.select.where_to_look import WhereToLook

            selector = WhereToLook.from_colmap(
                path,
                weights=self.weights,
                method=self.method,
                mesh=self.mesh,
                mesh_up=self.mesh_up,
                depth=self.depth,
                depth_scale=self.depth_scale,
                occlusion=self.occlusion,
                database=self.database,
                max_reprojection_error_px=self.max_error,
                device=device,
                anywhere=self.anywhere,
                **{"camera": self.named_camera(), **vars(self.frame_options()), **options},
            )
            compiled.result()
        return selector if self.accuracy is None else selector.at_accuracy(self.accuracy)


@dataclass(frozen=True, kw_only=True)
class SelectorOptions(OpenOptions):
    """A COLMAP model, and the views that are written.

    Args:
        out: file of the views; its ending decides the format.
        format: csv, json, tum, colmap, benchmark or rosbag.
        floor_plan: also draw the views on a plan of the landmarks: a file .png, .pdf or .svg.
        frame: whose orientations a trajectory or table holds: base (x forward, z up) or camera (z forward). By default
            that of a base if all its z axes are within 45 degrees of up.
    """

    out: Path
    format: str | None = None
    frame: Literal["base", "camera"] | None = None
    floor_plan: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.floor_plan is not None:
            check_choice("format of figures", self.floor_plan.suffix[1:].lower(), KINDS)


@dataclass(frozen=True, kw_only=True)
class RigOptions(SelectorOptions):
    """The cameras of a rig.

    Args:
        rig: score all cameras of a rig: a rig_id of the model, or a file as docs/rigs.md describes. Views are csv or json.
    """

    rig: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rig is not None:
            alone = (self.accuracy or self.named_camera()) is None
            reject((not alone, "a rig has its own cameras: leave cameras and --accuracy out", self.rig))
            check_choice("format of the views of a rig", check_format(self.out, self.format, 1), ("csv", "json"))

    def open_map(self, path: Path | None = None, **options: Any) -> WhereToLook:
        """Open the map as `OpenOptions`. Raises ConfigError for a rosbag if its unit is unknown."""
        selector = super().open_map(path, **options)
        if self.format == "rosbag":
            selector.frame.check_metric("a rosbag is")
        return selector


def finish(command: SelectorOptions, selector: WhereToLook, views: Views, given: int, locations: str) -> None:
    """Write views and the floor plan, and print a summary; `locations` names the kind of what was `given`."""
    views.save(command.out, command.format)
    if command.floor_plan is not None:
        from wheretolook.figures.floor_plan import save_figure

        save_figure(selector.floor_plan(views), command.floor_plan)
        print(f"floor plan: {command.floor_plan}")

    localization_map = selector.localization_map
    if views.read_as is not None:
        print(f"{locations} read as {views.read_as[0]}")
    camera = "that of each view" if views.camera is None else describe_camera(views.camera)
    print(f"{selector.frame.describe()}; camera: {camera}")
    n_used = len({*views.waypoint.tolist()})
    skipped = f", {given - n_used} left out" if n_used < given else ""
    features = localization_map.landmarks.features or "no descriptors"
    landmarks = f"{len(localization_map.landmarks):,} landmarks ({features})"
    print(f"{landmarks}, occlusion: {localization_map.occlusion.name}, method: {views.method}")
    if views.of_map is not None:
        print(views.of_map.describe())
    best = views.rank == 1
    kind, scores = ("best scores", views.score) if views.set_score is None else ("set scores", views.set_score)
    print(f"{locations}: {n_used}{skipped}; {kind} {scores[best].min():.3g} to {scores[best].max():.3g}")
    outside = "outside the training distribution (column in_range)"
    counts = {"no visible landmark": views.n_visible[best] == 0, outside: ~views.in_range[best]}
    for what, rows in counts.items():
        if rows.any():
            text = f"best views, {what}: {rows.sum()} of {len(rows)}"
            if rows is counts[outside] and views.out_of_range is not None:
                text += f", by {views.out_of_range[best][rows][0]}"
            print(text)


@dataclass(frozen=True, kw_only=True)
class Select(SelectionRequest, MaskOptions, RigOptions):
    """Select the best views at waypoints of your own COLMAP model; needs no dataset.

    Waypoints (--at); the format is recognized by the content:
      CSV          columns x, y, z, and id if there is one; with a line of names or without
      text         "id x y z", such as the waypoints of the Active Localization Benchmark; or "x y z"
      TUM          "t x y z qx qy qz qw"; the views keep the time stamps
      KITTI        matrices of 12 numbers, camera-to-world
      COLMAP       images.txt, images.bin or the folder of a model: the camera centres; hloc's results
      numbers      --at 1,2,1.5 -0.5,2,1.5

    Headings (for --pan): the column heading_deg or yaw_deg, or the orientation, of a TUM trajectory or in columns
    qw, qx, qy, qz: that of a camera (z forward), or of a robot (x forward, z up): --frame.

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
      rosbag       nav_msgs/Path /views for ROS 2, in metres, z up; --out is a new folder
    Rig (--rig): all its cameras are scored at poses of the rig (--at FILE, as --poses of `wheretolook score`), which has the
    axes of its reference camera. A row for each camera, rank 1 for the best; sensor: its name; any_score: probability that at
    least one localizes alone; set_score: that all do jointly.
    A view that is not in_range is outside the training distribution of the weights: its score is less reliable.

    Examples:
      wheretolook select --map sparse/0 --at waypoints.csv --out views.csv
      wheretolook select --map sparse/0 --at 1,2,1.5 -0.5,2,1.5 --n 3 --out views.json
      wheretolook select --map sparse/0 --at 1,2,1.5 --looks 3 --max-total-turn 180 --out looks.csv
      wheretolook select --map sparse/0 --at path.tum --max-turn 30 --pitch -30 30 --out views.tum
      wheretolook select --map sparse/0 --at path.tum --max-turn 30 --looks 3 --least-score 0.7 --out views.csv
      wheretolook select --map sparse/0 --at path.tum --pan -60 60 --n 3 --apart 20 --out views.csv
      wheretolook select --map sparse/0 --at waypoints.csv --sigma 0.5 --yaw-sigma 5 --out views.csv
      wheretolook select --map sparse/0 --at path.tum --rig rig.yaml --out cameras.csv
      wheretolook select --map sparse/0 --grid 0.5 --mesh house.glb --fov 60 --out views.csv
      wheretolook select --map sparse/0 --grid 0.25 --camera-z 1.2 --scale 1 --nav2 masks --out views.csv

    Args:
        at: waypoints: a file, or x,y,z, any number of them.
        grid: instead, waypoints this many metres apart in all free space.
        camera_z: leave out all of the grid but this z of the camera, in a world in metres with z up.
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
        SelectionRequest.__post_init__(self)
        RigOptions.__post_init__(self)
        check_format(self.out, self.format, max(self.n, self.looks or 1))
        if self.looks is not None and self.accuracy is not None:
            raise ConfigError("looks are for the accuracy of the weights: leave --accuracy out", value=self.accuracy)
        of_grid = self.nav2 is not None or self.camera_z is not None
        turn = self.looks or self.max_turn_deg
        reject(
            (bool(self.at) == (self.grid is not None), "waypoints are given by either --at or --grid", None),
            (bool(self.at and of_grid), "--nav2 and --camera-z need --grid", None),
            (bool(self.nav2) and turn is not None, "masks are of best views: leave --looks and --max-turn out", turn),
        )

    def run(self) -> Views:
        """Select the views, write them to `out` and print a summary."""
        from wheretolook.planning.nav2 import check_mask, write_mask

        if self.rig is not None:
            limited = len(self.at) != 1 or self != replace(self, **vars(SelectionRequest()))
            problem = "a rig is scored at its own poses: give --at FILE, without --grid and limits of views"
            reject((limited, problem, self.at))
            return select_options(Score, self, poses=Path(self.at[0])).run()
        start = time.monotonic()
        waypoints = given_waypoints(self.at, self.frame) if self.at else None
        selector = self.open_map(directions=self.directions, lattice=self.lattice)
        if self.nav2:
            check_mask(self.nav2, selector.scorer, self.camera_z)
        if waypoints is None:
            assert self.grid is not None
            waypoints = selector.grid(self.grid, self.camera_z)
        views = selector.select(waypoints, self, progress=True)
        if self.nav2 and self.grid:
            best = views[views.rank == 1]
            write_mask(self.nav2, views.frame.world_from_map.apply(best.positions), best.score, self.grid)
        finish(self, selector, views, len(waypoints), "waypoints")
        print(f"views: {len(views)} in {time.monotonic() - start:.1f} s: {self.out}")
        return views


@dataclass(frozen=True, kw_only=True)
class Score(RigOptions):
    """Score poses of your own in a COLMAP model; needs no dataset.

    Poses (--poses), in the frame of the map; camera x right, y down, z forward, or a robot's base (--frame), whose camera
    looks along x. The format is recognized by the content:
      CSV          x, y, z, qw, qx, qy, qz or TUM's tx, ty, tz, qx, qy, qz, qw: camera-to-world; COLMAP's
                   qw, qx, qy, qz, tx, ty, tz: world-to-camera; and a name: id, waypoint, name, t or timestamp
      JSON         as select writes it
      TUM          "t x y z qx qy qz qw", camera-to-world; KITTI's matrices of 12 numbers
      COLMAP       images.txt, images.bin or the folder of a model, world-to-camera
      hloc         results "name qw qx qy qz tx ty tz", world-to-camera

    The file of results has the columns and formats of `wheretolook select`, a row for each pose. In a map of several
    cameras, a pose with the name of an image of the map is scored for the camera of that image.

    Examples:
      wheretolook score --map sparse/0 --poses trajectory.tum --out scores.csv
      wheretolook score --map sparse/0 --poses sparse/0/images.txt --mesh house.glb --out scores.csv

    Args:
        poses: file of the poses, or folder of a model.
        skip: leave out poses outside the map or inside geometry.
    """

    poses: Path
    skip: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check_format(self.out, self.format, 1)
        reject((self.rig is not None and self.skip, "a rig is scored at all poses: leave --skip out", self.rig))

    def run(self) -> Views:
        """Score the poses, write them to `out` and print a summary."""
        table = read_named_rows(self.poses)
        poses_of_rows(table)  # an error about the file comes before the map is read
        named = self.named_camera()
        selector = self.open_map(camera="each" if named is None else named)
        if selector.camera_of and check_format(self.out, self.format, 1) == "colmap" and not self.out.suffix:
            fix = "Write csv or json, or give one camera: --camera-id or --camera."
            raise ConfigError("a model of views has one camera, and the map has several", path=self.out, fix=fix)
        poses = Views.of_rows(table, selector.frame.world_from_map.rotation[2], self.frame)
        read_as = poses.read_as[0]
        if self.frame is None and read_as != table.format:
            text = f"read as {read_as}, with a camera that looks ahead; if these are a camera's, give --frame camera"
            warnings.warn(f"{self.poses}: {text}", MapWarning, stacklevel=2)
        if self.rig is not None:
            views = selector.report_rig(self.rig, poses.cam_from_world, poses.waypoint_id)
        else:
            views = selector.report(poses.cam_from_world, poses.waypoint_id, self.skip)
        views = replace(views, read_as=(read_as,) * len(views))
        finish(self, selector, views, len(poses), "poses")
        print(f"scores: {self.out}")
        return views
