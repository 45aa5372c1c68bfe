"""Locate the database and images that a map was built from."""

from __future__ import annotations

from pathlib import Path

from wheretolook.mapping.feature_files import HDF5_SUFFIXES
from wheretolook.mapping.georeference import REPORT_FILE
from wheretolook.mapping.map_folder import DATABASE_FILE
from wheretolook.utils.reading import read_json_object


def find_features(model_dir: Path) -> Path | None:
    """Find the file of features of a map, in its folder, COLMAP's usual folders or its report; None if there is none."""
    folders = (model_dir, model_dir.parent / "photographs", model_dir.parent, model_dir.parent.parent)
    databases = [folder / DATABASE_FILE for folder in folders if (folder / DATABASE_FILE).is_file()]
    hdf5 = [path for suffix in HDF5_SUFFIXES for path in model_dir.glob(f"*{suffix}")]
    reported = _reported(model_dir, "existing", "database")
    if databases or len(hdf5) == 1:
        return (databases + hdf5)[0]
    return reported if reported is not None and reported.is_file() else None


def find_photographs(model_dir: Path) -> Path | None:
    """Find the folder of images that a map was built from, in its folder or its report; None if there is none."""
    folders = (model_dir / "images", _reported(model_dir, "photographs", "images"))
    return next((folder for folder in folders if folder is not None and folder.is_dir()), None)


def _reported(model_dir: Path, group: str, name: str) -> Path | None:
    """A path among the settings in a map's report; None if there is none."""
    try:
        return Path(read_json_object(model_dir / REPORT_FILE)["config"][group][name])
    except (OSError, ValueError, KeyError, TypeError):
        return None
