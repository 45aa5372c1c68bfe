"""Read paths to show: a planned path, compared paths, or any file of poses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float, camera_centers, poses_looking_along
from wheretolook.geometry.similarity import Similarity
from wheretolook.mapping.map_frame import IDENTITY
from wheretolook.utils.errors import TableError

MAX_COORDINATE_M = 1e9
GOOD_M = 0.25
GOOD_DEG = 2.0
"""Errors of a view below which it counts as localized, as in compared paths."""
MAX_POSES = 5000
MAX_METHODS = 20
_FIX = """\
Give the folder or path.csv of `wheretolook plan`, a scene's folder in results/paths of `wheretolook compare-paths`, a
TUM trajectory (t x y z qx qy qz qw, camera-to-world), or a CSV of selected views."""


@dataclass(frozen=True, eq=False)
class RecordedPath:
    """Views along a path."""

    cam_from_world: Float  # (W, 3, 4)
    localized: NDArray[np.bool_] | None = None  # (W,) whether each view localized; None if unknown

    def __len__(self) -> int:
        return len(self.cam_from_world)


Paths = dict[str, RecordedPath]
"""Paths by method."""


def read_paths(path: Path, pair: int = 0, world_from_map: Similarity = IDENTITY.world_from_map) -> Paths:
    """Read the views along a path by method; of compared paths those of one start-goal pair.

    Poses are moved from the map's own frame to the world. A single path is accompanied by `FORWARD`: the same locations
    seen by a camera that looks ahead. Raises TableError if the file is missing or has no valid poses.
    """
    from wheretolook.io.poses import read_poses
    from wheretolook.planning.config import FORWARD

    if path.is_dir():
        path = next((path / name for name in ("path.csv", "views.parquet") if (path / name).is_file()), path)
    if path.suffix == ".parquet":
        paths = _compared_paths(path, pair)
    else:
        paths = {"planned" if path.name == "path.csv" else path.stem: RecordedPath(read_poses(path).cam_from_world)}
    if not 1 <= len(paths) <= MAX_METHODS:
        problem = f"1 to {MAX_METHODS} methods can be shown"
        raise TableError(problem, path=path, value=len(paths), fix="Correct --pair, or leave out methods.")
    for along in paths.values():
        finite = (np.abs(along.cam_from_world) < MAX_COORDINATE_M).all()  # False for NaN
        if not 2 <= len(along) <= MAX_POSES or not finite:
            raise TableError(f"a path has 2 to {MAX_POSES} finite poses", path=path, value=len(along), fix=_FIX)
    place = world_from_map.apply_to_poses
    paths = {name: replace(along, cam_from_world=place(along.cam_from_world)) for name, along in paths.items()}
    if len(paths) == 1:
        (only,) = paths.values()
        return {FORWARD: RecordedPath(looking_ahead(camera_centers(only.cam_from_world))), **paths}
    return paths


def looking_ahead(positions: Float) -> Float:
    """Return level poses (W, 3, 4) at positions (W, 3) m that look along the path; stationary ones keep direction."""
    steps = np.diff(positions, axis=0, append=positions[-1:])
    steps[:, 2] = 0
    moving = np.flatnonzero(np.linalg.norm(steps, axis=1) >= 1e-6)
    if len(moving) == 0:
        return poses_looking_along(positions, np.tile((1.0, 0.0, 0.0), (len(positions), 1)))
    last = np.searchsorted(moving, np.arange(len(steps)), side="right") - 1  # the first direction before any motion
    return poses_looking_along(positions, steps[moving[np.maximum(last, 0)]])


def _compared_paths(path: Path, pair: int) -> Paths:
    """Read the paths that every method planned, or its views along the given path if any method planned none."""
    from wheretolook.dataset.viewpoint_table import UNLABELLED, is_good, poses
    from wheretolook.utils.parquet_files import read_parquet

    try:
        table = read_parquet(path)
        all_scenes = path.parent.parent / path.name  # has labels, too
        if all_scenes.is_file():
            labelled = read_parquet(all_scenes)
            labelled = labelled[labelled["scene"] == path.parent.name]
            table = labelled if len(labelled) else table
        table = table[table["pair"] == pair].sort_values("waypoint", kind="stable")
        methods = [name for name in table["method"].unique() if " " not in name]  # others name a second selection rule
        planned = table[table["task"] == "planned"]
        chosen = planned if {*methods} <= {*planned["method"]} else table[table["task"] == "given"]
        paths = {}
        for name in methods:
            rows = chosen[chosen["method"] == name]
            has_labels = "status" in rows and not (rows["status"] == UNLABELLED).any()
            paths[str(name)] = RecordedPath(poses(rows), is_good(rows, GOOD_M, GOOD_DEG) if has_labels else None)
        return paths
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TableError(f"no path can be read: {error}", path=path, fix=_FIX) from error
