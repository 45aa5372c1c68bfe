"""`wheretolook view`: a scene or a map in the browser, with the score of every view."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.dataset.names import check_scene_name
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.options import CommandParser

if TYPE_CHECKING:
    from wheretolook.geometry.camera import Camera
    from wheretolook.view.opened import Opened

ABOUT = "A page in the browser: where a camera sees enough, what it sees there, and why a view is good."

USAGE = "wheretolook view (--scene NAME | --map SPARSE [--mesh FILE]) [--path FILE] [options]"

_NOTES = """\
WHAT IT SHOWS
  Mesh or landmarks, mapping cameras, and free space at one height, coloured by the best score at each place. Click a
  place: the score of every direction, the best views, the landmarks in view by their chance of being found, and what
  the camera sees. Turn the camera by hand, and its score follows.

PATHS (--path)
  The folder or path.csv that `wheretolook plan` wrote; a scene's folder in results/paths of `wheretolook
  compare-paths`, of which --pair names the start and goal; a TUM trajectory; or a CSV of `wheretolook select`. A path
  alone stands beside the same places seen by a camera that looks ahead.

WHO CAN SEE IT
  This machine alone, and no page of another site that is open in its browser, unless --host says otherwise:
  --host 0.0.0.0 for all who reach it. There is no password, and nothing is served but the scene.

EXAMPLES
  wheretolook view --scene apartment-000
  wheretolook view --map sparse/0 --mesh house.glb
  wheretolook view --map sparse/0 --images photographs --port 8081
  wheretolook view --scene apartment-000 --path data/demo/apartment-000/path
  wheretolook view --scene apartment-000 --record apartment.rrd    # for the Rerun viewer, nothing is served"""


def parser() -> argparse.ArgumentParser:
    """The options of the command."""
    made = CommandParser(prog="wheretolook view", usage=USAGE, description=ABOUT, epilog=_NOTES)
    add = made.add_argument
    add("--scene", metavar="NAME", help="a scene of a dataset, as `wheretolook map` leaves it")
    add("--data", type=Path, default=Path("data"), metavar="FOLDER", help="folder of the datasets (data)")
    add("--name", default="", metavar="NAME", help="dataset of --scene, if several have such a scene")
    add("--map", type=Path, metavar="SPARSE", help="instead: folder of a COLMAP model, in metres with z up")
    add("--mesh", type=Path, metavar="FILE", help="a mesh of the map's place (GLB, OBJ, PLY) in its frame")
    add("--images", type=Path, metavar="FOLDER", help="its photographs, shown beside views")
    add("--path", type=Path, metavar="FILE", help="a path to play")
    add("--pair", type=int, default=0, metavar="N", help="which start and goal of compared paths (0)")
    add("--weights", type=Path, metavar="FILE", help="weights, or a folder (the place's own, or those that ship)")
    add("--method", default="", metavar="NAME", help="method that scores at first (that of the weights)")
    add("--camera", metavar="TEXT", help="the camera that looks, COLMAP's MODEL,width,height,parameters (the map's)")
    add("--camera-id", type=int, metavar="ID", help="instead: the camera_id of one of the map's cameras")
    page = made.add_argument_group("the page")
    add = page.add_argument
    add("--host", default="127.0.0.1", metavar="NAME", help="address to serve at (127.0.0.1: this machine alone)")
    add("--port", type=int, default=8080, metavar="N", help="port to serve at (8080)")
    add("--state", default="", metavar="TEXT", help="what to show at first, from the page's field `state`")
    add("--dark", action="store_true", help="dark at first")
    add("--record", type=Path, metavar="FILE", help="instead of a page: a Rerun recording, FILE.rrd")
    add(
        "--film", type=Path, metavar="FILE", help="instead of a page: the path, method beside method, FILE.webp or .gif"
    )
    add("--device", default="auto", metavar="NAME", help="auto, cpu, cuda, cuda:1 (auto)")
    return made


def run(arguments: Sequence[str]) -> int:
    """Run the command. Returns the exit code 0; raises a WhereToLookError for bad input."""
    options = parser().parse_args(arguments)
    start = time.monotonic()
    _refuse(options)
    from dataclasses import replace

    from wheretolook.view.state import ViewState

    state = ViewState.parse(options.state)
    if options.method:
        state = replace(state, method=options.method)
    from wheretolook.view.paths import read_paths
    from wheretolook.view.shared import Shared

    paths = None if options.path is None else read_paths(options.path, options.pair)
    opened = _open(options)
    if state.method and state.method not in opened.methods:
        fix = f"There are {', '.join(opened.methods)}."
        raise ConfigError("there is no such method here, or no weights of it", value=state.method, fix=fix)
    told = f"{opened.name}: {len(opened.landmarks):,} landmarks"
    if options.record is not None:
        from wheretolook.view.recording import record

        record(Shared(opened, paths), options.record, state)
        print(f"{told}, in {time.monotonic() - start:.0f} s: {options.record}")
        return 0
    if options.film is not None:
        from wheretolook_paper.commands.film import film

        n_frames = film(Shared(opened, paths), options.film, state)
        print(f"{told}, {n_frames} pictures in {time.monotonic() - start:.0f} s: {options.film}")
        return 0
    from wheretolook.view.server import Viewer

    viewer = Viewer(Shared(opened, paths), options.host, options.port, state, options.dark)
    print(opened.weights.told(state.method or opened.methods[0]) or "a method without weights", flush=True)
    print(f"{told}, open after {time.monotonic() - start:.1f} s", flush=True)
    print(f"{viewer.url}    (Ctrl-C ends it)", flush=True)
    try:
        viewer.wait()
    except KeyboardInterrupt:
        print("ended")
    finally:
        viewer.stop()
    return 0


def _refuse(options: argparse.Namespace) -> None:
    """Whatever can be refused before anything is read."""
    from wheretolook.view.checks import check_port, require

    if (options.map is None) == (options.scene is None):
        raise ConfigError("what is looked at is given by --scene or by --map", fix="Give one of them.")
    if options.scene is not None and (options.mesh is not None or options.images is not None):
        fix = "Leave them out: a scene has its own."
        raise ConfigError("--mesh and --images belong to --map", value=str(options.mesh or options.images), fix=fix)
    if options.camera is not None and options.camera_id is not None:
        raise ConfigError("a camera is described in two ways", value=options.camera, fix="Give one of them.")
    if options.images is not None and not options.images.is_dir():
        raise ConfigError("there is no such folder of photographs", path=options.images, fix="Correct the path.")
    if options.record is not None and options.film is not None:
        raise ConfigError("a recording and a film are made one at a time", value=str(options.film), fix="Give one.")
    if options.scene is not None and options.data.is_dir():
        check_scene_name(options.data, options.scene, options.name)
    if options.record is not None:
        require("rerun")
        if options.record.suffix != ".rrd":
            raise ConfigError("a Rerun recording is a .rrd", path=options.record, fix="Name it so.")
    elif options.film is not None:
        if options.film.suffix not in (".webp", ".gif"):
            raise ConfigError("this film is a .webp or a .gif", path=options.film, fix="Name it so.")
        if options.path is None or (options.map is not None and options.mesh is None):
            raise ConfigError("a film needs a path, and a mesh to render", path=options.film, fix="Give --path.")
    else:
        require("viser")
        check_port(options.host, options.port)


def _open(options: argparse.Namespace) -> Opened:
    from wheretolook.utils.devices import usable_device
    from wheretolook.view.opened import find_opened, open_map

    device = usable_device(options.device)
    camera = _camera(options)
    if options.map is not None:
        given = options.map, options.mesh, camera, options.images, options.weights, device
        return open_map(*given, options.data)
    if isinstance(camera, int):
        fix = "Describe it by --camera."
        raise ConfigError("--camera-id belongs to --map", value=camera, fix=fix)
    return find_opened(options.data, options.scene, options.name, camera, options.weights, device)


def _camera(options: argparse.Namespace) -> Camera | int | None:
    from wheretolook.geometry.camera_text import parse_camera

    return options.camera_id if options.camera is None else parse_camera(options.camera)
