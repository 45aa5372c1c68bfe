"""`wheretolook view`: a scene or map in the browser, with the score of every view."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.dataset.names import check_scene_name
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.options import CommandParser

if TYPE_CHECKING:
    from wheretolook.view.viewed_map import ViewedMap

ABOUT = "A page in the browser: where a camera localizes, what it sees there, and why a view is good."

USAGE = "wheretolook view (--scene NAME | --map SPARSE [--mesh FILE]) [--path FILE] [options]"

_NOTES = """\
WHAT IT SHOWS
  Mesh or landmarks, mapping cameras, and free space at one height, coloured by the best score at each location. Click
  a location: the score of every direction, the best views, the visible landmarks by detection probability, and the
  camera's image. Turn the camera by hand, and its score follows.

PATHS (--path)
  The folder or path.csv that `wheretolook plan` wrote; a scene's folder in results/paths of `wheretolook
  compare-paths`, of which --pair selects start and goal; a TUM trajectory; or a CSV of `wheretolook select`. A single
  path is shown next to the same locations seen by a camera that looks ahead.

WHO CAN SEE IT
  Only this machine, and no page of another site that is open in its browser, unless --host allows others:
  --host 0.0.0.0 for everyone who can reach it. There is no password, and only the scene is served.

EXAMPLES
  wheretolook view --scene apartment-000
  wheretolook view --map sparse/0 --mesh house.glb
  wheretolook view --map sparse/0 --images photographs --port 8081
  wheretolook view --scene apartment-000 --path data/demo/apartment-000/path
  wheretolook view --scene apartment-000 --record apartment.rrd    # for the Rerun viewer, without a page"""


def parser() -> argparse.ArgumentParser:
    """Make the parser of the command's options."""
    made = CommandParser(prog="wheretolook view", usage=USAGE, description=ABOUT, epilog=_NOTES)
    add = made.add_argument
    add("--scene", metavar="NAME", help="a scene of a dataset, mapped by `wheretolook map`")
    add("--data", type=Path, default=Path("data"), metavar="FOLDER", help="folder of the datasets (data)")
    add("--name", default="", metavar="NAME", help="dataset of --scene, if several have a scene of this name")
    add("--map", type=Path, metavar="SPARSE", help="instead: folder of a COLMAP model, in metres with z up")
    add("--mesh", type=Path, metavar="FILE", help="mesh in the map's frame (GLB, OBJ, PLY)")
    add("--images", type=Path, metavar="FOLDER", help="the map's images, shown next to views")
    add("--path", type=Path, metavar="FILE", help="path to play")
    add("--pair", type=int, default=0, metavar="N", help="start and goal of compared paths (0)")
    add("--weights", type=Path, metavar="FILE", help="weights, or a folder (the scene's own, or the bundled ones)")
    add("--method", default="", metavar="NAME", help="scoring method at first (that of the weights)")
    add("--camera", metavar="TEXT", help="the camera, COLMAP's MODEL,width,height,parameters (the map's)")
    add("--camera-id", type=int, metavar="ID", help="instead: camera_id of one of the map's cameras")
    page = made.add_argument_group("the page")
    add = page.add_argument
    add("--host", default="127.0.0.1", metavar="NAME", help="address to serve at (127.0.0.1: this machine only)")
    add("--port", type=int, default=8080, metavar="N", help="port to serve at (8080)")
    add("--state", default="", metavar="TEXT", help="initial state, from the page's field `state`")
    add("--dark", action="store_true", help="dark at first")
    add("--record", type=Path, metavar="FILE", help="instead of a page: a Rerun recording, FILE.rrd")
    add("--film", type=Path, metavar="FILE", help="instead of a page: a film of the compared paths, FILE.webp or .gif")
    add("--device", default="auto", metavar="NAME", help="auto, cpu, cuda, cuda:1 (auto)")
    return made


def run(arguments: Sequence[str]) -> int:
    """Run the command. Returns the exit code 0; raises a WhereToLookError for invalid input."""
    options = parser().parse_args(arguments)
    start = time.monotonic()
    _validate(options)
    from wheretolook.view.paths import read_paths
    from wheretolook.view.shared import Shared
    from wheretolook.view.state import ViewState

    state = ViewState.parse(options.state)
    if options.method:
        state = replace(state, method=options.method)
    paths = None if options.path is None else read_paths(options.path, options.pair)
    viewed = _open(options)
    if state.method and state.method not in viewed.methods:
        fix = f"Use {', '.join(viewed.methods)}."
        raise ConfigError("no such method here, or no weights for it", value=state.method, fix=fix)
    shared = Shared(viewed, paths)
    summary = f"{viewed.name}: {len(viewed.landmarks):,} landmarks"
    if options.record is not None:
        from wheretolook.view.recording import record

        record(shared, options.record, state)
        print(f"{summary}, in {time.monotonic() - start:.0f} s: {options.record}")
        return 0
    if options.film is not None:
        (film,) = entry_points(group="wheretolook.view", name="film")
        n_frames = film.load()(shared, options.film, state)
        print(f"{summary}, {n_frames} frames in {time.monotonic() - start:.0f} s: {options.film}")
        return 0
    from wheretolook.view.server import Viewer

    viewer = Viewer(shared, options.host, options.port, state, options.dark)
    print(viewed.weights.describe(state.method or viewed.methods[0]) or "a method without weights", flush=True)
    print(f"{summary}, open after {time.monotonic() - start:.1f} s", flush=True)
    print(f"{viewer.url}    (Ctrl-C ends it)", flush=True)
    try:
        viewer.wait()
    except KeyboardInterrupt:
        print("ended")
    finally:
        viewer.stop()
    return 0


def _validate(options: argparse.Namespace) -> None:
    """Check the options before any file is read."""
    from wheretolook.view.server import check_port, require

    if (options.map is None) == (options.scene is None):
        raise ConfigError("give either --scene or --map")
    if options.scene is not None and (options.mesh is not None or options.images is not None):
        raise ConfigError("--mesh and --images belong to --map; a scene has its own")
    if options.camera is not None and options.camera_id is not None:
        raise ConfigError("give either --camera or --camera-id", value=options.camera)
    if options.scene is not None and options.camera_id is not None:
        raise ConfigError("--camera-id belongs to --map", value=options.camera_id, fix="Use --camera.")
    if options.images is not None and not options.images.is_dir():
        raise ConfigError("there is no such folder of images", path=options.images, fix="Correct the path.")
    if options.record is not None and options.film is not None:
        raise ConfigError("give either --record or --film", value=str(options.film))
    if options.scene is not None and options.data.is_dir():
        check_scene_name(options.data, options.scene, options.name)
    if options.record is not None:
        require("rerun")
        if options.record.suffix != ".rrd":
            raise ConfigError("a Rerun recording is a .rrd file", path=options.record)
    elif options.film is not None:
        if options.film.suffix not in (".webp", ".gif"):
            raise ConfigError("a film is a .webp or .gif file", path=options.film)
        if options.path is None or (options.map is not None and options.mesh is None):
            raise ConfigError("a film needs --path and a mesh", path=options.film)
    else:
        require("viser")
        check_port(options.host, options.port)


def _open(options: argparse.Namespace) -> ViewedMap:
    from wheretolook.geometry.camera_text import parse_camera
    from wheretolook.utils.devices import usable_device
    from wheretolook.view.viewed_map import open_map, open_named_scene

    device = usable_device(options.device)
    camera = None if options.camera is None else parse_camera(options.camera)
    if options.map is None:
        return open_named_scene(options.data, options.scene, options.name, camera, options.weights, device)
    chosen = camera or options.camera_id
    return open_map(options.map, options.mesh, chosen, options.images, options.weights, device, options.data)
