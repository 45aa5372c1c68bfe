"""Views: camera poses with what is known of each of them, and the files that they are written to and read from."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from io import StringIO
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera import Camera, write_cameras
from wheretolook.geometry.pose_files import (
    CAM_FROM_BASE,
    NamedRows,
    images_text,
    is_of_base,
    pose_texts,
    poses_of_rows,
    read_named_rows,
    tum_text,
)
from wheretolook.geometry.poses import Float, camera_centers, pan_tilt_angles, quaternion_from_rotation
from wheretolook.utils.errors import ConfigError, StorageError, check_choice
from wheretolook.utils.files import check_output_folder, write_json, write_text
from wheretolook.utils.package import require

FORMATS = {
    "csv": "a table; position of the camera in the world, quaternion camera-to-world (wxyz, and xyzw in one cell)",
    "json": "the same, with the camera",
    "tum": "t x y z qx qy qz qw, camera-to-world: a TUM trajectory",
    "colmap": "COLMAP's images.txt, world-to-camera; a folder gets cameras.txt and points3D.txt too",
    "rosbag": "nav_msgs/Path of optical frames in a world in metres: a folder, a rosbag for ROS 2",
    "benchmark": "# id qw qx qy qz tx ty tz, world-to-camera: poses of the Active Localization Benchmark",
}
"""Formats, and the frames in which they have poses."""

WRITTEN = {
    "score": ".9g",
    "set_score": ".9g",
    "any_score": ".9g",
    "expected_score": ".9g",
    "best_expected_score": ".9g",
    "expected_error_m": ".4g",
    "expected_error_deg": ".4g",
    "expected_inliers": ".2f",
    "n_visible": "",
    "n_occluded": "",
    "n_too_far": "",
    "n_too_oblique": "",
    "n_repeated": ".0f",
    "in_range": "",
    "out_of_range": "",
    "camera_id": "",
    "sensor": "",
    "gain": ".4f",
    "share": ".4f",
    "share_low": ".4f",
    "share_high": ".4f",
    "p_registers": ".4f",
    "partner": "",
    "overlaps": "",
}
"""Columns that tables of views have in this order, if they are known, and how their floats are written."""

MARK = "# Views selected by wheretolook"  # first line of an images.txt that may be replaced

Column = Any  # an array (V, ...) or a tuple of V values; None if unknown


@dataclass(frozen=True, eq=False)
class Views:
    """V views: camera poses, and what is known of each in columns.

    `cam_from_world` takes world to camera; camera x right, y down, z forward. The world is metres with z up or, if a
    `frame` is given, the map's own frame, in its unit. `quaternions_wxyz` and `quaternions_xyzw` are of the opposite,
    camera-to-world, as robots and TUM files have them.
    """

    cam_from_world: Float  # (V, 3, 4) float64
    camera: Camera | None = None  # of all views; None if they have several
    method: str = ""  # name of the scorer
    frame: Any = None  # `MapFrame` of the map: its unit and direction up, and how they are known
    of_map: Any = None  # `MapCalibration` of the map of photographs that the scorer is calibrated for

    waypoint: Column = None  # (V,) row of the location among those asked for, from 0
    waypoint_id: Column = None  # V names of the locations or of the poses
    read_as: Column = None  # V times the format of the file that locations or poses were read from
    rank: Column = None  # (V,) 1 for the best view of the location, or the first to look along
    score: Column = None  # (V,) of the view on its own
    set_score: Column = None  # (V,) probability that all views of the location localize jointly
    any_score: Column = None  # (V,) probability that at least one view of the location localizes alone
    expected_inliers: Column = None  # (V,) landmarks expected to be detected; NaN where the method does not predict it
    n_visible: Column = None  # (V,) visible landmarks
    camera_id: Column = None  # (V,) in the model, where views have several cameras
    sensor: Column = None  # V names of the cameras of a rig
    in_range: Column = None  # (V,) whether the view is within the training distribution of the scorer
    out_of_range: Column = None  # (V,) quantities that are not, with their values and ranges
    # (V,) mean errors of a pose at the right place
    expected_error_m: Column = None
    expected_error_deg: Column = None
    # (V,) mean score over draws of an uncertain pose, and the highest such mean of the best directions
    expected_score: Column = None
    best_expected_score: Column = None
    # (V,) landmarks that are hard to match, see `wheretolook.inputs.landmark_features`: in the image, but occluded; and
    # of the visible ones those that are too far, seen too obliquely, or repeated (NaN for a map without descriptors)
    n_occluded: Column = None
    n_too_far: Column = None
    n_too_oblique: Column = None
    n_repeated: Column = None
    # (V,) of photographs to add to a map: gain in the predicted share of target views that localize, that share after
    # it with its 95 % interval, probability that it registers; names of its partner and of the images it overlaps with
    gain: Column = None
    share: Column = None
    share_low: Column = None
    share_high: Column = None
    p_registers: Column = None
    partner: Column = None
    overlaps: Column = None
    # (V,) of labelled views: number of the scene, ids of location and viewpoint, and block of neighbouring locations
    scene: Column = None
    location_id: Column = None
    viewpoint_id: Column = None
    block: Column = None
    good: Column = None  # (V,) whether the view localizes, or (V, T) within each of T thresholds
    direction_id: Column = None  # (V,) row of the direction in a lattice, -1 where there is no view
    pixels: Column = None  # V arrays (K, 2) of the landmarks in view
    images: Column = None  # (V, H, W, 3) uint8

    def __len__(self) -> int:
        return len(self.cam_from_world)

    def __getitem__(self, rows: slice | NDArray[np.integer] | NDArray[np.bool_]) -> Views:
        """Return some of the views, by their rows or a mask."""
        kept = np.arange(len(self))[rows]
        columns = self.columns
        for name, values in columns.items():
            columns[name] = values[kept] if isinstance(values, np.ndarray) else tuple(values[row] for row in kept)
        return replace(self, **columns)

    @property
    def columns(self) -> dict[str, Column]:
        """The poses and the known columns by name."""
        return {name: values for name, values in vars(self).items() if isinstance(values, (np.ndarray, tuple))}

    @classmethod
    def concatenate(cls, parts: Iterable[Views]) -> Views:
        """Concatenate views of one camera and method that have the same columns."""
        parts = [*parts]
        columns = parts[0].columns
        for name, values in columns.items():
            every = [getattr(part, name) for part in parts]
            columns[name] = np.concatenate(every) if isinstance(values, np.ndarray) else (*chain.from_iterable(every),)
        return replace(parts[0], **columns)

    @classmethod
    def read(cls, path: str | Path) -> Views:
        """Read poses and their names from a file or the folder of a model in any of `pose_files.FORMATS`.

        A table holds x, y, z and qw, qx, qy, qz, or in this order tx, ty, tz, qx, qy, qz, qw (world_from_cam); or in this
        order qw, qx, qy, qz, tx, ty, tz (cam_from_world). Raises TableError, with the line, if the file is missing or
        holds no poses.
        """
        return cls.of_rows(read_named_rows(path))

    @classmethod
    def of_rows(cls, table: NamedRows, up: ArrayLike = (0.0, 0.0, 1.0), frame: str | None = None) -> Views:
        """Return the poses in rows; those of a robot's base, see `is_of_base`, as of a camera at its origin that looks along x."""
        poses = poses_of_rows(table)
        read_as = table.format
        if is_of_base(table, poses, up, frame):
            poses = CAM_FROM_BASE @ poses
            read_as += ", of a robot's base: x forward, z up"
        return cls(poses, waypoint_id=table.names, read_as=(read_as,) * len(poses))

    @property
    def positions(self) -> Float:
        """Camera centres in the world, (V, 3)."""
        return camera_centers(self.cam_from_world)

    @property
    def axes(self) -> Float:
        """Unit optical axes in the world, (V, 3)."""
        return np.asarray(self.cam_from_world[:, 2, :3])

    @property
    def _yaw_pitch_deg(self) -> tuple[Float, Float]:
        upright = self.axes if self.frame is None else self.axes @ self.frame.world_from_map.rotation.T
        yaw, pitch = pan_tilt_angles(upright)
        return np.degrees(yaw), np.degrees(pitch)

    @property
    def yaw_deg(self) -> Float:
        """(V,) angle of the optical axis in the level plane: 0 along +x, 90 along +y; 0 straight up or down.

        In a map whose z is not up, x and y are those of the map after the smallest rotation that turns up to z.
        """
        return self._yaw_pitch_deg[0]

    @property
    def pitch_deg(self) -> Float:
        """(V,) angle of the optical axis above the level plane: 90 straight up."""
        return self._yaw_pitch_deg[1]

    @property
    def quaternions_wxyz(self) -> Float:
        """Unit quaternions wxyz (V, 4) of the orientation, camera-to-world, w >= 0."""
        return quaternion_from_rotation(np.swapaxes(self.cam_from_world[:, :, :3], 1, 2))

    @property
    def quaternions_xyzw(self) -> Float:
        """The same in the order xyzw."""
        return np.roll(self.quaternions_wxyz, -1, axis=1)

    def in_frame(self, frame: Any) -> Views:
        """Return views in the world in the own frame of a map, a `MapFrame`."""
        return replace(
            self, cam_from_world=frame.world_from_map.inverse.apply_to_poses(self.cam_from_world), frame=frame
        )

    def save(self, path: str | Path, format: str | None = None) -> None:
        """Write selected views, with names, ranks, camera and frame, to a file, atomically; its folder is made if missing.

        The format is one of `FORMATS`, by default that of the file's name. Raises a ConfigError as `check_format`, a
        StorageError if the file cannot be written.
        """
        path = Path(path)
        chosen = check_format(path, format, int(self.rank.max(initial=1)))
        names = [name.replace(" ", "_") for name in self.waypoint_id]
        if chosen == "csv":
            write_text(path, _csv_text(self))
        elif chosen == "json":
            write_json(path, _json_content(self))
        elif chosen == "tum":
            write_text(path, _trajectory_text(self))
        elif chosen == "rosbag":
            _write_bag(path, self)
        elif chosen == "benchmark":
            lines = [f"{name} {pose}\n" for name, pose in zip(names, pose_texts(self.cam_from_world), strict=True)]
            write_text(path, "# id qw qx qy qz tx ty tz\n" + "".join(lines))
        else:
            if self.rank.max(initial=1) > 1:
                names = [f"{name}-{rank}" for name, rank in zip(names, self.rank, strict=True)]
            about = f"{MARK}: world-to-camera; a name is that of the waypoint, and of several views the rank"
            images = f"{about}\n{images_text(names, self.cam_from_world)}"
            if path.suffix:
                write_text(path, images)
                return
            if self.camera is None:
                raise ConfigError("a model of views has one camera, and these have several", fix="Write csv or json.")
            write_cameras({1: self.camera}, path / "cameras.txt")
            write_text(path / "images.txt", images)
            write_text(path / "points3D.txt", "# no points: poses of selected views\n")


