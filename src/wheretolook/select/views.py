"""Formats of files of selected views."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import Camera
from wheretolook.geometry.camera_turns import pan_tilt_angles
from wheretolook.geometry.poses import Float, camera_centers, quaternion_from_rotation
from wheretolook.io.poses import images_text, pose_texts, tum_text
from wheretolook.mapping.map_frame import IDENTITY, MapFrame
from wheretolook.utils.errors import ConfigError, StorageError, check_choice
from wheretolook.utils.files import check_output_folder, write_json, write_text

FORMATS = {
    "csv": "a table; position of the camera in the world, quaternion camera-to-world (wxyz, and xyzw in one cell)",
    "json": "the same, with the camera",
    "tum": "t x y z qx qy qz qw, camera-to-world: a TUM trajectory",
    "colmap": "COLMAP's images.txt, world-to-camera; a folder gets cameras.txt and points3D.txt too",
    "benchmark": "# id qw qx qy qz tx ty tz, world-to-camera: poses of the Active Localization Benchmark",
}
"""Formats, and the frames in which they have poses."""


def check_format(path: Path, format: str | None, n: int) -> str:
    """Return the format for n views of each waypoint: the given one, or else that of the file's name.

    The names are .csv, .json, .tum, images.txt; a folder is for COLMAP. Raises ConfigError if there is no such format,
    the format holds one view only, or the path holds something else; StorageError if nothing can be written there.
    """
    by_suffix = {".csv": "csv", ".json": "json", ".tum": "tum", "": "colmap"}
    by_name = "colmap" if path.name == "images.txt" else by_suffix.get(path.suffix.lower(), path.suffix)
    chosen = format or by_name
    check_choice("format of views", chosen, FORMATS)
    if chosen in ("tum", "benchmark") and n > 1:
        fix = "Ask for one view, or write csv, json or colmap."
        raise ConfigError(f"a file of the format {chosen} has one view of each waypoint", value=n, fix=fix)
    if path.is_dir() and chosen != "colmap":
        raise ConfigError("this is a folder", path=path, fix="Name a file.")
    if chosen == "colmap" and not path.suffix:
        check_output_folder(path, _is_ours(path))
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise StorageError("cannot write views there", path=folder, fix="Name a file in another folder.")
    return chosen


MARK = "# Views selected by wheretolook"


def _is_ours(folder: Path) -> bool:
    images = folder / "images.txt"
    return images.is_file() and images.read_text(errors="replace").startswith(MARK)


@dataclass(frozen=True, eq=False)
class SelectedViews:
    """V views: the best of each waypoint, in the order of waypoints, the best of a waypoint first.

    The world of poses is the map's own frame, in its unit; camera x right, y down, z forward. `cam_from_world` takes
    world to camera (world-to-camera); `quaternions_wxyz` and `quaternions_xyzw` are of the opposite, camera-to-world,
    as robots and TUM files have them.
    """

    waypoint: NDArray[np.int64]  # (V,) row of the waypoint in what was asked for, from 0
    waypoint_id: tuple[str, ...]  # V names of the waypoints
    rank: NDArray[np.int64]  # (V,) 1 for the best view of the waypoint
    cam_from_world: Float  # (V, 3, 4) float64
    score: Float  # (V,)
    expected_inliers: Float  # (V,) expected number of inliers; NaN where the method does not predict it
    n_visible: NDArray[np.int64]  # (V,) visible landmarks
    in_range: NDArray[np.bool_]  # (V,) whether the view is within the training distribution of the scorer
    camera: Camera  # of the views
    method: str  # name of the scorer
    set_score: Float | None = None  # (V,) probability that the waypoint's views localize jointly, if chosen so
    frame: MapFrame = IDENTITY  # the map's own frame: its unit and direction up, and how they are known
    # (V,) landmarks that are hard to match, see `wheretolook.inputs.landmark_features`: in the image, but occluded; and of the
    # visible ones those that are too far, seen too obliquely, or repeated (NaN for a map without descriptors)
    n_occluded: NDArray[np.int64] | None = None
    n_too_far: NDArray[np.int64] | None = None
    n_too_oblique: NDArray[np.int64] | None = None
    n_repeated: Float | None = None
    # (V,) mean score over draws of an uncertain pose, if asked for, and the highest such mean of the best directions
    expected_score: Float | None = None
    best_expected_score: Float | None = None
    # (V,) mean errors of a pose at the right place, where the method predicts them
    expected_error_m: Float | None = None
    expected_error_deg: Float | None = None

    def __len__(self) -> int:
        return len(self.score)

    def __getitem__(self, rows: NDArray[np.int64]) -> SelectedViews:
        """Return some of the views."""
        values = {name: getattr(self, name)[rows] for name in _arrays(self)}
        return replace(self, waypoint_id=tuple(self.waypoint_id[row] for row in rows), **values)

    @property
    def positions(self) -> Float:
        """Camera centres in the map, (V, 3)."""
        return camera_centers(self.cam_from_world)

    @property
    def axes(self) -> Float:
        """Unit optical axes in the map, (V, 3)."""
        return np.asarray(self.cam_from_world[:, 2, :3])

    @property
    def _pan_tilt(self) -> tuple[Float, Float]:
        return pan_tilt_angles(self.axes @ self.frame.world_from_map.rotation.T)

    @property
    def yaw_deg(self) -> Float:
        """(V,) angle of the optical axis in the level plane: 0 along +x, 90 along +y; 0 straight up or down.

        In a map whose z is not up, x and y are those of the map after the smallest rotation that turns up to z.
        """
        return np.degrees(self._pan_tilt[0])

    @property
    def pitch_deg(self) -> Float:
        """(V,) angle of the optical axis above the level plane: 90 straight up."""
        return np.degrees(self._pan_tilt[1])

    @property
    def quaternions_wxyz(self) -> Float:
        """Unit quaternions wxyz (V, 4) of the orientation, camera-to-world, w >= 0."""
        return quaternion_from_rotation(np.swapaxes(self.cam_from_world[:, :, :3], 1, 2))

    @property
    def quaternions_xyzw(self) -> Float:
        """The same in the order xyzw."""
        return np.roll(self.quaternions_wxyz, -1, axis=1)

    def save(self, path: str | Path, format: str | None = None) -> None:
        """Write a file in the given format, or that of its name, see `wheretolook.select.views`.

        Raises a ConfigError if there is no such format, or it holds one view of a waypoint and there are several.
        """
        save_views(self, Path(path), format)


def joined(parts: Sequence[SelectedViews]) -> SelectedViews:
    """Concatenate views of one camera and method."""
    values: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in _arrays(parts[0])
    }
    return replace(parts[0], waypoint_id=tuple(name for part in parts for name in part.waypoint_id), **values)


def _arrays(views: SelectedViews) -> list[str]:
    """Return the names of the fields that are arrays."""
    return [field.name for field in fields(views) if isinstance(getattr(views, field.name), np.ndarray)]


def save_views(views: SelectedViews, path: Path, format: str | None = None) -> None:
    """Write views to a file, atomically; its folder is made if missing.

    Raises a ConfigError as `check_format`, a StorageError if the file cannot be written.
    """
    chosen = check_format(path, format, int(views.rank.max(initial=1)))
    if chosen == "csv":
        write_text(path, _csv(views))
    elif chosen == "json":
        write_json(path, _json(views))
    elif chosen == "tum":
        write_text(path, _tum(views))
    elif chosen == "benchmark":
        lines = zip(_names(views), pose_texts(views.cam_from_world), strict=True)
        write_text(path, "# id qw qx qy qz tx ty tz\n" + "".join(f"{name} {pose}\n" for name, pose in lines))
    elif path.suffix:
        write_text(path, _images(views))
    else:
        write_text(path / "cameras.txt", _cameras(views))
        write_text(path / "images.txt", _images(views))
        write_text(path / "points3D.txt", "# no points: poses of selected views\n")


def _columns(views: SelectedViews) -> dict[str, list[Any]]:
    """Return columns with a value for each view; expected inliers are None where the method does not report them."""
    columns: dict[str, Any] = {
        "waypoint": views.waypoint_id,
        "rank": views.rank,
        **dict(zip("xyz", views.positions.T, strict=True)),
        "yaw_deg": views.yaw_deg,
        "pitch_deg": views.pitch_deg,
        "score": views.score,
        **({} if views.set_score is None else {"set_score": views.set_score}),
        **{name: values for name in EXPECTED if (values := getattr(views, name)) is not None},
        "expected_inliers": views.expected_inliers,
        "n_visible": views.n_visible,
        **{name: getattr(views, name) for name in REASONS},
        "in_range": views.in_range,
        "scale": [views.frame.scale.source] * len(views),
        **dict(zip(("qw", "qx", "qy", "qz"), views.quaternions_wxyz.T, strict=True)),
    }
    rows = {name: np.asarray(values, dtype=object).tolist() for name, values in columns.items()}
    return {name: [None if value != value else value for value in values] for name, values in rows.items()}


EXPECTED = ("expected_score", "best_expected_score", "expected_error_m", "expected_error_deg")
REASONS = ("n_occluded", "n_too_far", "n_too_oblique", "n_repeated")
_DIGITS = {
    "yaw_deg": ".3f",
    "pitch_deg": ".3f",
    "score": ".9g",
    "set_score": ".9g",
    "expected_score": ".9g",
    "best_expected_score": ".9g",
    "expected_error_m": ".4g",
    "expected_error_deg": ".4g",
    "expected_inliers": ".2f",
    "n_repeated": ".0f",
}


def _csv(views: SelectedViews) -> str:
    columns = _columns(views)
    for name, values in columns.items():
        digits = _DIGITS.get(name, ".9f")
        columns[name] = [format(value, digits) if isinstance(value, float) else value for value in values]
    columns["quaternion_xyzw"] = [" ".join(row) for row in zip(*(columns[f"q{axis}"] for axis in "xyzw"), strict=True)]
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return text.getvalue()


def _json(views: SelectedViews) -> dict[str, Any]:
    frames = "x, y, z: camera centre in the map, in its unit; qw, qx, qy, qz: camera-to-world; camera z forward"
    columns = _columns(views)
    columns["quaternion_xyzw"] = views.quaternions_xyzw.tolist()
    columns["cam_from_world"] = views.cam_from_world.tolist()
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    camera = views.camera.colmap.record()
    known = {"metres_per_unit": views.frame.world_from_map.scale, "up": views.frame.world_from_map.rotation[2].tolist()}
    about = {"frames": frames, "scale": views.frame.scale.source, **known, "gravity": views.frame.gravity}
    return {**about, "method": views.method, "camera": camera, "views": rows}


def _tum(views: SelectedViews) -> str:
    stamps = views.waypoint_id
    try:
        np.array(stamps, dtype=float)
    except ValueError:
        stamps = tuple(map(str, range(len(views))))
    about = "# t x y z qx qy qz qw, camera-to-world, in the map's unit; t is the waypoint's name if that is a number, else a count"
    return f"{about}\n{tum_text(stamps, views.cam_from_world)}"


def _names(views: SelectedViews) -> list[str]:
    return [name.replace(" ", "_") for name in views.waypoint_id]


def _images(views: SelectedViews) -> str:
    names = _names(views)
    if views.rank.max(initial=1) > 1:
        names = [f"{name}-{rank}" for name, rank in zip(names, views.rank, strict=True)]
    about = f"{MARK}: world-to-camera; a name is that of the waypoint, and of several views the rank"
    return f"{about}\n{images_text(names, views.cam_from_world)}"


def _cameras(views: SelectedViews) -> str:
    record = views.camera.colmap.record()
    values = [1, record["model"], record["width"], record["height"], *record["params"]]
    return "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n" + " ".join(map(str, values)) + "\n"
