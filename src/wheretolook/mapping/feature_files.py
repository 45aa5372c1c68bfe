"""Read keypoints and descriptors of a model's images from a COLMAP database of any version, or hloc's HDF5 files."""

from __future__ import annotations

import re
import sqlite3
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wheretolook.features.descriptors import DescriptorKind, Stored, unit_descriptors
from wheretolook.features.registry import all_kinds
from wheretolook.features.sift import SIFT
from wheretolook.mapping.colmap_model import ModelArrays
from wheretolook.utils.errors import MapError, MapWarning
from wheretolook.utils.reading import check_file, max_expanded_bytes

HDF5_SUFFIXES = (".h5", ".hdf5")
_KIND_TABLE = "wheretolook_features"  # of a database: the name of the kind of its descriptors
_TABLES = ("images", "keypoints", "descriptors", _KIND_TABLE)
_MAX_VALUE = np.float32(1e15)  # no pixel and no number of a descriptor comes near
_FIX = "Give the file of features that the model was built from, or none."


class _Features(NamedTuple):
    """Keypoints of an image, with descriptors if they are of a known kind."""

    keypoints: NDArray[np.float64]  # (K, 2) pixels
    descriptors: NDArray[Any] | None  # (K, D) as `DescriptorKind.store` gives them
    kind: DescriptorKind | None


def read_descriptors(
    features: str | Path, model_dir: str | Path, reconstruction: Any, model: ModelArrays
) -> tuple[DescriptorKind, NDArray[Any]] | None:
    """Read the descriptors (O, D) of the observations of a model, stored as their kind says, and that kind.

    They come from the file of features that the model was built from: a COLMAP database (`database.db` of version 3 or
    4; it is not written to), or hloc's features in HDF5 (`feats-*.h5`). Images are identified by their names. Their
    kind is stated by the database or by the file's name (`feats-disk.h5`); otherwise the number of columns decides:
    64 for XFeat, 256 for SuperPoint, 128 without negatives for SIFT. Returns None, with a `MapWarning`, if the file
    holds no descriptors, or none of a kind in `wheretolook.features.registry`.

    Raises MapError if the file is missing, unreadable, or not the one the model was built from, its descriptors are not
    all of one kind, or h5py is missing.
    """
    path = Path(features)
    order = np.argsort(model.observation_image, kind="stable")
    ends = np.searchsorted(model.observation_image[order], np.arange(len(model.image_ids) + 1))
    result: NDArray[Any] | None = None
    kind = None
    without: list[str] = []
    with _open(path) as read:
        for row, (image_id, name) in enumerate(zip(model.image_ids, model.image_names, strict=True)):
            found = read(name)
            _check_keypoints(found, reconstruction.images[int(image_id)], path)
            rows = order[ends[row] : ends[row + 1]]
            if not len(rows):
                continue
            if found.descriptors is None or found.kind is None:
                without.append(name)
                continue
            kind = _same_kind(kind, found.kind, path, name)
            if result is None:
                result = np.empty((len(order), kind.dimension), dtype=kind.stored_as)
            result[rows] = found.descriptors[model.observation_keypoint[rows]]
    if kind is None or result is None:
        text = (
            f"{path} holds no descriptors of a known kind ({', '.join(all_kinds())}), so the ambiguity of landmarks is "
            "unknown; scores do without it"
        )
        if path.suffix.lower() in HDF5_SUFFIXES and _kind_in_name(path) is None:
            text += ". If they are of one of these kinds, name it in the file's name: feats-aliked.h5"
        warnings.warn(text, MapWarning, stacklevel=2)
        return None
    if without:
        problem = f"{len(without)} images have no {kind.name} descriptors in this file"
        raise MapError(problem, path=path, value=without[0], fix=_FIX)
    return kind, result


