"""`wheretolook select`: the best views at places of one's own map. It needs no dataset and no configuration."""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.utils.errors import ConfigError
from wheretolook.utils.options import CommandParser

if TYPE_CHECKING:
    from wheretolook.select.views import SelectedViews
    from wheretolook.select.waypoints import Waypoints
    from wheretolook.select.where_to_look import WhereToLook

ABOUT = "The best views at places of your own map, by the weights that ship unless told otherwise."

USAGE = "wheretolook select --map SPARSE (--at FILE | --at X,Y,Z ... | --grid SPACING) --out FILE [options]"

_NOTES = """\
MAP
  Any COLMAP model, binary or text, in metres with z up: the folder with cameras, images and points3D.

WAYPOINTS (--at)
  CSV          columns x, y, z, and id if there is one; with a line of names or without (then x,y,z alone)
  benchmark    "id x y z", the waypoints of the Active Localization Benchmark; or "x y z"
  TUM          "t x y z qx qy qz qw"; orientations are not used, the views keep the time stamps
  numbers      --at 1,2,1.5 -0.5,2,1.5

FRAMES
  World: that of the map, metres, z up. Camera: x right, y down, z forward; it does not roll. yaw_deg is 0 along the
  world's x and 90 along y; pitch_deg is 90 straight up. By format (--format, or the ending of --out):
  csv, json    x, y, z: camera centre in the world; qw, qx, qy, qz: camera-to-world (quaternion_xyzw: the same, x first)
  tum          t x y z qx qy qz qw, camera-to-world
  colmap       images.txt, world-to-camera; if --out is a folder, cameras.txt and an empty points3D.txt too
  benchmark    "# id qw qx qy qz tx ty tz", world-to-camera
  A view that is not in_range is unlike those the weights have learnt from: its score is less sure.

EXAMPLES
  wheretolook select --map sparse/0 --at waypoints.csv --out views.csv
  wheretolook select --map sparse/0 --at 1,2,1.5 -0.5,2,1.5 --n 3 --out views.json
  wheretolook select --map sparse/0 --at 1,2,1.5 --looks 3 --max-total-turn 180 --out looks.csv
  wheretolook select --map sparse/0 --at path.tum --max-turn 30 --pitch -30 30 --out views.tum
  wheretolook select --map sparse/0 --at path.tum --max-turn 30 --looks 3 --least-score 0.7 --out views.csv
  wheretolook select --map sparse/0 --grid 0.5 --mesh house.glb --camera PINHOLE,640,480,320,320,320,240 --out views.csv
  wheretolook select --map sparse/0 --at waypoints.txt --fov 60 --format benchmark --out selected_poses.txt

In Python:
  from wheretolook import WhereToLook
  views = WhereToLook.from_colmap("sparse/0").best([(1.0, 2.0, 1.5)])    # views.cam_from_world, views.score
  views.save("views.csv")"""


def parser() -> argparse.ArgumentParser:
    """The options of the command."""
    made = CommandParser(prog="wheretolook select", usage=USAGE, description=ABOUT, epilog=_NOTES)
    add = made.add_argument
    add("--map", required=True, type=Path, metavar="SPARSE", help="folder of a COLMAP model")
    add("--at", nargs="+", metavar="FILE", help="waypoints: a file, or x,y,z in metres, several with blanks between")
    add("--grid", type=float, metavar="M", help="instead: places so many metres apart in all free space")
    add("--out", required=True, type=Path, metavar="FILE", help="file of the views; its ending tells the format")
    add("--format", metavar="NAME", help="csv, json, tum, colmap or benchmark; without it the ending of --out tells")
    add("--n", type=int, default=1, metavar="N", help="views of each waypoint, the best first (1)")
    add("--looks", type=int, metavar="N", help="instead: N looks of each waypoint, chosen to be localized together")
    add("--max-total-turn", type=float, metavar="DEG", help="how far the camera turns in all from look to look")
    add("--least-score", type=float, metavar="P", help="with --max-turn and --looks: at waypoints whose view of the")
    made._actions[-1].help += " sequence scores less, so many looks as are needed to reach it, N at most"  # type: ignore[operator]
    add("--pitch", nargs=2, type=float, metavar=("LOW", "HIGH"), help="limit on pitch in degrees, 90 straight up")
    add("--max-turn", type=float, metavar="DEG", help="greatest rotation between a view and the next, in the order of")
    made._actions[-1].help += " the waypoints: the sequence with the greatest sum of scores, exactly"  # type: ignore[operator]
    add("--skip", action="store_true", help="leave out waypoints outside the map or inside geometry")
    camera = made.add_argument_group("the camera that will look; the map's own if it has one")
    add = camera.add_argument
    add("--camera", metavar="TEXT", help="COLMAP's MODEL,width,height,parameters: PINHOLE,640,480,320,320,320,240")
    add("--fov", type=float, metavar="DEG", help="instead: horizontal field of view of a pinhole")
    add("--size", metavar="WxH", help="its image size in pixels (640x480)")
    add("--camera-id", type=int, metavar="ID", help="instead: the camera_id of one of the map's cameras")
    hides = made.add_argument_group("what hides landmarks; by default the first of these that there is something for")
    add = hides.add_argument
    add("--mesh", type=Path, metavar="FILE", help="a mesh of the scene (GLB, OBJ, PLY) in the map's frame")
    add("--depth", type=Path, metavar="FOLDER", help="depth images, named as the map's images")
    add("--depth-scale", type=float, default=1000.0, metavar="N", help="their units in a metre, if integers (1000)")
    add(
        "--occlusion",
        metavar="NAME",
        help="mesh, tsdf (depth images), hidden-points (from the landmarks alone) or none",
    )
    score = made.add_argument_group("how views are scored")
    add = score.add_argument
    add("--weights", type=Path, metavar="FILE", help="weights, or a folder of them (those that ship)")
    add("--method", default="", metavar="NAME", help="`wheretolook evaluate --list-methods` (that of the weights)")
    add("--anywhere", action="store_true", help="let weights that are adapted to another place score here, too")
    add("--database", type=Path, metavar="FILE", help="the map's database: descriptors tell which landmarks look alike")
    add("--directions", type=int, default=500, metavar="N", help="directions looked along at each waypoint (500)")
    add("--lattice", default="fibonacci", metavar="NAME", help="fibonacci (even), or yaw-pitch (ActLoc's 6 x 18)")
    add("--max-error", type=float, metavar="PX", help="leave out landmarks with a larger mean reprojection error")
    add("--device", default="auto", metavar="NAME", help="auto, cpu, cuda, cuda:1 (auto)")
    return made


