"""A reader with faults of four kinds, for the fuzzer to find."""

from __future__ import annotations

import ctypes
from pathlib import Path

from faults.fuzz.execution import Target
from wheretolook.utils.errors import TableError


def _whole(folder: Path) -> None:
    (folder / "a.txt").write_text("0" * 40)


def _read(path: Path) -> None:
    rest = sum(path.read_bytes()) % 20
    if rest == 1:
        raise ZeroDivisionError
    if rest == 2:
        ctypes.string_at(0)
    elif rest == 3:
        (path.parent.parent / "outside").write_text("")
    elif rest == 4:
        _ = b"x" * 1_200_000_000
    elif rest == 5:
        raise TableError("not this one")


FAULTY = Target("faulty", _whole, ("a.txt",), _read)
