"""Write selected views to files, each of which names the frame of its poses.

The world is that of the map, in metres, z up; cameras look along their z, x right, y down.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wheretolook.geometry.poses import quaternion_from_rotation
from wheretolook.mapping.colmap_model import holds_model
from wheretolook.utils.errors import ConfigError, StorageError
from wheretolook.utils.files import write_json, write_text

if TYPE_CHECKING:
    from wheretolook.select.views import SelectedViews

FORMATS = {
    "csv": "a table; position of the camera in the world, quaternion camera-to-world (wxyz, and xyzw in one cell)",
    "json": "the same, with the camera",
    "tum": "t x y z qx qy qz qw, camera-to-world: a TUM trajectory",
    "colmap": "COLMAP's images.txt, world-to-camera; a folder gets cameras.txt and points3D.txt too",
    "benchmark": "# id qw qx qy qz tx ty tz, world-to-camera: poses of the Active Localization Benchmark",
}
"""Formats, and the frames in which they have poses."""


def format_of(path: Path, format: str | None = None) -> str:
    """Return the given format, or else that of the file's name: .csv, .json, .tum, images.txt; a folder is for COLMAP.

    Raises ConfigError if there is no such format, or the name has no known ending.
    """
    if format is None:
        by_suffix = {".csv": "csv", ".json": "json", ".tum": "tum", "": "colmap"}
        format = "colmap" if path.name == "images.txt" else by_suffix.get(path.suffix.lower())
        if format is None:
            fix = f"Name a format ({', '.join(FORMATS)}), or a file that ends on .csv, .json or .tum."
            raise ConfigError("the file's name has no known format", path=path, fix=fix)
    if format not in FORMATS:
        raise ConfigError("unknown format of views", value=format, fix=f"There are {', '.join(FORMATS)}.")
    return format


def check_format(path: Path, format: str | None, n: int) -> str:
    """Return the format of a file for n views of each waypoint.

    Raises ConfigError if the format holds one view only, or the path holds something else; StorageError if nothing can
    be written there.
    """
    chosen = format_of(path, format)
    if chosen in ("tum", "benchmark") and n > 1:
        fix = "Ask for one view, or write csv, json or colmap."
        raise ConfigError(f"a file of the format {chosen} has one view of each waypoint", value=n, fix=fix)
    if path.is_dir() and chosen != "colmap":
        raise ConfigError("this is a folder", path=path, fix="Name a file.")
    if chosen == "colmap" and not path.suffix and holds_model(path) and not _is_ours(path):
        raise ConfigError("this folder holds a COLMAP model", path=path, fix="Name another folder.")
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise StorageError("cannot write views there", path=folder, fix="Name a file in another folder.")
    return chosen


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
        write_text(path, _benchmark(views))
    elif path.suffix:
        write_text(path, _images(views))
    else:
        write_text(path / "cameras.txt", _cameras(views))
        write_text(path / "images.txt", _images(views))
        write_text(path / "points3D.txt", "# no points: poses of selected views\n")


_MARK = "# Views selected by wheretolook"


def _is_ours(folder: Path) -> bool:
    images = folder / "images.txt"
    return images.is_file() and images.read_text(errors="replace").startswith(_MARK)


def _rows(views: SelectedViews) -> list[dict[str, Any]]:
    """Return a record for each view; expected inliers are None where the method does not report them."""
    columns = {
        "rank": views.rank,
        **dict(zip("xyz", views.positions.T, strict=True)),
        "yaw_deg": views.yaw_deg,
        "pitch_deg": views.pitch_deg,
        "score": views.score,
        **({} if views.set_score is None else {"set_score": views.set_score}),
        "expected_inliers": [value if np.isfinite(value) else None for value in views.expected_inliers.tolist()],
        "n_visible": views.n_visible,
        "in_range": views.in_range,
        **dict(zip(("qw", "qx", "qy", "qz"), views.quaternions_wxyz.T, strict=True)),
    }
    values = [
        np.asarray(column, dtype=object if name == "expected_inliers" else None).tolist()
        for name, column in columns.items()
    ]
    rows = zip(views.waypoint_id, *values, strict=True)
    return [dict(zip(("waypoint", *columns), row, strict=True)) for row in rows]


FAR_M = 1000.0  # of a camera from the origin
_DIGITS = {"yaw_deg": ".3f", "pitch_deg": ".3f", "score": ".9g", "set_score": ".9g", "expected_inliers": ".2f"}


def _csv(views: SelectedViews) -> str:
    lines: list[str] = []
    for row in _rows(views):
        cells = {name: _cell(name, value) for name, value in row.items()}
        cells["quaternion_xyzw"] = " ".join(cells[name] for name in ("qx", "qy", "qz", "qw"))
        if not lines:
            lines.append(",".join(cells))
        lines.append(",".join(cells.values()))
    return "\n".join(lines) + "\n"


def _cell(name: str, value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool) or not isinstance(value, float):
        text = str(value)
        return '"' + text.replace('"', '""') + '"' if "," in text or '"' in text else text
    return format(value, _DIGITS.get(name, ".9f"))


def _json(views: SelectedViews) -> dict[str, Any]:
    frames = "x, y, z: camera centre in the world, m; qw, qx, qy, qz: camera-to-world; world z up, camera z forward"
    about = {"frames": frames, "method": views.method, "camera": views.camera.colmap.record()}
    poses = zip(_rows(views), views.quaternions_xyzw.tolist(), views.cam_from_world.tolist(), strict=True)
    rows = [row | {"quaternion_xyzw": xyzw, "cam_from_world": pose} for row, xyzw, pose in poses]
    return about | {"views": rows}


def _tum(views: SelectedViews) -> str:
    lines = [
        "# t x y z qx qy qz qw, camera-to-world, metres; t is the waypoint's name if that is a number, else a count"
    ]
    stamps = list(views.waypoint_id)
    try:
        [float(stamp) for stamp in stamps]
    except ValueError:
        stamps = [str(row) for row in range(len(views))]
    for stamp, position, quaternion in zip(stamps, views.positions, views.quaternions_xyzw, strict=True):
        lines.append(" ".join([stamp, *_numbers(position), *_numbers(quaternion)]))
    return "\n".join(lines) + "\n"


def _benchmark(views: SelectedViews) -> str:
    lines = ["# id qw qx qy qz tx ty tz"]
    for name, pose in zip(views.waypoint_id, _cam_from_world(views), strict=True):
        lines.append(" ".join([name.replace(" ", "_"), *pose]))
    return "\n".join(lines) + "\n"


def _images(views: SelectedViews) -> str:
    lines = [_MARK + ": world-to-camera; a name is that of the waypoint, and of several views the rank"]
    lines += ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# an empty line follows: no points"]
    several = views.rank.max(initial=1) > 1
    for number, pose in enumerate(_cam_from_world(views), 1):
        name = views.waypoint_id[number - 1].replace(" ", "_")
        name += f"-{views.rank[number - 1]}" if several else ""
        lines += [" ".join([str(number), *pose, "1", name]), ""]
    return "\n".join(lines) + "\n"


def _cameras(views: SelectedViews) -> str:
    record = views.camera.colmap.record()
    values = [1, record["model"], record["width"], record["height"], *record["params"]]
    return "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n" + " ".join(map(str, values)) + "\n"


def _cam_from_world(views: SelectedViews) -> list[list[str]]:
    """qw qx qy qz tx ty tz of each view, world-to-camera.

    Far from the origin quaternions get more decimals, which decide where the camera is: its centre follows from both.
    """
    quaternions = quaternion_from_rotation(views.cam_from_world[:, :, :3])
    poses = zip(quaternions, views.cam_from_world[:, :, 3], strict=True)
    decimals = 9 if np.abs(views.cam_from_world[:, :, 3]).max(initial=0) < FAR_M else 15
    return [[*_numbers(quaternion, decimals), *_numbers(shift)] for quaternion, shift in poses]


def _numbers(values: Any, decimals: int = 9) -> list[str]:
    return [f"{value:.{decimals}f}" for value in values]
