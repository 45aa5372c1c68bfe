"""Read and write files: atomic writes, checked outputs, confined names, size limits and typed errors; cached results."""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import shutil
import stat
import unicodedata
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path, PurePath, PurePosixPath
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from wheretolook.utils.errors import ConfigError, StorageError

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow.parquet as pq

STORAGE_FIX = "Free disk space, fix permissions or name another folder, then run again; finished work is kept."


def write_json(path: Path, content: Any) -> None:
    """Write a value as JSON with `atomic_write`; keys keep their order."""
    write_text(path, json.dumps(content, indent=2) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text with `atomic_write`."""
    with atomic_write(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_bytes(path: Path, content: bytes) -> None:
    """Write bytes with `atomic_write`."""
    with atomic_write(path) as partial:
        partial.write_bytes(content)


def path_ends(path: PurePath) -> list[str]:
    """Return the names by which a table may call a file: its path and each end of it, the file's name last."""
    return [path.as_posix(), *("/".join(path.parts[start:]) for start in range(1, len(path.parts)))]


def copy_file(source: Path, target: Path) -> None:
    """Copy a file's content with `atomic_write`. Raises OSError if the source cannot be read."""
    with source.open("rb") as file, atomic_write(target) as partial, partial.open("wb") as copy:
        shutil.copyfileobj(file, copy, 2**20)


def check_output(path: Path, inputs: Iterable[Path] = ()) -> None:
    """Raise ConfigError for an output that is a device, pipe, link to a file, an input or its map, or in a dataset."""
    if "\0" in str(path):
        raise ConfigError("a path has no NUL", value=str(path))
    target = Path(os.path.realpath(path))
    of_map = target.stem in ("cameras", "images", "points3D", "rigs", "frames", "landmarks")
    replaced = {target, target.parent if of_map else target}
    is_special = os.path.lexists(path) and not path.is_dir() and (path.is_symlink() or not path.is_file())
    in_dataset = any((folder / "dataset.json").is_file() for folder in (target, *target.parents))
    if is_special or in_dataset or replaced & {Path(os.path.realpath(given)) for given in inputs}:
        problem = "an output is a regular file or folder, no device, link to a file or input, and not in a dataset"
        raise ConfigError(problem, path=path, fix="Give another path.")


def check_output_folder(folder: Path, is_own: bool) -> None:
    """Raise ConfigError for a folder to write that is a file or holds files, unless the same command wrote them."""
    if not is_own and folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError("this holds something else", path=folder, fix="Name a new or an empty folder.")


@contextmanager
def atomic_write(path: Path, partial: Path | None = None) -> Iterator[Path]:
    """Yield a path to write to, which replaces `path` at the end of the block; after an error, `path` is unchanged.

    The parent folder is created if missing. `partial` is the path to write to, if it needs a certain ending; its
    default is `path` with ".partial" appended. Raises ConfigError for a device or pipe, StorageError, naming `path`, if
    it cannot be written.
    """
    partial = partial or path.with_name(path.name + ".partial")
    if "\0" in str(path) or (path.exists() and not path.is_file() and not path.is_dir()):  # a device or pipe
        check_output(path)
    try:
        with storage_errors(path, partial):
            path.parent.mkdir(parents=True, exist_ok=True)
            yield partial
            os.replace(partial, path)
    except BaseException:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        raise


@contextmanager
def atomic_folder(folder: Path, before_replace: Callable[[], None] = lambda: None) -> Iterator[Path]:
    """Yield an empty sibling folder, which replaces `folder` at the end of the block; after an error, it is removed.

    The sibling is `.<name>.partial`; the old folder is `.<name>.replaced` until the new one is in place. What a killed
    process left of them is cleaned up first. `before_replace` is called when the new folder is complete. Raises
    StorageError, naming paths in `folder`, if something cannot be written. Only one process at a time may do this.
    """
    partial = folder.with_name(f".{folder.name}.partial")
    old = folder.with_name(f".{folder.name}.replaced")
    if old.exists() and not folder.exists():
        os.replace(old, folder)
    for leftover in (partial, old):
        shutil.rmtree(leftover, ignore_errors=True)
    created = missing_folders(folder)
    with storage_errors(folder, partial):
        partial.mkdir(parents=True)
    try:
        yield partial
        before_replace()
        with storage_errors(folder, partial):
            if folder.exists():
                os.replace(folder, old)
            os.replace(partial, folder)
        shutil.rmtree(old, ignore_errors=True)
    except BaseException as error:
        if old.exists() and not folder.exists():
            os.replace(old, folder)
        shutil.rmtree(partial, ignore_errors=True)
        remove_if_empty(created)
        if isinstance(error, StorageError) and error.path and Path(error.path).is_relative_to(partial):
            path = folder / Path(error.path).relative_to(partial)
            raise StorageError(error.problem, path=path, value=error.value, fix=error.fix) from error
        raise


def missing_folders(path: Path) -> list[Path]:
    """Return the folders that contain a path and do not exist, the innermost first."""
    return [folder for folder in path.parents if not folder.exists()]


def remove_if_empty(folders: Iterable[Path]) -> None:
    """Remove those of some folders that are empty."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


@contextmanager
def storage_errors(path: Path, partial: Path | None = None) -> Iterator[None]:
    """Re-raise OSErrors as StorageErrors that name the file; `partial` is reported as `path`."""
    try:
        yield
    except OSError as error:
        named = Path(os.fsdecode(error.filename)) if isinstance(error.filename, str | bytes) else path
        concerned = path if named == partial else named
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise StorageError(f"cannot be written: {reason}", path=concerned, fix=STORAGE_FIX) from error


@contextmanager
def storing_in_database(database: Path) -> Iterator[None]:
    """Re-raise COLMAP's errors about a database that cannot be written as StorageError."""
    try:
        yield
    except RuntimeError as error:
        match = re.search(r"SQLite error: (.*)|No registered database factory succeeded", str(error))
        if not match:
            raise
        reason = match[1] or "SQLite cannot make it"
        raise StorageError(f"cannot be written: {reason}", path=database, fix=STORAGE_FIX) from error


@contextmanager
def temporary_folder(suffix: str = "", parent: Path | None = None) -> Iterator[Path]:
    """Yield a new folder, among the system's temporary files or in `parent`, which is removed with its content."""
    with TemporaryDirectory(suffix, "wheretolook-", parent, ignore_cleanup_errors=True) as name:
        yield Path(name)


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def fingerprint(path: Path) -> str:
    """Return the first 16 hexadecimal digits of a file's SHA-256."""
    return sha256(path)[:16]


def size_and_time(paths: Iterable[Path]) -> list[tuple[str, int, int]]:
    """Return path, size in bytes and time of the last change of each file, as an input of `cache_key`."""
    stats = [(path, path.stat()) for path in paths]
    return [(str(path), stat.st_size, stat.st_mtime_ns) for path, stat in stats]


def check_folder_name(whose: str, name: str, reserved: tuple[str, ...] = ()) -> None:
    """Raise ConfigError unless a name can be a new folder's and is not reserved."""
    composed = unicodedata.normalize("NFC", name)  # of an accent and a letter, as macOS writes names
    if not re.fullmatch(r"[\w-]([\w. -]*[\w.-])?", composed) or name in reserved:
        others = f", but not {', '.join(reserved)}" if reserved else ""
        fix = f"Use letters, digits, spaces, '.', '_' and '-'{others}."
        raise ConfigError(f"{whose} becomes a folder's name", value=name, fix=fix)


def safe_child(folder: Path, name: object, whose: str) -> Path:
    """Return the path of a name in a folder. Raises ConfigError if it would leave the folder or is in a subfolder of it."""
    if not isinstance(name, str) or name in ("", ".", "..") or "/" in name or "\0" in name:
        raise ConfigError(f"{whose} must be the name of a folder or file, without '/'", value=name)
    return folder / name


def path_within(folder: Path, name: str, whose: str) -> Path:
    """Return the path of a name such as "left/1.jpg" in a folder. Raises ConfigError if it is absolute or goes up."""
    parts = PurePosixPath(name)
    if parts.is_absolute() or ".." in parts.parts or not parts.parts or "\0" in name:
        raise ConfigError(f"{whose} must be a path within its folder", path=folder, value=name)
    return folder / name


MAX_TEXT_BYTES = 16_000_000  # of a JSON file: a hundred thousand photographs or shards


def check_file(path: Path, pipes: bool = False) -> os.stat_result:
    """Return the status of a regular file or, if `pipes`, of one that the shell opened, such as /dev/stdin.

    Raises ValueError for a folder, device or other pipe, OSError if it is missing.
    """
    status = os.stat(path)
    is_open_pipe = pipes and stat.S_ISFIFO(status.st_mode) and str(path).startswith("/dev/")
    if not stat.S_ISREG(status.st_mode) and not is_open_pipe:
        raise ValueError("this is no regular file")
    return status


def max_expanded_bytes(n_bytes: int) -> int:
    """Return how many bytes a file of arrays or a table of `n_bytes` may expand to in memory.

    A hundred times its size: the occlusion of the bundled maps expands by 8, a bomb by 1032.
    """
    return max(128_000_000, 100 * n_bytes)


def read_text(path: Path, at_most: int = MAX_TEXT_BYTES, pipes: bool = False) -> str:
    """Read a UTF-8 text, without a byte-order mark (see `check_file`). Raises ValueError if it is none, no regular file, or has more bytes than `at_most`."""
    check_file(path, pipes)
    with path.open("rb") as file:
        content = file.read(at_most + 1)
    if len(content) > at_most:
        raise ValueError(f"it has more than {at_most:,} bytes")
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise ValueError("it is no text in UTF-8") from error


def parse_json(text: str) -> Any:
    """Parse a JSON text. Raises ValueError if it is none, gives a key twice, has too many values or nests them too deeply."""
    if sum(map(text.count, ",[{")) > 1_500_000:  # an empty list takes three bytes of a file and eighty of memory
        raise ValueError("it has more than 1,500,000 values")
    try:
        return json.loads(text, object_pairs_hook=_unique)
    except RecursionError as error:
        raise ValueError("its values are nested too deeply") from error


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return pairs as a dictionary. Raises ValueError for a key that is given twice: the first value would be ignored."""
    result: dict[str, Any] = {}
    for name, value in pairs:
        if name in result:
            raise ValueError(f"the key {name!r} is given twice")
        result[name] = value
    return result


def parse_json_object(text: str) -> dict[str, Any]:
    """Parse a JSON text that is an object (see `parse_json`)."""
    content = parse_json(text)
    if not isinstance(content, dict):
        raise ValueError(f"a JSON object is expected, not {str(content)[:40]!r}")
    return content


def read_json(path: Path) -> Any:
    """Read a JSON file (see `read_text` and `parse_json`)."""
    return parse_json(read_text(path))


def read_json_object(path: Path) -> dict[str, Any]:
    """Read a JSON file that is an object (see `read_text` and `parse_json`)."""
    return parse_json_object(read_text(path))


def read_yaml(path: Path) -> Any:
    """Read a YAML file (see `read_text` and `parse_yaml`)."""
    return parse_yaml(read_text(path, 100_000))


def parse_yaml(text: str) -> Any:
    """Parse YAML of plain values; dates are texts. Raises ValueError if it is none, or if a key is given twice."""
    import yaml

    class UniqueKeys(yaml.SafeLoader):
        """Loads plain values and raises a YAMLError for a key that is given twice: the first value would be ignored."""

        yaml_implicit_resolvers: ClassVar[dict[str, Any]] = {  # without dates, which names may look like
            first: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith(":timestamp")]
            for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
        }

        def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
            keys = [key.value for key, _ in node.value if isinstance(key.value, str) and key.value != "<<"]
            for key in keys:
                if keys.count(key) > 1:
                    raise yaml.YAMLError(f"the key {key} is given twice")
            return super().construct_mapping(node, deep)

    try:
        return UniqueKeys(text).get_single_data()
    except (yaml.YAMLError, RecursionError, TypeError, OverflowError) as error:
        raise ValueError(" ".join(str(error).split())) from error


MAX_PIXELS = 150_000_000
"""Limit for photographs; three bytes per pixel and a copy take 900 MB."""


def image_size(image: Path | bytes, at_most: int = MAX_PIXELS) -> tuple[int, int]:
    """Return width and height of an image file, or of its content.

    Raises ValueError if it is no image or has more pixels than `at_most`, OSError if it is missing.
    """
    from PIL import Image

    if isinstance(image, Path):
        check_file(image)
    try:
        source = image if isinstance(image, Path) else io.BytesIO(image)
        quiet = warnings.catch_warnings(action="ignore", category=Image.DecompressionBombWarning)  # the limit is ours
        with quiet, Image.open(source) as opened:
            width, height = opened.size
    except Exception as error:  # decoders raise errors of many kinds
        raise ValueError(f"this is no image: {error}") from error
    if width * height > at_most:
        raise ValueError(f"its {width} x {height} pixels are more than {at_most:,}")
    return width, height


def read_image(path: Path, flags: int, at_most: int = MAX_PIXELS) -> NDArray[Any]:
    """Read an image with `cv2.imread`. Raises ValueError if that fails, and as `image_size`."""
    import cv2

    image_size(path, at_most)
    try:
        image = None if _is_cut_jpeg(path.read_bytes()) else cv2.imread(str(path), flags)
    except cv2.error as error:
        raise ValueError(error.err) from error
    if image is None:
        raise ValueError("this is no image, or not a whole one")
    return image


def _is_cut_jpeg(data: bytes) -> bool:
    """Return whether a JPEG lacks its end, the marker FFD9 after the first scan: OpenCV fills the missing part with grey.

    A thumbnail in the header has an end of its own, so segments are skipped by their lengths; fill bytes FF may precede
    a marker.
    """
    at = 2
    while data[at : at + 1] == b"\xff" and data[at + 1 : at + 2] != b"\xda":
        is_fill = data[at + 1 : at + 2] == b"\xff"
        at += 1 if is_fill else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return data.startswith(b"\xff\xd8") and data.find(b"\xff\xd9", at) < 0


def save_npz(path: Path, arrays: Mapping[str, NDArray[Any]], compress: bool = False) -> None:
    """Write arrays by name, atomically. The same arrays give the same bytes."""
    write: Any = np.savez_compressed if compress else np.savez
    with atomic_write(path) as partial, partial.open("wb") as file:
        write(file, **arrays)


def save_npy(path: Path, array: NDArray[Any]) -> None:
    """Write an array, atomically."""
    with atomic_write(path) as partial, partial.open("wb") as file:
        np.save(file, array, allow_pickle=False)


def load_npz(path: Path, only: Collection[str] | None = None) -> dict[str, NDArray[Any]]:
    """Read the arrays of an NPZ file by name, all or `only` some.

    Raises ValueError if the file is missing, damaged, or expands to far more than its size. An array whose header
    claims more values than follow touches no more memory than these take.
    """
    try:
        n_bytes = check_file(path).st_size
        with np.load(path, allow_pickle=False) as stored:
            expanded = sum(member.file_size for member in stored.zip.infolist())
            if expanded > max_expanded_bytes(n_bytes):
                raise ValueError(f"its {n_bytes:,} bytes expand to {expanded:,}")
            arrays = {name: stored[name] for name in stored.files if only is None or name in only}
        if not all(isinstance(array, np.ndarray) for array in arrays.values()):  # other members are read as bytes
            raise ValueError("a file in it is no array")
        return arrays
    except Exception as error:  # a damaged zip raises many kinds of errors
        raise ValueError(f"not a readable NPZ file: {error}") from error


def load_npy(path: Path) -> NDArray[Any]:
    """Read the array of an NPY file. Raises ValueError if it is missing, damaged, or shorter than its header claims."""
    try:
        check_file(path)
        return np.array(np.load(path, mmap_mode="r", allow_pickle=False))
    except Exception as error:  # a damaged header raises many kinds of errors
        raise ValueError(f"not a readable array: {error}") from error


@contextmanager
def open_parquet(path: Path, **options: Any) -> Iterator[pq.ParquetFile]:
    """Open a Parquet file with options of `pyarrow.parquet.ParquetFile`.

    Raises ValueError if it is none, expands to far more than its size, or Arrow raises an error in the block.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    limit = max_expanded_bytes(check_file(path).st_size)
    limits = {"thrift_container_size_limit": 2000}  # Arrow overflows the stack at 10,000 nested columns
    try:
        with pq.ParquetFile(path, **limits, **options) as file:
            groups = range(file.num_row_groups)
            expanded = sum(file.metadata.row_group(number).total_byte_size for number in groups)
            if expanded > limit:
                raise ValueError(f"it expands to {expanded:,} bytes, more than {limit:,}")
            yield file
    except (pa.ArrowException, OSError, KeyError, UnicodeDecodeError) as error:
        raise ValueError(str(error)) from error


def read_parquet(path: Path) -> pd.DataFrame:
    """Read a Parquet file as a table. Raises ValueError as `open_parquet`."""
    with open_parquet(path, page_checksum_verification=True) as file:
        table: pd.DataFrame = file.read().to_pandas()
        return table


def cache_key(*parts: Any) -> str:
    """Hash the inputs of a computation to 16 hexadecimal digits; values that JSON lacks are hashed by their text."""
    text = json.dumps(parts, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class ArtifactCache:
    """Results of one step of work, valid while `key`, which `cache_key` computes from the inputs, stays the same.

    The manifest, a JSON file in the folder, maps each finished step to its key. With `steps` in their order of work,
    storing or clearing one invalidates the later ones. An unreadable manifest or result counts as missing.

    Results are tables (`.parquet`), named arrays (`.npz`) or JSON values (`.json`), by the ending of their names:

        cache = ArtifactCache(folder, cache_key(settings, fingerprint(path)))
        results = cache.load("views.parquet")
        if results is None:
            results = cache.store({"views.parquet": compute()})
    """

    def __init__(
        self, folder: Path, key: str = "", step: str = "key", manifest: str = "manifest.json", steps: Sequence[str] = ()
    ) -> None:
        self.folder = folder
        self.key = key
        self.step = step
        self.manifest = folder / manifest
        self.steps = steps

    @property
    def stored_key(self) -> str | None:
        """The key that the step was finished with; None if it was not."""
        return self._keys().get(self.step)

    def is_current(self, *files: Path) -> bool:
        """Return whether the step was finished with this key and the files still exist."""
        return self.stored_key == self.key and all(file.exists() for file in files)

    def load(self, *names: str) -> dict[str, Any] | None:
        """Read the named results; None if they are of another key, missing or unreadable."""
        if not self.is_current():
            return None
        try:
            return {name: _read(self.folder / name) for name in names}
        except (OSError, ValueError):
            return None

    def store(self, results: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Write named results, then the key; without results, files that the caller wrote. Returns the results."""
        if results:
            self.clear()  # so that no key describes files of different runs
        for name, value in (results or {}).items():
            _write(self.folder / name, value)
        write_json(self.manifest, {**self._valid(self._keys()), self.step: self.key})
        return dict(results or {})

    def clear(self) -> None:
        """Remove the key of this step and of later ones; files stay."""
        keys = self._keys()
        valid = self._valid(keys)
        if valid != keys:
            write_json(self.manifest, valid)

    def _keys(self) -> dict[str, str]:
        try:
            return read_json_object(self.manifest)
        except (OSError, ValueError):
            return {}

    def _valid(self, keys: dict[str, str]) -> dict[str, str]:
        """The keys that do not depend on this step."""
        outdated = self.steps[self.steps.index(self.step) :] if self.steps else [self.step]
        return {step: key for step, key in keys.items() if step not in outdated}


def _read(path: Path) -> Any:
    if path.suffix == ".json":
        return read_json(path)
    if path.suffix == ".npz":
        return load_npz(path)

    return read_parquet(path)


def _write(path: Path, value: Any) -> None:
    if path.suffix == ".json":
        write_json(path, value)
    elif path.suffix == ".npz":
        save_npz(path, value)
    else:
        table: pd.DataFrame = value
        with atomic_write(path) as partial:
            table.to_parquet(partial, index=False, write_page_checksum=True)