def check_format(path: Path, format: str | None, n: int) -> str:
    """Return the format for n views of each waypoint: the given one, or else that of the file's name.

    The names are .csv, .json, .tum, images.txt; a folder is for COLMAP. Raises ConfigError if there is no such format,
    its package is missing, the format holds one view only, or the path holds something else; StorageError if nothing
    can be written there.
    """
    by_suffix = {".csv": "csv", ".json": "json", ".tum": "tum", "": "colmap"}
    by_name = "colmap" if path.name == "images.txt" else by_suffix.get(path.suffix.lower(), path.suffix)
    chosen = format or by_name
    check_choice("format of views", chosen, FORMATS)
    if chosen == "rosbag":
        require("rosbags")
    if chosen in ("tum", "benchmark") and n > 1:
        fix = "Ask for one view, or write csv, json or colmap."
        raise ConfigError(f"a file of the format {chosen} has one view of each waypoint", value=n, fix=fix)
    if path.is_dir() and chosen != "colmap":
        raise ConfigError("this is a folder", path=path, fix="Name a file.")
    if chosen == "colmap" and not path.suffix:
        images = path / "images.txt"
        check_output_folder(path, images.is_file() and images.read_text(errors="replace").startswith(MARK))
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise StorageError("cannot write views there", path=folder, fix="Name a file in another folder.")
    return chosen


