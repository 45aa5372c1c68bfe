"""Read keypoints and descriptors of a model's images from a COLMAP database of any version, or hloc's HDF5 files."""

from __future__ import annotations

import re
import sqlite3
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wheretolook.features.extractor import KINDS, SIFT, SUPERPOINT, XFEAT, DescriptorKind, Stored, unit_descriptors
from wheretolook.mapping.colmap_model import ModelArrays
from wheretolook.utils.errors import MapError, MapWarning
from wheretolook.utils.files import check_file, max_expanded_bytes

DATABASE_FILE = "database.db"  # COLMAP's usual name
HDF5_SUFFIXES = (".h5", ".hdf5")
_KIND_TABLE = "wheretolook_features"  # of a database: the name of the kind of its descriptors
_FIX = "Give the file of features that the model was built from, or none."


class _Features(NamedTuple):
    """Keypoints of an image, with descriptors if they are of a known kind."""

    keypoints: NDArray[np.float64]  # (K, 2) pixels
    descriptors: NDArray[Any] | None = None  # (K, D) as `DescriptorKind.store` gives them
    kind: DescriptorKind | None = None


def read_descriptors(
    features: str | Path, reconstruction: Any, model: ModelArrays
) -> tuple[DescriptorKind, NDArray[Any]] | None:
    """Read the descriptors (O, D) of the observations of a model, stored as their kind says, and that kind.

    They come from the file of features that the model was built from: a COLMAP database (`database.db` of version 3 or
    4; it is not written to), or hloc's features in HDF5 (`feats-*.h5`). Images are identified by their names. Their
    kind is stated by the database or by the file's name (`feats-disk.h5`); otherwise the number of columns decides:
    64 for XFeat, 256 for SuperPoint, 128 without negatives for SIFT. Images without observations may be missing.
    Returns None, with a `MapWarning`, if the file holds no descriptors, or none of a kind in
    `wheretolook.features.extractor`.

    Raises MapError if the file is missing, unreadable, or not the one the model was built from, its descriptors are not
    all of one kind, or h5py is missing.
    """
    path = Path(features)
    order = np.argsort(model.observation_image, kind="stable")
    rows_of_image = np.split(
        order, np.cumsum(np.bincount(model.observation_image, minlength=len(model.image_ids)))[:-1]
    )
    result: tuple[DescriptorKind, NDArray[Any]] | None = None
    without = None
    observing = np.unique(model.observation_image)  # hloc also keeps images that observe nothing, without keypoints
    for row, image in zip(observing, _read_images(path, [model.image_names[row] for row in observing]), strict=True):
        rows = rows_of_image[row]
        in_model = reconstruction.images[int(model.image_ids[row])]
        _check_keypoints(image, in_model, path)
        if image.descriptors is not None and image.kind is not None:
            if result is None:
                result = image.kind, np.empty((len(order), image.kind.dimension), dtype=image.kind.stored_as)
            result[1][rows] = image.descriptors[model.observation_keypoint[rows]]
        else:
            without = in_model.name
    if result is None:
        text = (
            f"{path} holds no descriptors of a known kind ({', '.join(KINDS)}), so the ambiguity of landmarks is "
            "unknown; scores do without it. If they are of one of these, name it in the file's name: feats-aliked.h5"
        )
        warnings.warn(text, MapWarning, stacklevel=2)
    elif without is not None:
        raise MapError(f"an image has no {result[0].name} descriptors in this file", path=path, value=without, fix=_FIX)
    return result


def features_kind(features: Path, reconstruction: Any) -> DescriptorKind | None:
    """Read the kind of the descriptors of a model in a file of features, from a few images; None if it has none known.

    Raises MapError if the file is missing, unreadable, or not the one the model was built from, or h5py is missing.
    """
    images = [image for _, image in sorted(reconstruction.images.items()) if image.num_points3D]
    images = images[:2] + images[2:][-1:]  # photographs that were added have the last ids
    kind = None
    for image, found in zip(images, _read_images(features, [image.name for image in images]), strict=True):
        _check_keypoints(found, image, features)
        kind = kind or found.kind
    return kind