def read_features(features: str | Path, names: Sequence[str]) -> tuple[DescriptorKind, list[Stored]]:
    """Read keypoints and descriptors of images by their names, from a file of features as `read_descriptors` does.

    Raises MapError if the file is missing or unreadable, lacks an image, or one of them has no descriptors of a known
    kind.
    """
    path = Path(features)
    kind = None
    results = []
    with _open(path) as read:
        for name in names:
            found = read(name)
            if found.descriptors is None and len(found.keypoints):
                problem = f"this image has no descriptors of {', '.join(all_kinds())} in this file"
                raise MapError(problem, path=path, value=name, fix=_suggest_hdf5(path))
            if found.kind is not None:
                kind = _same_kind(kind, found.kind, path, name)
            results.append((found.keypoints.astype(np.float32), found.descriptors))
    kind = kind or SIFT
    return kind, [(pixels, kind.none() if descriptors is None else descriptors) for pixels, descriptors in results]


def name_kind(database: Path, kind: DescriptorKind) -> None:
    """Write the kind of descriptors into a COLMAP database, which has types for few of them and ignores the entry."""
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.execute(f"CREATE TABLE IF NOT EXISTS {_KIND_TABLE} (name TEXT)")
        connection.execute(f"DELETE FROM {_KIND_TABLE}")
        connection.execute(f"INSERT INTO {_KIND_TABLE} VALUES (?)", (kind.name,))


def _check_keypoints(found: _Features, image: Any, path: Path) -> None:
    """Raise MapError unless the features of an image are those of the model: by number, first and last keypoint."""
    n = image.num_points2D()
    if len(found.keypoints) != n or (found.descriptors is not None and len(found.descriptors) != n):
        problem = f"the file and the model disagree on the number of keypoints of {image.name}"
        raise MapError(problem, path=path, value=(len(found.keypoints), n), fix=_FIX)
    if n:
        ends = found.keypoints[[0, -1]]
        expected = np.array([image.points2D[0].xy, image.points2D[-1].xy])
        if not (np.abs(ends - expected) <= _tolerance_px(ends, path)).all():
            raise MapError("the file holds other keypoints than the model", path=path, value=image.name, fix=_FIX)


def _suggest_hdf5(database: Path) -> str | None:
    """What to give instead of a database without descriptors, as hloc writes it."""
    if database.suffix.lower() in HDF5_SUFFIXES:
        return None
    folders = (database.parent, database.parent.parent)
    files = [path for folder in folders for suffix in HDF5_SUFFIXES for path in sorted(folder.glob(f"feats-*{suffix}"))]
    named = next((path for path in files if "matches" not in path.name), "feats-*.h5")
    return f"hloc keeps them in HDF5: --database {named}."


def _same_kind(kind: DescriptorKind | None, of_image: DescriptorKind, path: Path, name: str) -> DescriptorKind:
    """The kind of an image's descriptors. Raises MapError if that of previous images differs."""
    if kind is not None and kind is not of_image:
        problem = f"descriptors of {name} are of another kind than those before it"
        value = (of_image.name, kind.name)
        raise MapError(problem, path=path, value=value, fix="Give features of one extractor.")
    return of_image


def _tolerance_px(keypoints: NDArray[np.float64], path: Path) -> NDArray[np.float64]:
    """Tolerance between keypoints of a file of features and of the model that was built from it.

    hloc keeps them in half precision, and adds half a pixel in it, which from 1024 pixels on moves them by as much.
    """
    if path.suffix.lower() not in HDF5_SUFFIXES:
        return np.full(keypoints.shape, 0.01)
    return 0.01 + np.spacing(np.clip(np.abs(keypoints), 0, 2.0**15).astype(np.float16)).astype(np.float64) / 2


def _open(path: Path) -> AbstractContextManager[Callable[[str], _Features]]:
    """Open a file of features; yields a function that reads those of an image by its name."""
    if not path.is_file():
        raise MapError("there is no such database", path=path, fix=_FIX)
    return (_open_hdf5 if path.suffix.lower() in HDF5_SUFFIXES else _open_database)(path)


