"""Reads the descriptors of a model's keypoints: from a COLMAP database of any version, or hloc's HDF5 features."""

from __future__ import annotations

import itertools
import re
import sqlite3
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.features.descriptors import DescriptorKind, Stored, unit_descriptors
from wheretolook.features.registry import all_kinds
from wheretolook.features.sift import SIFT
from wheretolook.mapping.colmap_model import ModelArrays
from wheretolook.utils.errors import MapError, MapWarning
from wheretolook.utils.reading import check_file, max_expanded_bytes

HDF5_SUFFIXES = (".h5", ".hdf5")
_TABLE = "wheretolook_features"  # of a database: the name of the kind of its descriptors
_TABLES = ("images", "keypoints", "descriptors", _TABLE)  # that are read
_LEAST_ROW = 4  # bytes that a row takes at least
_STEPS = 10_000  # of SQLite's machine, between two looks at how many there were
_FREE_STEPS = 20_000_000  # that a database may take, and for each of its bytes; a row takes some 10
_STEPS_OF_BYTE = 10
_MOST = np.float32(1e15)  # what no pixel and no number of a descriptor comes near
# An image's keypoints (K, 2) in pixels, its descriptors (K, D) as `DescriptorKind.store` gives them, and their kind;
# None where it has none, or of a kind that is not known.
_Features = tuple[NDArray[np.float64], NDArray[Any] | None, DescriptorKind | None]


def read_descriptors(
    features: str | Path, model_dir: str | Path, reconstruction: Any, model: ModelArrays
) -> tuple[DescriptorKind, NDArray[Any]] | None:
    """Descriptors (O, D) of the observations of a model, stored as their kind says, and that kind.

    They come from the file of features that the model was built from: a COLMAP database (`database.db` of version 3 or
    4; it is not written to), or hloc's features in HDF5 (`feats-*.h5`). Images are found by their names. What kind they
    are the database says, or the file's name (`feats-disk.h5`), or where these say nothing how many numbers there are:
    64 for XFeat, 256 for SuperPoint, 128 without negatives for SIFT. None, with a `MapWarning`, if the file holds no
    descriptors, or none of a kind in `wheretolook.features.registry`.

    Raises MapError if the file is missing, unreadable, or not the one the model was built from, its descriptors are not
    all of one kind, or h5py is missing.
    """
    path = Path(features)
    if not path.is_file():
        fix = "Give the database.db the model was built from, or none."
        raise MapError("there is no such database", path=path, fix=fix)
    mismatch = f"Give the database that {model_dir} was built from, or none."
    order = np.argsort(model.observation_image, kind="stable")
    ends = np.searchsorted(model.observation_image[order], np.arange(len(model.image_ids) + 1))
    found: NDArray[Any] | None = None
    kind = None
    without = []
    with _reader(path, mismatch) as read:
        for row, (image_id, name) in enumerate(zip(model.image_ids, model.image_names, strict=True)):
            keypoints, descriptors, its_kind = read(name)
            image = reconstruction.images[int(image_id)]
            number = image.num_points2D()
            if len(keypoints) != number or (descriptors is not None and len(descriptors) != number):
                problem = f"the database and the model disagree on the number of keypoints of {name}"
                raise MapError(problem, path=path, value=(len(keypoints), number), fix=mismatch)
            of_model = [image.points2D[0].xy, image.points2D[-1].xy] if number else []
            if number and (np.abs(keypoints[[0, -1]] - of_model) > _tolerance_px(keypoints[[0, -1]], path)).any():
                problem = "the database holds other keypoints than the model"
                raise MapError(problem, path=path, value=name, fix=mismatch)
            rows = order[ends[row] : ends[row + 1]]
            if descriptors is not None and its_kind is not None and len(rows):
                kind = _same(kind, its_kind, path, name)
                if found is None:
                    found = np.empty((len(order), kind.dimension), dtype=kind.stored_as)
                found[rows] = descriptors[model.observation_keypoint[rows]]
            elif len(rows):
                without.append(name)
    n_observing = int((np.diff(ends) > 0).sum())
    if without and len(without) < n_observing:
        what = "SIFT" if kind in (None, SIFT) else f"{kind.name}"
        problem = f"{len(without)} of {n_observing} images have no {what} descriptors in the database"
        raise MapError(problem, path=path, value=without[0], fix=mismatch)
    if kind is None or found is None:
        text = (
            f"{path} holds no descriptors of a kind that is known ({', '.join(all_kinds())}), so how easily landmarks "
            "are mistaken for one another (their ambiguity) is unknown; scores do without it"
        )
        if path.suffix.lower() in HDF5_SUFFIXES and _kind_in_name(path) is None:
            text += ". If they are of one of these, say so in the file's name: feats-aliked.h5"
        warnings.warn(text, MapWarning, stacklevel=2)
        return None
    return kind, found