def read_features(
    features: str | Path, names: Sequence[str], reconstruction: Any = None
) -> tuple[DescriptorKind, list[Stored]]:
    """Read keypoints and descriptors of images by their names, from a file of features as `read_descriptors` does.

    Raises MapError if the file is missing or unreadable, lacks an image, one of them has no descriptors of a known kind,
    or other keypoints than in a reconstruction, which has them exactly.
    """
    path = Path(features)
    images = [*_read_images(path, names)]
    kind = next((image.kind for image in images if image.kind is not None), SIFT)
    stored = []
    for name, image in zip(names, images, strict=True):
        if image.descriptors is None and len(image.keypoints):
            problem = f"this image has no descriptors of {', '.join(KINDS)} in this file"
            raise MapError(problem, path=path, value=name, fix="hloc keeps them in HDF5: --database feats-*.h5.")
        in_model = None if reconstruction is None else reconstruction.find_image_with_name(name)
        if in_model is not None and in_model.num_points2D():  # hloc's have none in images that observe nothing
            _check_keypoints(image, in_model, path)
            image = image._replace(keypoints=np.array([point.xy for point in in_model.points2D]))
        descriptors = kind.none() if image.descriptors is None else image.descriptors
        stored.append((image.keypoints.astype(np.float32), descriptors))
    return kind, stored


def name_kind(database: Path, kind: DescriptorKind) -> None:
    """Write the kind of descriptors into a COLMAP database, which has types for few of them and ignores the entry."""
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.execute(f"CREATE TABLE IF NOT EXISTS {_KIND_TABLE} (name TEXT)")
        connection.execute(f"DELETE FROM {_KIND_TABLE}")
        connection.execute(f"INSERT INTO {_KIND_TABLE} VALUES (?)", (kind.name,))


def _read_images(path: Path, names: Sequence[str]) -> Iterator[_Features]:
    """Read the features of images by their names. Raises MapError if they are of several kinds."""
    kind = None
    with (_open_hdf5 if path.suffix.lower() in HDF5_SUFFIXES else _open_database)(path) as read:
        for name in names:
            image = read(name)
            if image.kind is not None and kind not in (None, image.kind):
                problem = f"descriptors of {name} are of another kind than those before it"
                raise MapError(problem, path=path, value=image.kind.name, fix="Give features of one extractor.")
            kind = image.kind or kind
            yield image


def _check_keypoints(features: _Features, image: Any, path: Path) -> None:
    """Raise MapError unless the features of an image are those of the model: by number, first and last keypoint."""
    n = image.num_points2D()
    pixels = features.keypoints
    if len(pixels) != n or (features.descriptors is not None and len(features.descriptors) != n):
        problem = f"the file and the model disagree on the number of keypoints of {image.name}"
        raise MapError(problem, path=path, value=(len(pixels), n), fix=_FIX)
    if n:
        ends = pixels[[0, -1]]
        tolerance_px = np.full(ends.shape, 0.01)
        if path.suffix.lower() in HDF5_SUFFIXES:
            # hloc keeps them in half precision, and adds half a pixel in it: half a unit in the last place more.
            tolerance_px += np.spacing(np.clip(np.abs(ends), 0, 2.0**15).astype(np.float16)).astype(np.float64) / 2
        expected = np.array([image.points2D[0].xy, image.points2D[-1].xy])
        if not (np.abs(ends - expected) <= tolerance_px).all():
            raise MapError("the file holds other keypoints than the model", path=path, value=image.name, fix=_FIX)


def kind_in_name(path: Path) -> DescriptorKind | None:
    """The kind of descriptors that a file is named after, as hloc names it."""
    words = "-".join(["", *re.split(r"[^a-z0-9]+", path.stem.lower())])
    named = [name for name in KINDS if f"-{name}" in words]
    return KINDS[max(named, key=len)] if named else None


