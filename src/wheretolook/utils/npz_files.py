"""Writes NPZ and NPY files atomically, and reads them with limits and one kind of error."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.utils.files import atomic_write, check_file, max_expanded_bytes


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
