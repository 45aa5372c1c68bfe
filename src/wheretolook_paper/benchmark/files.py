"""The files of a scene folder of the Active Localization Benchmark: poses "id qw qx qy qz tx ty tz", errors "id metres degrees"."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.pose_files import pose_texts, poses_of_values, read_rows
from wheretolook.geometry.poses import Float
from wheretolook.mapping.colmap_model import holds_model
from wheretolook.utils.errors import MapError, SceneError, TableError, WhereToLookError
from wheretolook.utils.files import write_text

IMAGE_ENDING = ".png"


@dataclass(frozen=True, eq=False)
class PoseFile:
    """N poses in the order of the file."""

    ids: tuple[str, ...]
    quaternions: Float  # (N, 4) wxyz, cam_from_world, as in the file
    cam_from_world: Float  # (N, 3, 4)


@dataclass(frozen=True, eq=False)
class ErrorFile:
    """N errors of estimated poses in the order of the file."""

    ids: tuple[str, ...]  # without the image's suffix
    metres: Float  # (N,) distance between camera centres; NaN without a pose
    degrees: Float  # (N,) angle between orientations


def write_poses(path: Path, ids: Sequence[str], cam_from_world: ArrayLike) -> None:
    """Write poses (N, 3, 4) atomically, creating the folder if missing."""
    lines = [f"{name} {pose}\n" for name, pose in zip(ids, pose_texts(cam_from_world, exact=True), strict=True)]
    write_text(path, "".join(["# id qw qx qy qz tx ty tz\n", *lines]))


def read_poses(path: Path) -> PoseFile:
    """Read a file of poses. Raises a TableError if it is missing, a line is not a pose, or ids repeat."""
    ids, values = _read(path, "id qw qx qy qz tx ty tz")
    # the tolerance of numpy.isclose in evaluate_plan.py
    is_unit = np.abs(np.linalg.norm(values[:, :4], axis=1) - 1) <= 1e-5
    invalid = np.flatnonzero(~(is_unit & np.isfinite(values).all(axis=1)))
    if len(invalid):
        fix = "Write finite numbers and quaternions of length 1, or omit the pose."
        raise TableError("this is not a pose", path=path, value=ids[invalid[0]], fix=fix)
    return PoseFile(ids, values[:, :4], poses_of_values(values))


def write_errors(path: Path, ids: Sequence[str], metres: ArrayLike, degrees: ArrayLike) -> None:
    """Write errors (N,) in metres and degrees, NaN without a pose, in the order of the images' file names (1, 10, 2)."""
    rows = zip(ids, np.asarray(metres).tolist(), np.asarray(degrees).tolist(), strict=True)
    ordered = sorted(rows, key=lambda row: row[0] + IMAGE_ENDING)
    write_text(path, "".join(f"{name} {m!r} {deg!r}\n" for name, m, deg in ordered))


def read_errors(path: Path) -> ErrorFile:
    """Read a file of errors, from `write_errors` or match_and_localize.py, which keeps the suffix of failed images.

    Raises a TableError if it is missing or empty, a line is not an error, or ids repeat.
    """
    ids, values = _read(path, "id metres degrees")
    return ErrorFile(ids, values[:, 0], values[:, 1])


def _read(path: Path, columns: str) -> tuple[tuple[str, ...], Float]:
    """Read the ids (N,) and numbers (N, C) of a file whose lines have the named columns."""
    rows = [cells for _, cells in read_rows(path)]
    ids = tuple(cells[0].removesuffix(IMAGE_ENDING) for cells in rows)
    try:
        values = np.array([cells[1:] for cells in rows], dtype=np.float64)
    except ValueError as error:
        raise TableError(f"its lines are not {columns!r}: {error}", path=path) from error
    if values.shape[1:] != (columns.count(" "),) or len({*ids}) < len(ids):
        raise TableError(f"its lines are not {columns!r}, each id once", path=path)
    return ids, values


CAMERA = PinholeCamera(320, 320, 277.0, center_px=(159.5, 159.5))
"""The benchmark's camera (its camera.py), of 60 degrees: that of its maps, and the one it localizes with."""

DRAWN_CAMERA = PinholeCamera(320, 320, 277.0)
"""The camera that its images are rendered with.

The viewer's principal point is the image centre, (160, 160) in COLMAP's pixels, whose first centre is (0.5, 0.5); the
benchmark's (159.5, 159.5) is the same point with pixel centres at integers. Its scripts shift keypoints to COLMAP's
pixels but not the principal point, so maps and queries share an offset of half a pixel (0.1 degrees), which cancels.
"""

_WAYPOINTS = ("waypoints.txt", "sampled_waypoints.txt", "sampled_viewpoints.txt")
_MODELS = ("scene_reconstruction", "scene_reconstruction/reference_sfm")
_SEE = "`wheretolook benchmark --help` lists the files of a scene folder."


@dataclass(frozen=True)
class BenchmarkScene:
    """The files of a scene."""

    name: str
    model: Path  # folder of the COLMAP model
    images: Path  # folder of the map's images, which may be missing
    mesh: Path
    waypoints: Path

    @classmethod
    def of(cls, folder: Path, mesh: Path | None = None, waypoints: Path | None = None) -> BenchmarkScene:
        """Find the files of a scene folder, except those given.

        Raises a SceneError without folder or mesh, a MapError without model, a TableError without waypoints.
        """
        folder = folder.resolve()
        models = [folder / name for name in _MODELS if holds_model(folder / name)]
        if not models:
            problem = "the scene lacks its COLMAP model: cameras, images and points3D, .bin or .txt"
            raise MapError(problem, path=folder / _MODELS[0], fix=_SEE)
        # folders are named as in the Habitat-Matterport dataset, "00010-DBjEcHFg4oq"
        meshes = [folder / f"{name}.glb" for name in (folder.name.partition("-")[2], folder.name) if name]
        others = [*folder.glob("*.glb")]
        return cls(
            folder.name,
            models[0],
            folder / "scene_reconstruction" / "images",
            _first([mesh] if mesh else [*meshes, *(others if len(others) == 1 else [])], SceneError, "its mesh"),
            _first([waypoints] if waypoints else [folder / name for name in _WAYPOINTS], TableError, "its waypoints"),
        )

    def image_file(self, name: str) -> Path:
        """Return the file of a map image. Raises a MapError if there is none.

        Names in the benchmark's models are paths as passed to its scripts, such as "scene_reconstruction/images/0.png";
        of a path that leaves the scene only the last part is used.
        """
        path = Path(name)
        places = [self.images / path.name]
        if not path.is_absolute() and ".." not in path.parts:
            places = [self.images / path, self.images.parent.parent / path, *places]
        found = next((place for place in places if place.is_file()), None)
        if found is None:
            fix = "Copy it there, or localize with the benchmark's own script: --localizer none."
            raise MapError("an image of the map is missing", path=places[-1], value=name, fix=fix)
        return found


def _first(paths: list[Path], error: type[WhereToLookError], what: str) -> Path:
    found = next((path for path in paths if path.is_file()), None)
    if found is None:
        raise error(f"the scene lacks {what}", path=paths[0], fix=_SEE)
    return found