def _kind_in_name(path: Path) -> DescriptorKind | None:
    """The kind of descriptors that a file is named after, as hloc names it."""
    words = re.split(r"[^a-z0-9]+", path.stem.lower())
    kinds = (kind for name, kind in all_kinds().items() if any(word.startswith(name) for word in words))
    return next(kinds, None)


def _kind_by_columns(named: DescriptorKind | None, columns: int, path: Path) -> DescriptorKind | None:
    """The kind of learned descriptors: the named one, or the only one of this dimension."""
    if named is not None and named.dimension != columns:
        problem = f"descriptors of {named.name} have {named.dimension} numbers"
        fix = "Name the file after its content, as hloc does: feats-disk.h5, feats-superpoint.h5."
        raise MapError(problem, path=path, value=columns, fix=fix)
    if named is not None and not named.in_bytes:
        return named
    kinds = [kind for kind in all_kinds().values() if not kind.in_bytes and kind.dimension == columns]
    return kinds[0] if len(kinds) == 1 else None


@contextmanager
def _open_database(path: Path) -> Iterator[Callable[[str], _Features]]:
    """Open a COLMAP database with SQLite: pycolmap would convert an old one to its own version."""
    # Without a writer's journal SQLite must not make one, which is impossible in a read-only folder.
    mode = "mode=ro" if path.with_name(path.name + "-wal").exists() else "immutable=1"
    try:
        check_file(path)
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?{mode}", uri=True)) as database:
            _check_tables(database)
            ids: dict[str, int] = dict(database.execute("SELECT name, image_id FROM images"))
            named = _kind_in_table(database) or _kind_in_name(path)
            has_type = any(row[1] == "type" for row in database.execute("PRAGMA table_info(descriptors)"))
            query = f"SELECT rows, cols, data, {'type' if has_type else 0} FROM descriptors WHERE image_id = ?"

            def read(name: str) -> _Features:
                if name not in ids:
                    raise MapError("the database lacks an image of the model", path=path, value=name, fix=_FIX)
                key = (ids[name],)
                row = database.execute("SELECT rows, cols, data FROM keypoints WHERE image_id = ?", key).fetchone()
                n, columns, data = row or (0, 2, b"")
                keypoints = np.frombuffer(data or b"", dtype="<f4").reshape(n, columns if n else 2)[:, :2]
                keypoints = _checked(keypoints.astype(np.float64), name)
                n, columns, data, colmap_type = database.execute(query, key).fetchone() or (0, 0, b"", 0)
                kind = _kind_in_database(colmap_type, columns, named, path)
                if kind is None or (n == 0 and len(keypoints)):
                    return _Features(keypoints, None, None)
                values = np.frombuffer(data or b"", dtype=np.uint8).reshape(n, columns)
                if not kind.in_bytes:
                    values = kind.store(unit_descriptors(_checked(values.view("<f4"), name)))
                return _Features(keypoints, values, kind)

            yield read
    except (sqlite3.Error, ValueError, TypeError) as error:
        raise MapError(f"cannot read the database: {error}", path=path, fix=_FIX) from error


def _check_tables(database: sqlite3.Connection) -> None:
    """Raise ValueError if a table is a view or has computed columns, which can produce data without end."""
    for schema, name, kind, *_ in database.execute("PRAGMA table_list").fetchall():
        if schema == "main" and str(name).lower() in _TABLES:
            columns = database.execute(f'PRAGMA table_xinfo("{name}")').fetchall()
            if kind != "table" or any(column[-1] for column in columns):
                raise ValueError(f"{name} is not a plain table")


def _kind_in_table(database: sqlite3.Connection) -> DescriptorKind | None:
    """The kind that `name_kind` wrote, if it did."""
    if not database.execute("SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = ?", (_KIND_TABLE,)).fetchone():
        return None
    row = database.execute(f"SELECT name FROM {_KIND_TABLE}").fetchone()
    return all_kinds().get(str(row[0])) if row else None


