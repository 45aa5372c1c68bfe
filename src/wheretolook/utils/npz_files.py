"""NPZ files, written atomically and read with one kind of error."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def save_npz(path: Path, arrays: Mapping[str, NDArray[Any]], compress: bool = False) -> None:
    """Write arrays by name, atomically; the folder is there already. The same arrays give the same bytes."""
    partial = path.with_name(path.name + ".partial")
    write: Any = np.savez_compressed if compress else np.savez
    with partial.open("wb") as file:
        write(file, **arrays)
    os.replace(partial, path)


def load_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Read all arrays of an NPZ file by name. Raises ValueError if the file is missing or damaged."""
    try:
        with np.load(path) as stored:
            return {name: stored[name] for name in stored.files}
    except Exception as error:  # a damaged zip raises many kinds of errors
        raise ValueError(f"not a readable NPZ file: {error}") from error
