"""Locate the features and images that a map was built from, where COLMAP and hloc write them."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

from wheretolook.features.descriptors import DescriptorKind
from wheretolook.features.sift import SIFT
from wheretolook.mapping.colmap_model import read_model, registered_names
from wheretolook.mapping.feature_files import DATABASE_FILE, HDF5_SUFFIXES, features_kind, kind_in_name
from wheretolook.mapping.georeference import REPORT_FILE
from wheretolook.utils.confine import path_within
from wheretolook.utils.errors import ConfigError, MapError, MapWarning
from wheretolook.utils.logs import LOG
from wheretolook.utils.reading import read_json_object

_LEVELS = 4  # folders above a model that are searched: hloc's models are in outputs/sfm/models/0


def find_features(model_dir: Path, reconstruction: Any = None) -> Path | None:
    """Find the file of features of a map: hloc's HDF5, COLMAP's database, or the one in its report; None without any.

    It is in the model's folder or one above it. Of several, it is the first that describes the keypoints of the model,
    `reconstruction` if it was read before.
    """
    above = _above(model_dir)
    hdf5 = [path for suffix in HDF5_SUFFIXES for path in sorted(model_dir.glob(f"*{suffix}"))]
    hdf5 += [path for folder in above for suffix in HDF5_SUFFIXES for path in sorted(folder.glob(f"feats*{suffix}"))]
    databases = [folder / DATABASE_FILE for folder in (model_dir, model_dir.parent / "photographs", *above)]
    named = _reported(model_dir, "existing", "database")
    candidates = [path for path in hdf5 if "matches" not in path.stem] + databases + ([named] if named else [])
    found = [path for path in dict.fromkeys(candidates) if path.is_file()]
    if len(found) > 1:
        model = reconstruction or read_model(model_dir)
        found = [path for path in found if _kind_or_problem(path, model)[0]] or found
    return next(iter(found), None)


def choose_features(model_dir: Path, reconstruction: Any, given: Path | None = None) -> Path | None:
    """Choose the features that describe the landmarks of a model: `given` ones, or those next to the model.

    The ambiguity of many landmarks takes minutes, so SIFT in a COLMAP database is used only if given. Features that are
    used without being given are logged. A `MapWarning` reports features that cannot be used, and a model that seems to
    have other features than SIFT, but none that are found. A given database without descriptors, as hloc writes it,
    counts as none if others are found. Raises MapError if given features are unreadable or of another model.
    """
    if given is not None and features_kind(given, reconstruction) is not None:
        return given
    found = find_features(model_dir, reconstruction)
    kind, problem = (None, "") if found is None else _kind_or_problem(found, reconstruction)
    if found is not None and kind is not None and (kind is not SIFT or found.suffix.lower() in HDF5_SUFFIXES):
        LOG.info("features: %s (%s)", found, kind.name)
        return found
    if given is None and kind is not None:
        LOG.info("features not used: %s (%s); --database gives the ambiguity of landmarks", found, kind.name)
    if given is None and kind is None:
        named = next((name for path in (model_dir, *_above(model_dir)[:2]) if (name := kind_in_name(path))), SIFT)
        if problem or named is not SIFT:
            problem = problem or f"features of {model_dir} seem to be {named.name}, but are not found"
            text = f"{problem}; views are scored by weights for SIFT, unless --database names the features"
            warnings.warn(text, MapWarning, stacklevel=3)
    return given


def find_photographs(model_dir: Path) -> Path | None:
    """Find the folder of images that a map was built from: next to it, above it, or in its report; None without any."""
    for folder in (model_dir / "images", _reported(model_dir, "photographs", "images")):
        if folder is not None and folder.is_dir():
            return folder
    folders = [path for folder in _above(model_dir) if (path := folder / "images").is_dir()]
    names = [*registered_names(read_model(model_dir)).values()] if folders else []
    return next((folder for folder in folders if any(has_image(folder, name) for name in names)), None)


def has_image(folder: Path, name: str) -> bool:
    """Test whether a folder has an image of a model, by its name, which must not leave the folder."""
    try:
        return path_within(folder, name, "the name of an image of the model").is_file()
    except ConfigError:
        return False


def _above(model_dir: Path) -> list[Path]:
    """The folders above a model, the nearest first."""
    return [*model_dir.absolute().parents[:_LEVELS]]


def _kind_or_problem(path: Path, reconstruction: Any) -> tuple[DescriptorKind | None, str]:
    """The kind of the descriptors in a file of features of a model, or why they cannot be used."""
    try:
        kind = features_kind(path, reconstruction)
    except MapError as error:
        return None, str(error)
    return kind, "" if kind else f"{path} has no descriptors of a known kind"


def source_of_map(map_dir: Path) -> Path | None:
    """Return the model or the photographs that a scene's map was made from; None for a rendered map, or none."""
    return _reported(map_dir, "existing", "model") or _reported(map_dir, "photographs", "images")


def _reported(model_dir: Path, group: str, name: str) -> Path | None:
    """A path among the settings in a map's report; None if there is none."""
    try:
        return Path(read_json_object(model_dir / REPORT_FILE)["config"][group][name])
    except (OSError, ValueError, KeyError, TypeError):
        return None
