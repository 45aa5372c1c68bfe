"""A reader with faults, for the fuzzer to find."""

from __future__ import annotations

import ctypes
import subprocess
from pathlib import Path

from faults.fuzz.execution import Target
from wheretolook.utils.errors import TableError


def _read(path: Path) -> None:
    fault = path.read_text()
    if fault == "divide":
        raise ZeroDivisionError
    if fault == "crash":
        ctypes.string_at(0)
    elif fault == "write":
        (path.parent.parent / "outside").write_text("")
    elif fault == "fill":
        _ = b"x" * 1_200_000_000
    elif fault == "start":
        subprocess.run(["true"], check=False)
    elif fault == "refuse":
        raise TableError("not this one")


FAULTY = Target("faulty", lambda folder: (folder / "a.txt").write_text("whole"), ("a.txt",), _read)
