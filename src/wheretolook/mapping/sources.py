"""Locate the database and images that a map was built from."""

from __future__ import annotations

from pathlib import Path

from wheretolook.mapping.feature_files import HDF5_SUFFIXES
from wheretolook.mapping.georeference import REPORT_FILE
from wheretolook.mapping.map_folder import DATABASE_FILE
from wheretolook.utils.reading import read_json_object


def find_features(model_dir: Path) -> Path | None:
    """Find the file of features of a map, in its folder, COLMAP's usual folders or its report; None if there is none."""
    places = (model_dir, model_dir.parent / "photographs", model_dir.parent, model_dir.parent.parent)
    for place in places:
        if (place / DATABASE_FILE).is_file():
            return place / DATABASE_FILE
    found = [path for suffix in HDF5_SUFFIXES for path in sorted(model_dir.glob(f"*{suffix}"))]
    if len(found) == 1:
        return found[0]
    named = _reported(model_dir, "existing", "database")
    return Path(named) if named is not None and Path(named).is_file() else None


def find_photographs(model_dir: Path) -> Path | None:
    """Find the folder of images that a map was built from, in its folder or its report; None if there is none."""
    named = _reported(model_dir, "photographs", "images")
    for folder in (model_dir / "images", *([Path(named)] if named is not None else [])):
        if folder.is_dir():
            return folder
    return None


def _reported(model_dir: Path, group: str, name: str) -> str | None:
    """A path among the settings in a map's report; None if there is none."""
    try:
        found = read_json_object(model_dir / REPORT_FILE)["config"][group][name]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return found if isinstance(found, str) and found else None
