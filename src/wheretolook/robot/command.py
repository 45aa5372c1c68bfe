"""`wheretolook export`: write map and network for scoring views on a robot."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.utils.errors import ConfigError
from wheretolook.utils.options import CommandParser
from wheretolook.utils.shipped import WEIGHTS, or_shipped

if TYPE_CHECKING:
    from wheretolook.geometry.poses import Float
    from wheretolook.space.free_space import FreeSpace

SCORER = f"{WEIGHTS}/set.safetensors"
MAX_PLACES = 20_000

_TEXT = """\
Export a map and a network, so that a robot scores views with NumPy and onnxruntime, without PyTorch.

The folder holds the network (scorer.onnx), the landmarks (landmarks.npz), the camera (robot.json), and
wheretolook_robot.py, which reads and documents them. Copy it to the robot; `pip install numpy onnxruntime` there."""

_MORE = """\
The robot does not compute occlusion. With --mesh the landmarks unoccluded from each free cell of a grid are stored, and
the robot uses those of the nearest cell; without, landmarks are visible through walls.

Example:
  wheretolook export --map sparse/0 --mesh house.glb --spacing 0.5 --out robot
  cd robot && python -c "from wheretolook_robot import RobotScorer; print(RobotScorer('.').best((1, 2, 1.5)))"
"""


def run(arguments: Sequence[str]) -> int:
    """Run the command. Returns the exit code 0; raises a WhereToLookError for invalid input."""
    parser = CommandParser("wheretolook export", description=_TEXT, epilog=_MORE)
    parser.add_argument("--map", type=Path, required=True, metavar="SPARSE", help="COLMAP model, in metres, z up")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="where to write")
    parser.add_argument(
        "--weights",
        type=Path,
        default=Path(SCORER),
        metavar="FILE",
        help="weights of the method set (the bundled ones)",
    )
    parser.add_argument(
        "--camera",
        metavar="CAMERA",
        help="the robot's pinhole as COLMAP writes it, 'PINHOLE,WIDTH,HEIGHT,FX,FY,CX,CY'; by default the map's only "
        "camera, or the pinhole of its rectified images",
    )
    parser.add_argument("--camera-id", type=int, metavar="ID", help="or the camera_id of one of the map's cameras")
    parser.add_argument(
        "--database", type=Path, metavar="FILE", help="the map's database: descriptors measure ambiguity"
    )
    parser.add_argument("--mesh", type=Path, metavar="FILE", help="mesh of the scene, for occlusion")
    parser.add_argument(
        "--spacing", type=float, default=0.5, metavar="METRES", help="spacing of the grid (%(default)s)"
    )
    given = parser.parse_args(arguments)
    if not 0 < given.spacing < float("inf"):
        raise ConfigError("the spacing must be positive", value=given.spacing, fix="Give it in metres.")
    if given.camera is not None and given.camera_id is not None:
        raise ConfigError("give either --camera or --camera-id", value=given.camera)
    _export(given)
    return 0


def _export(given: argparse.Namespace) -> None:
    from wheretolook.dataset.environment import ColmapEnvironment, ColmapFiles
    from wheretolook.geometry.camera_text import parse_camera
    from wheretolook.robot.export import export_robot, pinhole_of

    named = given.camera_id if given.camera is None else parse_camera(given.camera)
    files = ColmapFiles(given.map, mesh=given.mesh, database=given.database)
    environment = ColmapEnvironment(files, named, occlusion="none" if given.mesh is None else "mesh")
    places = None if given.mesh is None else _places(environment.mesh_space, given.spacing)
    found = environment.localization_map
    camera = pinhole_of(found.camera)
    if camera != found.camera:
        print(
            "the map's camera has distortion: the robot's is the pinhole of its rectified images; to change it, use --camera"
        )
    export_robot(found.of_camera(camera), or_shipped(given.weights), given.out, places)
    print(f"{len(found.landmarks):,} landmarks, a camera of {camera.width} x {camera.height} px: {given.out}")
    if places is None:
        print("without --mesh landmarks are visible through walls")
    else:
        print(f"occlusion is stored for {len(places):,} free places, {given.spacing:g} m apart")


def _places(space: FreeSpace, spacing_m: float) -> Float:
    """Return free locations (L, 3) m of a grid over the mesh. Raises ConfigError if there are none or too many."""
    import numpy as np

    low, high = space.bounds
    counts = np.maximum(1, np.ceil((high - low) / spacing_m)).astype(np.int64)
    if counts.prod() > 100 * MAX_PLACES:
        raise ConfigError("the grid is too fine for this mesh", value=spacing_m, fix="Give a larger --spacing.")
    # centred between both bounds
    axes = [(a + b) / 2 + (np.arange(n) - (n - 1) / 2) * spacing_m for a, b, n in zip(low, high, counts, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    free = grid[space.is_free(grid)]
    if len(free) == 0:
        fix = "Give a smaller --spacing, or a mesh with free space above a floor (metres, z up)."
        raise ConfigError("no location of the grid is free", value=spacing_m, fix=fix)
    if len(free) > MAX_PLACES:
        raise ConfigError(f"the grid has {len(free):,} free places", value=spacing_m, fix="Give a larger --spacing.")
    return free
