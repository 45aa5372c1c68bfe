"""Files that are written whole or not at all, with errors that name them, and their fingerprints."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from wheretolook.utils.errors import StorageError

MAKE_ROOM = "Make room, or lift what forbids it, and run again: what is finished is kept."


def write_json(path: Path, content: Any) -> None:
    """Write JSON, as `replacing` does, keys in the order given."""
    write_text(path, json.dumps(content, indent=2) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text, as `replacing` does."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_bytes(path: Path, content: bytes) -> None:
    """Write bytes, as `replacing` does."""
    with replacing(path) as partial:
        partial.write_bytes(content)


def copy_file(source: Path, target: Path) -> None:
    """Copy a file's content, as `replacing` does. Raises OSError if the source cannot be read."""
    with source.open("rb") as file, replacing(target) as partial, partial.open("wb") as copy:
        shutil.copyfileobj(file, copy, 2**20)


@contextmanager
def replacing(path: Path, partial: Path | None = None) -> Iterator[Path]:
    """Yield the path of a file to write beside `path`, whose place it takes when the block is done.

    The folder is made if missing. If anything fails, that file is removed, and what was at `path` stays. `partial` is
    the name to write to, for those who need a certain ending. Raises StorageError, which names `path`, if it cannot be
    written: the disk is full, the folder is read-only, or files have a limit.
    """
    partial = partial or path.with_name(path.name + ".partial")
    try:
        with storing(path, partial):
            path.parent.mkdir(parents=True, exist_ok=True)
            yield partial
            os.replace(partial, path)
    except BaseException:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        raise


@contextmanager
def storing(path: Path, partial: Path | None = None) -> Iterator[None]:
    """Turn an OSError into a StorageError that names the file: `path`, which is written as `partial`, or its folder."""
    try:
        yield
    except OSError as error:
        named = Path(os.fsdecode(error.filename)) if isinstance(error.filename, str | bytes) else path
        concerned = path if named == partial else named
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise StorageError(f"cannot be written: {reason}", path=concerned, fix=MAKE_ROOM) from error


@contextmanager
def moved_later(folder: Path, place: Path) -> Iterator[None]:
    """Let StorageErrors about files in a folder name them as they were to lie, once the folder is moved to `place`."""
    try:
        yield
    except StorageError as error:
        if error.path is None or not Path(error.path).is_relative_to(folder):
            raise
        path = place / Path(error.path).relative_to(folder)
        raise StorageError(error.problem, path=path, value=error.value, fix=error.fix) from error


@contextmanager
def temporary_folder(suffix: str = "", prefix: str = "wheretolook-", parent: Path | None = None) -> Iterator[Path]:
    """A folder, that of temporary files as a parent or another one, that is removed at the end.

    Unlike one of `tempfile.TemporaryDirectory`, Ctrl-C leaves none behind when it comes while it is made or removed.
    """
    folder = Path(tempfile.gettempdir() if parent is None else parent) / f"{prefix}{secrets.token_hex(8)}{suffix}"
    try:
        folder.mkdir(mode=0o700)
        yield folder
    finally:
        try:
            shutil.rmtree(folder, ignore_errors=True)
        except KeyboardInterrupt:
            shutil.rmtree(folder, ignore_errors=True)
            raise


def sha256(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def fingerprint(path: Path) -> str:
    """First 16 hexadecimal digits of a file's SHA-256."""
    return sha256(path)[:16]
