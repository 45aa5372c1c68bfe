"""Read and write files: atomic writes, checked outputs, confined names, JSON and YAML with typed errors."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import stat
import unicodedata
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePath, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

from wheretolook.utils.errors import ConfigError, StorageError

STORAGE_FIX = "Free disk space, fix permissions or name another folder, then run again; finished work is kept."
MAP_FILES = ("cameras", "images", "points3D", "rigs", "frames", "landmarks")  # without endings


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
    target = Path(os.path.realpath(path))
    replaced = {target, target.parent if target.stem in MAP_FILES else target}
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
    if path.exists() and not path.is_file() and not path.is_dir():  # a device or pipe
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
MAX_JSON_VALUES = 1_500_000  # an empty list takes three bytes of a file and eighty of memory
MAX_YAML_BYTES = 100_000
MAX_RATIO = 100  # of expanded to stored bytes of arrays and tables; occlusion of the bundled maps has 8, a bomb 1032
FREE_BYTES = 128_000_000  # that any file of arrays may expand to


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
    """Return how many bytes a file of arrays or a table of `n_bytes` may expand to in memory."""
    return max(FREE_BYTES, MAX_RATIO * n_bytes)


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
    """Parse a JSON text. Raises ValueError if it is none, has too many values, or nests them too deeply."""
    if sum(map(text.count, ",[{")) > MAX_JSON_VALUES:
        raise ValueError(f"it has more than {MAX_JSON_VALUES:,} values")
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("its values are nested too deeply") from error


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
    """Read a YAML file of plain values. Raises ValueError if it is none, or if a key is given twice."""
    import yaml

    class UniqueKeys(yaml.SafeLoader):
        """Loads plain values and raises a YAMLError for a key that is given twice: the first value would be ignored."""

        def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
            keys = [key.value for key, _ in node.value if isinstance(key.value, str) and key.value != "<<"]
            for key in keys:
                if keys.count(key) > 1:
                    raise yaml.YAMLError(f"the key {key} is given twice")
            return super().construct_mapping(node, deep)

    try:
        return UniqueKeys(read_text(path, MAX_YAML_BYTES)).get_single_data()
    except (yaml.YAMLError, RecursionError, TypeError, OverflowError) as error:
        raise ValueError(" ".join(str(error).split())) from error
