"""Write selected views to files, each of which names the frame of its poses.

The world is the map's own frame, in its unit; cameras look along their z, x right, y down.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wheretolook.io.poses import images_text, pose_texts, tum_text
from wheretolook.mapping.colmap_model import holds_model
from wheretolook.utils.errors import ConfigError, StorageError
from wheretolook.utils.files import write_json, write_text
from wheretolook.utils.validation import check_choice

if TYPE_CHECKING:
    import pandas as pd

    from wheretolook.select.views import SelectedViews

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
        lines = zip(_names(views), pose_texts(views.cam_from_world), strict=True)
        write_text(path, "# id qw qx qy qz tx ty tz\n" + "".join(f"{name} {pose}\n" for name, pose in lines))
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


def _table(views: SelectedViews) -> pd.DataFrame:
    """Return a row for each view; expected inliers are NaN where the method does not report them."""
    import pandas as pd

    columns = {
        "waypoint": list(views.waypoint_id),
        "rank": views.rank,
        **dict(zip("xyz", views.positions.T, strict=True)),
        "yaw_deg": views.yaw_deg,
        "pitch_deg": views.pitch_deg,
        "score": views.score,
        **({} if views.set_score is None else {"set_score": views.set_score}),
        "expected_inliers": views.expected_inliers,
        "n_visible": views.n_visible,
        **{name: getattr(views, name) for name in REASONS},
        "in_range": views.in_range,
        "scale": views.frame.scale.source,
        **dict(zip(("qw", "qx", "qy", "qz"), views.quaternions_wxyz.T, strict=True)),
    }
    return pd.DataFrame(columns)


REASONS = ("n_occluded", "n_too_far", "n_too_oblique", "n_repeated")
_DIGITS = {
    "yaw_deg": ".3f",
    "pitch_deg": ".3f",
    "score": ".9g",
    "set_score": ".9g",
    "expected_inliers": ".2f",
    "n_repeated": ".0f",
}


def _csv(views: SelectedViews) -> str:
    table = _table(views)
    for name in [name for name, values in table.items() if values.dtype.kind == "f"]:
        pattern = f"{{:{_DIGITS.get(str(name), '.9f')}}}"
        table[name] = table[name].map(pattern.format, na_action="ignore")
    table["quaternion_xyzw"] = table[["qx", "qy", "qz", "qw"]].agg(" ".join, axis=1)
    return str(table.to_csv(index=False, lineterminator="\n"))


def _json(views: SelectedViews) -> dict[str, Any]:
    frames = "x, y, z: camera centre in the map, in its unit; qw, qx, qy, qz: camera-to-world; camera z forward"
    table = _table(views).astype(object)
    table = table.where(table.notna(), None)
    table["quaternion_xyzw"] = views.quaternions_xyzw.tolist()
    table["cam_from_world"] = views.cam_from_world.tolist()
    camera = views.camera.colmap.record()
    known = {"metres_per_unit": views.frame.world_from_map.scale, "up": views.frame.world_from_map.rotation[2].tolist()}
    about = {"frames": frames, "scale": views.frame.scale.source, **known, "gravity": views.frame.gravity}
    return {**about, "method": views.method, "camera": camera, "views": table.to_dict("records")}


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
    about = f"{_MARK}: world-to-camera; a name is that of the waypoint, and of several views the rank"
    return f"{about}\n{images_text(names, views.cam_from_world)}"


def _cameras(views: SelectedViews) -> str:
    record = views.camera.colmap.record()
    values = [1, record["model"], record["width"], record["height"], *record["params"]]
    return "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n" + " ".join(map(str, values)) + "\n"