def _kind_in_database(
    colmap_type: int, columns: int, named: DescriptorKind | None, path: Path
) -> DescriptorKind | None:
    """The kind of descriptors of so many bytes, from COLMAP's number of their type; -1 if it has none."""
    if colmap_type == -1 and columns == SIFT.columns:
        return SIFT
    if colmap_type == -1:
        return _kind_by_columns(named, columns // 4, path) if columns and columns % 4 == 0 else None
    kind = next((kind for kind in all_kinds().values() if kind.colmap_type == colmap_type), None)
    if kind is not None and not kind.in_bytes and columns not in (0, kind.columns):
        problem = f"descriptors of {kind.name} take {kind.columns} bytes each"
        raise MapError(problem, path=path, value=columns, fix="Extract features again, or give no database.")
    return kind if kind is not None and kind.columns == columns else None


@contextmanager
def _open_hdf5(path: Path) -> Iterator[Callable[[str], _Features]]:
    """Open hloc's features in HDF5: `keypoints` (K, 2) and `descriptors` (D, K) of each image."""
    try:
        import h5py
    except ImportError as error:
        fix = "pip install 'wheretolook[hloc]', or omit the features."
        raise MapError("features in HDF5 are read with h5py, which is not installed", path=path, fix=fix) from error
    try:
        check_file(path)
        with h5py.File(path, "r") as file:
            if file.visititems_links(lambda name, link: isinstance(link, h5py.ExternalLink) or None):
                raise ValueError("it has a link to another file")
            named = _kind_in_name(path)

            def read(name: str) -> _Features:
                if name not in file:
                    raise MapError("the features lack an image of the model", path=path, value=name, fix=_FIX)
                # hloc counts pixels from the centre of the top-left one, COLMAP from its corner
                keypoints = _array(file[name]["keypoints"], name).astype(np.float64)[:, :2] + 0.5
                descriptors = _array(file[name]["descriptors"], name).T
                may_be_sift = descriptors.shape[1] == SIFT.dimension and named in (None, SIFT)
                if may_be_sift and not (len(descriptors) and descriptors.min() < 0):
                    kind: DescriptorKind | None = SIFT
                else:
                    kind = _kind_by_columns(named, descriptors.shape[1], path)
                stored = None if kind is None else kind.store(unit_descriptors(descriptors))
                return _Features(keypoints, stored, kind)

            yield read
    except MapError:
        raise
    except Exception as error:  # h5py raises errors of many kinds
        raise MapError(f"cannot read the features: {error}", path=path, fix="Give hloc's feats-*.h5.") from error


def _array(dataset: Any, name: str) -> NDArray[Any]:
    """An array of an image in HDF5. Raises ValueError if its data are in another file, or far larger than stored."""
    import h5py

    if not isinstance(dataset, h5py.Dataset) or dataset.shape is None or dataset.is_virtual or dataset.external:
        raise ValueError(f"{name} has no array of keypoints or descriptors in this file")
    chunk = int(np.prod(dataset.chunks or (0,), dtype=float))
    n_bytes = max(dataset.size, chunk) * dataset.dtype.itemsize
    if n_bytes > max_expanded_bytes(dataset.id.get_storage_size()):
        raise ValueError(f"the keypoints or descriptors of {name} would unfold to {n_bytes:,} bytes")
    return _checked(dataset[()], name)


def _checked(values: NDArray[Any], name: str) -> NDArray[Any]:
    """Numbers (K, N) of an image. Raises ValueError if they are not finite, or far larger than any extractor's."""
    if values.ndim != 2 or values.dtype.kind not in "fiu" or not (np.abs(values) < _MAX_VALUE).all():
        raise ValueError(f"the keypoints or descriptors of {name} are not finite numbers")
    return values