def read_features(features: str | Path, names: Sequence[str]) -> tuple[DescriptorKind, list[Stored]]:
    """Keypoints and descriptors of images by their names, from a file of features as `read_descriptors` reads.

    Raises MapError if the file is missing or unreadable, lacks an image, or one of them has no descriptors of a kind
    that is known.
    """
    path = Path(features)
    found = []
    if not path.is_file():
        raise MapError("there is no such database", path=path, fix="Give the database.db the model was built from.")
    mismatch = "Give the database that the model was built from."
    kind = None
    with _reader(path, mismatch) as read:
        for name in names:
            keypoints, descriptors, its_kind = read(name)
            if descriptors is None and len(keypoints):
                known = ", ".join(all_kinds())
                fix = _fix_by_hdf5(path)
                problem = f"this image has no descriptors of {known} in the database"
                raise MapError(problem, path=path, value=name, fix=fix)
            if its_kind is not None:
                kind = _same(kind, its_kind, path, name)
            found.append((keypoints.astype(np.float32), descriptors))
    kind = kind or SIFT
    return kind, [(pixels, kind.none() if descriptors is None else descriptors) for pixels, descriptors in found]


def _fix_by_hdf5(database: Path) -> str | None:
    """What to give instead of a database without descriptors, as hloc leaves one: its own features, by their name."""
    if database.suffix.lower() in HDF5_SUFFIXES:
        return None
    places = database.parent, database.parent.parent
    found = [path for place in places for suffix in HDF5_SUFFIXES for path in sorted(place.glob(f"feats-*{suffix}"))]
    named = next((path for path in found if "matches" not in path.name), "feats-*.h5")
    return f"hloc keeps them in HDF5: --database {named}."


def _same(kind: DescriptorKind | None, of_image: DescriptorKind, path: Path, name: str) -> DescriptorKind:
    """The kind that descriptors before an image's, and its own, are of. MapError if they are of two."""
    if kind not in (None, of_image):
        problem = f"the descriptors of {name} are of another kind, {of_image.name}, than those before, {kind.name}"  # type: ignore[union-attr]
        raise MapError(problem, path=path, fix="Give features of one extractor.")
    return of_image


def _tolerance_px(keypoints: NDArray[np.float64], path: Path) -> NDArray[np.float64]:
    """How far keypoints of a file of features may be from those of the model that was built from it.

    hloc keeps them in half precision, and adds half a pixel in it, which from 1024 pixels on moves them by as much.
    """
    if path.suffix.lower() not in HDF5_SUFFIXES:
        return np.full(keypoints.shape, 0.01)
    return 0.01 + np.spacing(np.clip(np.abs(keypoints), 0, 2.0**15).astype(np.float16)).astype(np.float64) / 2


def _reader(path: Path, mismatch: str) -> Any:
    return (_hdf5 if path.suffix.lower() in HDF5_SUFFIXES else _database)(path, mismatch)


def name_kind(database: Path, kind: DescriptorKind) -> None:
    """Write into a COLMAP database what its descriptors are: COLMAP's own types know but a few. It reads it as ever."""
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.execute(f"CREATE TABLE IF NOT EXISTS {_TABLE} (name TEXT)")
        connection.execute(f"DELETE FROM {_TABLE}")
        connection.execute(f"INSERT INTO {_TABLE} VALUES (?)", (kind.name,))


def _kind_in_name(path: Path) -> DescriptorKind | None:
    """The kind that a file of features is of by its name, as hloc gives it."""
    words = re.split(r"[^a-z0-9]+", path.stem.lower())
    kinds = (kind for name, kind in all_kinds().items() if any(word.startswith(name) for word in words))
    return next(kinds, None)


