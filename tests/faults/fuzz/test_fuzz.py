"""A short run of the fuzzer over all targets; `fuzz.py` tells how to run it for hours."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from subprocess import run

import pytest

from faults.fuzz.targets import TARGETS

FUZZ = Path(__file__).with_name("fuzz.py")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits on time and memory are those of Linux")
def test_a_short_run_finds_nothing(tmp_path: Path) -> None:
    command = [sys.executable, str(FUZZ), "--out", str(tmp_path), "--minutes", "0.75", "--engine", "bytes"]
    done = run(command, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    results = {row["target"]: row for row in json.loads((tmp_path / "report.json").read_text())}
    assert {*results} == {*TARGETS}
    assert all(row["executions"] > row["refused"] > 0 for row in results.values())  # some were read, some refused


@pytest.mark.skipif(sys.platform != "linux", reason="limits on time and memory are those of Linux")
def test_the_fuzzer_tells_what_it_finds(tmp_path: Path) -> None:
    """A reader with faults of four kinds, each of which is found, kept with its input, and survived."""
    command = [sys.executable, str(FUZZ), "faulty", "--out", str(tmp_path), "--minutes", "0.3", "--engine", "bytes"]
    done = run([*command, "--jobs", "1"], capture_output=True, text=True, timeout=300)
    assert done.returncode == 1, done.stderr
    (row,) = json.loads((tmp_path / "report.json").read_text())
    kinds = " / ".join(row["findings"])
    for kind in ("ZeroDivisionError", "SIGSEGV", "not confined: open", "more than 1 GB"):
        assert kind in kinds, kinds
    assert row["executions"] > 10 and row["processes"] > 1