def _table(views: Views) -> dict[str, list[Any]]:
    """Return columns with a value for each view; None in place of NaN."""
    x, y, z = views.positions.T
    columns: dict[str, Any] = {"waypoint": views.waypoint_id, "rank": views.rank, "x": x, "y": y, "z": z}
    columns |= {"yaw_deg": views.yaw_deg, "pitch_deg": views.pitch_deg}
    columns |= {name: values for name in WRITTEN if (values := getattr(views, name)) is not None}
    columns |= {name: [text] * len(views) for name, text in views.frame.angle_columns.items()}
    columns["scale"] = [views.frame.scale.source] * len(views)
    if views.read_as is not None:
        columns["read_as"] = views.read_as
    columns |= dict(zip(("qw", "qx", "qy", "qz"), views.quaternions_wxyz.T, strict=True))
    rows = {name: np.asarray(values, dtype=object).tolist() for name, values in columns.items()}
    return {name: [None if value != value else value for value in values] for name, values in rows.items()}


def _csv_text(views: Views) -> str:
    columns = _table(views)
    for name, values in columns.items():
        digits = WRITTEN.get(name, ".3f" if name in ("yaw_deg", "pitch_deg") else ".9f")
        columns[name] = [format(value, digits) if isinstance(value, float) else value for value in values]
    columns["quaternion_xyzw"] = [" ".join(row) for row in zip(*(columns[f"q{axis}"] for axis in "xyzw"), strict=True)]
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return text.getvalue()


