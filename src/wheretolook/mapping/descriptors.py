"""Reads the descriptors of a model's keypoints: from a COLMAP database of any version, or hloc's HDF5 features."""

from __future__ import annotations

import sqlite3
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.features.keypoints import quantize_descriptors, unit_descriptors
from wheretolook.mapping.colmap_model import ModelArrays
from wheretolook.utils.errors import MapError, MapWarning

HDF5_SUFFIXES = (".h5", ".hdf5")
_SIFT = 128  # numbers in a descriptor
_SIFT_TYPES = (-1, 0)  # in a database of COLMAP 4: not said, or SIFT
# An image's keypoints (K, 2) in pixels, and its descriptors (K, 128) uint8; None where it has none that are SIFT.
_Features = tuple[NDArray[np.float64], NDArray[np.uint8] | None]

Stored = tuple[NDArray[np.float32], NDArray[np.uint8]]  # pixels (K, 2) and descriptors (K, 128) of an image


def read_descriptors(
    features: str | Path, model_dir: str | Path, reconstruction: Any, model: ModelArrays
) -> NDArray[np.uint8] | None:
    """Descriptors (O, 128) uint8 of the observations of a model, from the file of features that it was built from.

    That is a COLMAP database (`database.db` of version 3 or 4; it is not written to), or hloc's features in HDF5
    (`feats-*.h5`). Images are found by their names. None, with a `MapWarning`, if the file holds no SIFT descriptors:
    other kinds tell nothing that scorers have learnt from.

    Raises MapError if the file is missing, unreadable, or not the one the model was built from, or h5py is missing.
    """
    path = Path(features)
    if not path.is_file():
        fix = "Give the database.db the model was built from, or none."
        raise MapError("there is no such database", path=path, fix=fix)
    mismatch = f"Give the database that {model_dir} was built from, or none."
    order = np.argsort(model.observation_image, kind="stable")
    ends = np.searchsorted(model.observation_image[order], np.arange(len(model.image_ids) + 1))
    found, without = np.empty((len(order), _SIFT), dtype=np.uint8), []
    with (_hdf5 if path.suffix.lower() in HDF5_SUFFIXES else _database)(path, mismatch) as read:
        for row, (image_id, name) in enumerate(zip(model.image_ids, model.image_names, strict=True)):
            keypoints, descriptors = read(name)
            image = reconstruction.images[int(image_id)]
            number = image.num_points2D()
            if len(keypoints) != number or (descriptors is not None and len(descriptors) != number):
                problem = f"the database and the model disagree on the number of keypoints of {name}"
                raise MapError(problem, path=path, value=(len(keypoints), number), fix=mismatch)
            of_model = [image.points2D[0].xy, image.points2D[-1].xy] if number else []
            if number and np.abs(keypoints[[0, -1]] - of_model).max() > 0.01:
                problem = "the database holds other keypoints than the model"
                raise MapError(problem, path=path, value=name, fix=mismatch)
            rows = order[ends[row] : ends[row + 1]]
            if descriptors is not None:
                found[rows] = descriptors[model.observation_keypoint[rows]]
            elif len(rows):
                without.append(name)
    n_observing = int((np.diff(ends) > 0).sum())
    if without and len(without) < n_observing:
        problem = f"{len(without)} of {n_observing} images have no SIFT descriptors in the database"
        raise MapError(problem, path=path, value=without[0], fix=mismatch)
    if without:
        text = (
            f"{path} holds no SIFT descriptors, so how easily landmarks are mistaken for one another (their ambiguity) "
        )
        text += "is unknown; scores do without it"
        warnings.warn(text, MapWarning, stacklevel=2)
        return None
    return found


def read_features(features: str | Path, names: Sequence[str]) -> list[Stored]:
    """Keypoints and descriptors of images by their names, from a file of features as `read_descriptors` reads.

    Raises MapError if the file is missing or unreadable, lacks an image, or one of them has no SIFT descriptors.
    """
    path, found = Path(features), []
    if not path.is_file():
        raise MapError("there is no such database", path=path, fix="Give the database.db the model was built from.")
    mismatch = "Give the database that the model was built from."
    with (_hdf5 if path.suffix.lower() in HDF5_SUFFIXES else _database)(path, mismatch) as read:
        for name in names:
            keypoints, descriptors = read(name)
            if descriptors is None and len(keypoints):
                raise MapError("this image has no SIFT descriptors in the database", path=path, value=name)
            if descriptors is None:
                descriptors = np.zeros((0, _SIFT), dtype=np.uint8)
            found.append((keypoints.astype(np.float32), descriptors))
    return found


@contextmanager
def _database(path: Path, mismatch: str) -> Iterator[Callable[[str], _Features]]:
    """Reads features by the image's name from a COLMAP database. Not by pycolmap, which would bring an old one up to
    its own version."""
    fix = "Give a whole database.db of COLMAP, or none."
    # Where no writer has left a journal, SQLite need not make one, which it could not in a folder that is read only.
    mode = "mode=ro" if path.with_name(path.name + "-wal").exists() else "immutable=1"
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?{mode}", uri=True)) as database:
            ids: dict[str, int] = dict(database.execute("SELECT name, image_id FROM images"))
            has_type = any(row[1] == "type" for row in database.execute("PRAGMA table_info(descriptors)"))
            query = f"SELECT rows, cols, data, {'type' if has_type else 0} FROM descriptors WHERE image_id = ?"

            def read(name: str) -> _Features:
                if name not in ids:
                    raise MapError("the database lacks an image of the model", path=path, value=name, fix=mismatch)
                of_image = (ids[name],)
                row = database.execute("SELECT rows, cols, data FROM keypoints WHERE image_id = ?", of_image).fetchone()
                n, columns, data = row or (0, 2, b"")
                keypoints = np.frombuffer(data or b"", dtype="<f4").reshape(n, columns)[:, :2].astype(np.float64)
                n, columns, data, kind = database.execute(query, of_image).fetchone() or (0, 0, b"", 0)
                if columns != _SIFT or kind not in _SIFT_TYPES or (n == 0 and len(keypoints)):
                    return keypoints, None
                return keypoints, np.frombuffer(data or b"", dtype=np.uint8).reshape(n, columns)

            yield read
    except (sqlite3.Error, ValueError, TypeError) as error:
        raise MapError(f"cannot read the database: {error}", path=path, fix=fix) from error


@contextmanager
def _hdf5(path: Path, mismatch: str) -> Iterator[Callable[[str], _Features]]:
    """Reads features by the image's name from hloc's HDF5: `keypoints` (K, 2) and `descriptors` (D, K)."""
    try:
        import h5py
    except ImportError as error:
        fix = "pip install h5py, or leave the features out."
        raise MapError("features in HDF5 are read with h5py, which is not installed", path=path, fix=fix) from error
    try:
        with h5py.File(path, "r") as file:

            def read(name: str) -> _Features:
                if name not in file:
                    raise MapError("the features lack an image of the model", path=path, value=name, fix=mismatch)
                # hloc counts pixels from the centre of the top-left one, COLMAP from its corner
                keypoints = file[name]["keypoints"][()].astype(np.float64)[:, :2] + 0.5
                descriptors = file[name]["descriptors"][()].T
                if descriptors.shape[1] != _SIFT or (len(descriptors) and descriptors.min() < 0):
                    return keypoints, None
                return keypoints, quantize_descriptors(unit_descriptors(descriptors))

            yield read
    except MapError:
        raise
    except Exception as error:  # h5py raises errors of many kinds
        raise MapError(
            f"cannot read the features: {error}", path=path, fix="Give hloc's feats-*.h5, or none."
        ) from error