def run(arguments: Sequence[str]) -> int:
    """Run the command. Returns the exit code 0; raises a WhereToLookError for bad input."""
    # coordinates below zero look like options to argparse, but not with a blank before them
    given = [f" {text}" if re.match(r"-[\d.]", text) else text for text in arguments]
    options = parser().parse_args(given)
    start = time.monotonic()
    waypoints = _check(options)
    from wheretolook.utils.devices import usable_device
    from wheretolook.utils.warp import start_warp
    from wheretolook.visibility.listing import compile_kernels

    device = usable_device(options.device)
    # the first time on a machine kernels are compiled, for as long as PyTorch is imported and the map is read
    with ThreadPoolExecutor(1) as beside:
        compiled = beside.submit(compile_kernels, start_warp(device))
        from wheretolook.select.where_to_look import WhereToLook

        look = WhereToLook.from_colmap(
            options.map,
            weights=options.weights,
            method=options.method,
            camera=_camera(options),
            mesh=options.mesh,
            depth=options.depth,
            depth_scale=options.depth_scale,
            occlusion=options.occlusion,
            database=options.database,
            directions=options.directions,
            lattice=options.lattice,
            max_reprojection_error_px=options.max_error,
            device=device,
            anywhere=options.anywhere,
        )
        compiled.result()
    if waypoints is None:
        waypoints = look.grid(options.grid)
    pitch = None if options.pitch is None else tuple(options.pitch)
    views = look.best(
        waypoints,
        options.n,
        pitch_deg=pitch,
        max_turn_deg=options.max_turn,
        skip=options.skip,
        progress=True,
        looks=options.looks,
        max_total_turn_deg=options.max_total_turn,
        least_score=options.least_score,
    )
    views.save(options.out, options.format)
    _tell(look, views, waypoints, options.out, time.monotonic() - start, options.least_score is not None)
    return 0


def _check(options: argparse.Namespace) -> Waypoints | None:
    """The waypoints, None for a grid; whatever can be refused before the map is read is refused here."""
    from wheretolook.mapping.colmap_model import model_suffix
    from wheretolook.select.formats import check_format
    from wheretolook.select.limits import check_limits
    from wheretolook.select.waypoints import parse_points, read_waypoints
    from wheretolook.select.weights import check_there

    check_format(options.out, options.format, max(options.n, options.looks or 1))
    check_limits(options.n, options.pitch, options.max_turn, options.looks, options.max_total_turn, options.least_score)
    if (options.at is None) == (options.grid is None):
        raise ConfigError("waypoints are given by --at or by --grid", fix="Give one of them.")
    _camera(options)
    check_there(options.weights)
    model_suffix(options.map)
    if options.at is None:
        return None
    texts = [text.strip() for text in options.at]
    if len(texts) == 1 and (Path(texts[0]).exists() or texts[0].count(",") != 2):
        return read_waypoints(texts[0])
    return parse_points(texts)


def _camera(options: argparse.Namespace):  # type: ignore[no-untyped-def]
    """The camera asked for: one, a camera_id of the map, or None for the map's own."""
    from wheretolook.geometry.camera_text import camera_of_view, parse_camera, parse_size

    ways = {"--camera": options.camera, "--fov": options.fov, "--camera-id": options.camera_id}
    named = [name for name, value in ways.items() if value is not None]
    if len(named) > 1:
        raise ConfigError("a camera is described in several ways", value=" ".join(named), fix="Give one of them.")
    if options.size is not None and options.fov is None:
        raise ConfigError("an image size belongs to a field of view", value=options.size, fix="Give --fov too.")
    if options.camera is not None:
        return parse_camera(options.camera)
    if options.fov is not None:
        return camera_of_view(options.fov, parse_size(options.size or "640x480"))
    return options.camera_id


def _tell(
    look: WhereToLook, views: SelectedViews, waypoints: Waypoints, out: Path, seconds: float, stopping: bool
) -> None:
    around = look.localization_map
    n_seen = len({*views.waypoint.tolist()})
    skipped = f", {len(waypoints) - n_seen} left out" if n_seen < len(waypoints) else ""
    print(f"{len(around.landmarks):,} landmarks, occlusion: {around.occlusion.name}, method: {views.method}")
    scores = views.score[views.rank == 1]
    print(f"{n_seen} waypoints{skipped}; best scores {scores.min():.3g} to {scores.max():.3g}")
    if stopping and (more := int((views.rank > 1).sum())):
        stops = len({*views.waypoint[views.rank > 1].tolist()})
        print(f"{stops} waypoints are stops, with {more} further looks")
    if blind := int((views.n_visible[views.rank == 1] == 0).sum()):
        print(f"{blind} of the best views see no landmark")
    if strange := int((~views.in_range[views.rank == 1]).sum()):
        print(f"{strange} of the best views are unlike those the weights have learnt from (column in_range)")
    print(f"{len(views)} views in {seconds:.1f} s: {out}")