def weights_in_name(path: Path | str) -> str:
    """Name of the weights of ALIKED that a file of features or weights is named after, such as "aliked-n16"; "" for none."""
    found = re.search(r"aliked[-_]?(t16|n16rot|n16|n32)", Path(path).stem.lower())
    return f"aliked-{found[1]}" if found else ""


def _kind_by_columns(named: DescriptorKind | None, columns: int) -> DescriptorKind | None:
    """The kind of learned descriptors: the named one, or hloc's only one of this dimension; else None.

    Raises ValueError if the named one has another dimension.
    """
    if named is not None and named.dimension != columns:
        raise ValueError(f"descriptors of {named.name} have {named.dimension} numbers, not {columns}")
    if named is not None:
        return None if named.in_bytes else named
    return next((kind for kind in (XFEAT, SUPERPOINT) if kind.dimension == columns), None)


@contextmanager
def _open_database(path: Path) -> Iterator[Callable[[str], _Features]]:
    """Open a COLMAP database with SQLite: pycolmap would convert an old one to its own version."""
    # Without a writer's journal SQLite must not make one, which is impossible in a read-only folder.
    mode = "mode=ro" if path.with_name(path.name + "-wal").exists() else "immutable=1"
    try:
        check_file(path)
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?{mode}", uri=True)) as database:
            database.row_factory = sqlite3.Row
            named = _kind_in_table(database) or kind_in_name(path)
            ids = {row["name"]: row["image_id"] for row in database.execute("SELECT name, image_id FROM images")}

            def rows_of(table: str, name: str, item_bytes: int) -> tuple[NDArray[np.uint8], int]:
                """Bytes (K, columns) of a table for an image, and COLMAP's type of descriptors."""
                query = f"SELECT * FROM {table} WHERE image_id = ?"
                row = dict(database.execute(query, (ids[name],)).fetchone() or {"rows": 0, "cols": 0})
                values = np.frombuffer(row.get("data") or b"", dtype=np.uint8)
                return values.reshape(row["rows"], item_bytes * row["cols"]), row.get("type", SIFT.colmap_type)

            def read(name: str) -> _Features:
                if name not in ids:
                    raise MapError("the database lacks an image of the model", path=path, value=name, fix=_FIX)
                pixels = rows_of("keypoints", name, 4)[0].view("<f4")[:, :2]
                keypoints = _checked(pixels.reshape(-1, 2).astype(np.float64), name)
                values, colmap_type = rows_of("descriptors", name, 1)
                kind = _kind_in_database(colmap_type, values.shape[1], named)
                if kind is None or (len(values) == 0 and len(keypoints)):
                    return _Features(keypoints)
                if not kind.in_bytes:
                    values = kind.store(unit_descriptors(_checked(values.view("<f4"), name)))
                return _Features(keypoints, values, kind)

            yield read
    except (sqlite3.Error, OSError, ValueError, TypeError) as error:
        raise MapError(f"cannot read the database: {error}", path=path, fix=_FIX) from error


def _kind_in_table(database: sqlite3.Connection) -> DescriptorKind | None:
    """The kind that `name_kind` wrote, if it did.

    Raises ValueError if a table is a view or has computed columns, which can produce data without end.
    """
    named = None
    for schema, name, table_type, *_ in database.execute("PRAGMA table_list").fetchall():
        if schema == "main" and str(name).lower() in ("images", "keypoints", "descriptors", _KIND_TABLE):
            columns = database.execute(f'PRAGMA table_xinfo("{name}")').fetchall()
            if table_type != "table" or any(column["hidden"] for column in columns):
                raise ValueError(f"{name} is not a plain table")
            if str(name).lower() == _KIND_TABLE:
                row = database.execute(f"SELECT name FROM {_KIND_TABLE}").fetchone()
                if row and row["name"] not in KINDS:
                    raise ValueError(f"no extractor here has descriptors named {row['name']!r}")
                named = KINDS[row["name"]] if row else None
    return named