def _json_content(views: Views) -> dict[str, Any]:
    columns = _table(views)
    columns["quaternion_xyzw"] = views.quaternions_xyzw.tolist()
    columns["cam_from_world"] = views.cam_from_world.tolist()
    world_from_map = views.frame.world_from_map
    return {
        "frames": "x, y, z: camera centre in the map, in its unit; qw, qx, qy, qz: camera-to-world; camera z forward",
        "scale": views.frame.scale.source,
        "metres_per_unit": world_from_map.scale,
        "up": world_from_map.rotation[2].tolist(),
        "yaw_zero": world_from_map.rotation[0].tolist(),
        "gravity": views.frame.gravity,
        "method": views.method,
        "calibration": None if views.of_map is None else asdict(views.of_map),
        "camera": None if views.camera is None else views.camera.colmap.record(),
        "views": [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)],
    }


def _write_bag(folder: Path, views: Views) -> None:
    """Write a rosbag with a nav_msgs/Path of the optical frames. Raises ConfigError if the map's unit is unknown."""
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    views.frame.check_metric("a rosbag is")
    store = get_typestore(Stores.ROS2_HUMBLE)

    def make(name: str, *values: Any) -> Any:
        return store.types[name.replace("/", "/msg/")](*values)

    in_world = replace(views, cam_from_world=views.frame.world_from_map.apply_to_poses(views.cam_from_world))
    header = make("std_msgs/Header", make("builtin_interfaces/Time", 0, 0), "map")
    path = make("nav_msgs/Path", header, [])
    for position, quaternion in zip(in_world.positions, in_world.quaternions_xyzw, strict=True):
        at = make("geometry_msgs/Point", *position)
        pose = make("geometry_msgs/Pose", at, make("geometry_msgs/Quaternion", *quaternion))
        path.poses.append(make("geometry_msgs/PoseStamped", header, pose))
    with Writer(folder, version=9) as writer:
        connection = writer.add_connection("/views", path.__msgtype__, typestore=store)
        writer.write(connection, 0, store.serialize_cdr(path, path.__msgtype__))


def _trajectory_text(views: Views) -> str:
    stamps = views.waypoint_id
    try:
        np.array(stamps, dtype=float)
    except ValueError:
        stamps = [str(row) for row in range(len(views))]
    about = "# camera-to-world, in the map's unit; t is the waypoint's name if that is a number, else a count"
    return f"{about}\n# t x y z qx qy qz qw\n{tum_text(stamps, views.cam_from_world)}"
