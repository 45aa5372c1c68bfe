"""Formats of files of selected views."""

from __future__ import annotations

import os
from pathlib import Path

from wheretolook.utils.errors import ConfigError, StorageError
from wheretolook.utils.files import check_output_folder
from wheretolook.utils.validation import check_choice

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