def _kind_in_database(colmap_type: int, columns: int, named: DescriptorKind | None) -> DescriptorKind | None:
    """The kind of descriptors of so many bytes, from COLMAP's number of their type; -1 if it has none."""
    if colmap_type == -1 and columns != SIFT.columns:
        return _kind_by_columns(named, columns // 4) if columns and columns % 4 == 0 else None
    kinds = [SIFT] if colmap_type == -1 else KINDS.values()
    kind = next((kind for kind in kinds if colmap_type in (-1, kind.colmap_type)), None)
    if kind is not None and not kind.in_bytes and columns not in (0, kind.columns):
        raise ValueError(f"descriptors of {kind.name} take {kind.columns} bytes each, not {columns}")
    return kind if kind is not None and kind.columns == columns else None


@contextmanager
def _open_hdf5(path: Path) -> Iterator[Callable[[str], _Features]]:
    """Open hloc's features in HDF5: `keypoints` (K, 2) and `descriptors` (D, K) of each image."""
    import h5py

    try:
        check_file(path)
        with h5py.File(path, "r") as file:
            named = kind_in_name(path)

            def read(name: str) -> _Features:
                image = _member(file, name)
                if image is None:
                    raise MapError("the features lack an image of the model", path=path, value=name, fix=_FIX)
                # hloc counts pixels from the centre of the top-left one, COLMAP from its corner
                keypoints = _array(_member(image, "keypoints"), name).astype(np.float64)[:, :2] + 0.5
                descriptors = _array(_member(image, "descriptors"), name).T
                if keypoints.shape != (len(descriptors), 2):
                    raise ValueError(f"keypoints and descriptors of {name} do not match")
                kind: DescriptorKind | None = SIFT
                may_be_sift = descriptors.shape[1] == SIFT.dimension and named in (None, SIFT)
                if not may_be_sift or (len(descriptors) and descriptors.min() < 0):
                    kind = _kind_by_columns(named, descriptors.shape[1])
                stored = None if kind is None else kind.store(unit_descriptors(descriptors))
                return _Features(keypoints, stored, kind)

            yield read
    except MapError:
        raise
    except Exception as error:  # h5py raises errors of many kinds
        raise MapError(f"cannot read the features: {error}", path=path, fix="Give hloc's feats-*.h5.") from error


def _member(group: Any, name: str) -> Any:
    """A member of a group in HDF5, None if it has none. Raises ValueError for a link, which may be to another file."""
    import h5py

    for part in name.split("/"):
        link = group.get(part, getlink=True) if isinstance(group, h5py.Group) else None
        if link is None:
            return None
        if not isinstance(link, h5py.HardLink):
            raise ValueError(f"{name} is a link")
        group = group[part]
    return group


def _array(dataset: Any, name: str) -> NDArray[Any]:
    """An array of an image in HDF5. Raises ValueError if its data are in another file, or far larger than stored."""
    import h5py

    if not isinstance(dataset, h5py.Dataset) or dataset.shape is None or dataset.is_virtual or dataset.external:
        raise ValueError(f"{name} has no array of keypoints or descriptors in this file")
    n_values = max(dataset.size, np.prod(dataset.chunks or (0,), dtype=float))
    if n_values * dataset.dtype.itemsize > max_expanded_bytes(dataset.id.get_storage_size()):
        raise ValueError(f"the keypoints or descriptors of {name} would expand to {n_values:,} numbers")
    return _checked(dataset[()], name)


def _checked(values: NDArray[Any], name: str) -> NDArray[Any]:
    """Numbers (K, N) of an image. Raises ValueError if they are not finite, or far larger than any extractor's."""
    # no pixel and no number of a descriptor comes near
    if values.ndim != 2 or values.dtype.kind not in "fiu" or not (np.abs(values) < np.float32(1e15)).all():
        raise ValueError(f"the keypoints or descriptors of {name} are not finite numbers")
    return values