def _kind_written(database: sqlite3.Connection) -> DescriptorKind | None:
    """What `name_kind` wrote; None if it did not."""
    if not database.execute("SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = ?", (_TABLE,)).fetchone():
        return None
    row = database.execute(f"SELECT name FROM {_TABLE}").fetchone()
    return all_kinds().get(str(row[0])) if row else None


def _fitting(named: DescriptorKind | None, numbers: int, path: Path) -> DescriptorKind | None:
    """The kind of learned descriptors of so many numbers: the one named, or else the only one that has as many."""
    if named is not None and named.dimension != numbers:
        problem = f"descriptors of {named.name} have {named.dimension} numbers"
        fix = "Name the file by what is in it, as hloc does: feats-disk.h5, feats-superpoint.h5."
        raise MapError(problem, path=path, value=numbers, fix=fix)
    if named is not None and not named.in_bytes:
        return named
    kinds = [kind for kind in all_kinds().values() if not kind.in_bytes and kind.dimension == numbers]
    return kinds[0] if len(kinds) == 1 else None


@contextmanager
def _database(path: Path, mismatch: str) -> Iterator[Callable[[str], _Features]]:
    """Reads features by the image's name from a COLMAP database. Not by pycolmap, which would bring an old one up to
    its own version."""
    fix = "Give a whole database.db of COLMAP, or none."
    # Where no writer has left a journal, SQLite need not make one, which it could not in a folder that is read only.
    mode = "mode=ro" if path.with_name(path.name + "-wal").exists() else "immutable=1"
    try:
        n_bytes = check_file(path).st_size
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?{mode}", uri=True)) as database:
            _limit(database, n_bytes)
            found = database.execute("SELECT name, image_id FROM images LIMIT ?", (n_bytes // _LEAST_ROW,))
            ids: dict[str, int] = dict(found)
            named = _kind_written(database) or _kind_in_name(path)
            has_type = any(row[1] == "type" for row in database.execute("PRAGMA table_info(descriptors)"))
            query = f"SELECT rows, cols, data, {'type' if has_type else 0} FROM descriptors WHERE image_id = ?"

            def read(name: str) -> _Features:
                if name not in ids:
                    raise MapError("the database lacks an image of the model", path=path, value=name, fix=mismatch)
                of_image = (ids[name],)
                row = database.execute("SELECT rows, cols, data FROM keypoints WHERE image_id = ?", of_image).fetchone()
                n, columns, data = row or (0, 2, b"")
                keypoints = np.frombuffer(data or b"", dtype="<f4").reshape(n, columns if n else 2)[:, :2]
                keypoints = _checked(keypoints.astype(np.float64), name)
                n, columns, data, kind = database.execute(query, of_image).fetchone() or (0, 0, b"", 0)
                its_kind = _kind_in_database(kind, columns, named, path)
                if its_kind is None or (n == 0 and len(keypoints)):
                    return keypoints, None, None
                values = np.frombuffer(data or b"", dtype=np.uint8).reshape(n, columns)
                if not its_kind.in_bytes:
                    values = its_kind.store(unit_descriptors(_checked(values.view("<f4"), name)))
                return keypoints, values, its_kind

            yield read
    except (sqlite3.Error, ValueError, TypeError) as error:
        raise MapError(f"cannot read the database: {error}", path=path, fix=fix) from error


def _limit(database: sqlite3.Connection, n_bytes: int) -> None:
    """Let a database of so many bytes hold no more than that, nor keep us for ever.

    ValueError if what is read is no plain table: a view or a computed column makes gigabytes of nothing, or rows
    without end.
    """
    steps = itertools.count()
    database.set_progress_handler(lambda: next(steps) * _STEPS > _FREE_STEPS + _STEPS_OF_BYTE * n_bytes, _STEPS)
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(n_bytes, 1_000_000))
    for schema, name, kind, *_ in database.execute("PRAGMA table_list").fetchall():
        if schema != "main" or str(name).lower() not in _TABLES:
            continue
        if kind != "table":
            raise ValueError(f"{name} is a {kind}, no table")
        if any(column[-1] for column in database.execute(f'PRAGMA table_xinfo("{name}")')):
            raise ValueError(f"{name} has computed columns")


def _checked(values: NDArray[Any], name: str) -> NDArray[Any]:
    """Numbers (K, N) of an image. ValueError if they are none that an extractor gives."""
    if values.ndim != 2 or values.dtype.kind not in "fiu" or not (np.abs(values) < _MOST).all():
        raise ValueError(f"the keypoints or descriptors of {name} are no finite numbers")
    return values


def _kind_in_database(
    colmap_type: int, columns: int, named: DescriptorKind | None, path: Path
) -> DescriptorKind | None:
    """The kind of descriptors that take so many bytes each, by what a database says of them, -1 for nothing."""
    if colmap_type == -1 and columns == SIFT.columns:
        return SIFT
    if colmap_type == -1:
        return _fitting(named, columns // 4, path) if columns and columns % 4 == 0 else None
    said = next((kind for kind in all_kinds().values() if kind.colmap_type == colmap_type), None)
    if said is not None and not said.in_bytes and columns not in (0, said.columns):
        problem = f"descriptors of {said.name} take {said.columns} bytes each"
        raise MapError(problem, path=path, value=columns, fix="Extract features again, or give no database.")
    return said if said is not None and said.columns == columns else None


@contextmanager
def _hdf5(path: Path, mismatch: str) -> Iterator[Callable[[str], _Features]]:
    """Reads features by the image's name from hloc's HDF5: `keypoints` (K, 2) and `descriptors` (D, K)."""
    try:
        import h5py
    except ImportError as error:
        fix = "pip install 'wheretolook[hloc]', or leave the features out."
        raise MapError("features in HDF5 are read with h5py, which is not installed", path=path, fix=fix) from error
    try:
        check_file(path)
        with h5py.File(path, "r") as file:
            elsewhere = file.visititems_links(lambda name, link: name if isinstance(link, h5py.ExternalLink) else None)
            if elsewhere is not None:
                raise ValueError(f"{elsewhere} leads to another file")
            named = _kind_in_name(path)

            def read(name: str) -> _Features:
                if name not in file:
                    raise MapError("the features lack an image of the model", path=path, value=name, fix=mismatch)
                lacking = [what for what in ("keypoints", "descriptors") if f"{name}/{what}" not in file]
                if lacking:
                    raise ValueError(f"{name} has no {' and no '.join(lacking)}")
                # hloc counts pixels from the centre of the top-left one, COLMAP from its corner
                keypoints = _stored(file[name]["keypoints"], name).astype(np.float64)[:, :2] + 0.5
                descriptors = _stored(file[name]["descriptors"], name).T
                may_be_sift = descriptors.shape[1] == SIFT.dimension and named in (None, SIFT)
                if may_be_sift and not (len(descriptors) and descriptors.min() < 0):
                    return keypoints, SIFT.store(unit_descriptors(descriptors)), SIFT
                kind = _fitting(named, descriptors.shape[1], path)
                if kind is None:
                    return keypoints, None, None
                return keypoints, kind.store(unit_descriptors(descriptors)), kind

            yield read
    except MapError:
        raise
    except Exception as error:  # h5py raises errors of many kinds
        raise MapError(
            f"cannot read the features: {error}", path=path, fix="Give hloc's feats-*.h5, or none."
        ) from error


def _stored(dataset: Any, name: str) -> NDArray[Any]:
    """An array of an image in HDF5. ValueError if it lies in another file, or unfolds to far more than is stored."""
    import h5py

    if not isinstance(dataset, h5py.Dataset) or dataset.shape is None:
        raise ValueError(f"{name} has no array of keypoints or descriptors")
    if dataset.is_virtual or dataset.external:
        raise ValueError(f"the keypoints or descriptors of {name} lie in another file")
    n_bytes = dataset.size * dataset.dtype.itemsize
    n_stored = dataset.id.get_storage_size()
    chunk = int(np.prod(dataset.chunks, dtype=float)) * dataset.dtype.itemsize if dataset.chunks else 0
    if max(n_bytes, chunk) > max_expanded_bytes(n_stored):
        raise ValueError(f"the {n_stored:,} bytes of {name} would unfold to {max(n_bytes, chunk):,}")
    return _checked(dataset[()], name)
