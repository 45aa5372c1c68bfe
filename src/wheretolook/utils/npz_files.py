"""NPZ and NPY files, written atomically and read with limits and one kind of error."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from wheretolook.utils.files import atomic_write
from wheretolook.utils.reading import check_file

MAX_RATIO = 100
"""Bytes that one byte of a file may unfold to. Packed occlusion of the maps that ship has 8; a bomb has up to 1032."""

FREE_BYTES = 128_000_000
"""A file may always unfold to so many."""


def save_npz(path: Path, arrays: Mapping[str, NDArray[Any]], compress: bool = False) -> None:
    """Write arrays by name, atomically. The same arrays give the same bytes."""
    write: Any = np.savez_compressed if compress else np.savez
    with atomic_write(path) as partial, partial.open("wb") as file:
        write(file, **arrays)


def save_npy(path: Path, array: NDArray[Any]) -> None:
    """Write an array, atomically."""
    with atomic_write(path) as partial, partial.open("wb") as file:
        npy.write_array(_Plain(file), array, allow_pickle=False)


class _Plain:
    """A file to which NumPy writes as to any other object: of an error, `ndarray.tofile` does not tell the cause."""

    def __init__(self, file: IO[bytes]) -> None:
        self.write = file.write


def load_npz(path: Path, only: Collection[str] | None = None) -> dict[str, NDArray[Any]]:
    """Read all arrays of an NPZ file by name, or only some of them. ValueError if the file is missing or damaged.

    Also if it unfolds to far more than it has bytes, which is found out before anything is unfolded. Of an array that
    tells of more values than follow it, no more memory is touched than what follows.
    """
    try:
        n_bytes = check_file(path).st_size
        with np.load(path, allow_pickle=False) as stored:
            unfolded = sum(member.file_size for member in stored.zip.infolist())
            if unfolded > max(FREE_BYTES, MAX_RATIO * n_bytes):
                raise ValueError(f"its {n_bytes:,} bytes would unfold to {unfolded:,}")
            arrays = {name: stored[name] for name in stored.files if only is None or name in only}
            if not all(isinstance(array, np.ndarray) for array in arrays.values()):  # of a strange file, its bytes
                raise ValueError("a file in it is no array")
            return arrays
    except Exception as error:  # a damaged zip raises many kinds of errors
        raise ValueError(f"not a readable NPZ file: {error}") from error


def load_npy(path: Path) -> NDArray[Any]:
    """Read the array of an NPY file. Raises ValueError if the file is missing, damaged, or shorter than it tells."""
    try:
        n_bytes = check_file(path).st_size
        with path.open("rb") as file:
            _check_header(file, n_bytes)
        return np.asarray(np.load(path, allow_pickle=False))
    except Exception as error:  # a damaged header raises many kinds of errors
        raise ValueError(f"not a readable array: {error}") from error


def _check_header(file: IO[bytes], n_bytes: int) -> None:
    """Raise ValueError if what is no array of `n_bytes` with its header starts here."""
    version = npy.read_magic(file)
    if version not in ((1, 0), (2, 0), (3, 0)):
        raise ValueError(f"an array of version {version}")
    read: Any = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, dtype = read(file)
    told = dtype.itemsize
    for side in shape:
        told *= side  # of Python's integers, which do not overflow
    if min(shape, default=0) < 0 or told > n_bytes:
        raise ValueError(f"an array of shape {shape} and type {dtype} in {n_bytes:,} bytes")
