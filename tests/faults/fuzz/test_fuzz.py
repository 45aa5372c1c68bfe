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
    assert all(row["executions"] > 0 for row in results.values())
    assert all(sum(row[kind] for row in results.values()) > 100 for kind in ("read", "refused"))


@pytest.mark.skipif(sys.platform != "linux", reason="limits on time and memory are those of Linux")
@pytest.mark.parametrize(
    ("fault", "kind"),
    [
        ("divide", "ZeroDivisionError fuzz/faulty.py:_read"),
        ("crash", "ends the process: SIGSEGV"),
        ("write", "not confined: open ../outside"),
        ("fill", "more than 1 GB of memory"),
        ("start", "not confined: subprocess.Popen"),
        ("refuse", ""),
        ("read", ""),
    ],
)
def test_the_fuzzer_tells_what_it_finds(fault: str, kind: str, tmp_path: Path) -> None:
    """A reader with faults, each of which is found and kept with its input."""
    (tmp_path / "input").write_text(fault)
    command = [sys.executable, str(FUZZ), "faulty", "--out", str(tmp_path / "out"), "--engine", "bytes"]
    done = run([*command, "--replay", str(tmp_path / "input")], capture_output=True, text=True, timeout=300)
    assert done.returncode == bool(kind), done.stderr
    (row,) = json.loads((tmp_path / "out" / "report.json").read_text())
    assert row["executions"] == 1 and (row["read"], row["refused"]) == (fault == "read", fault == "refuse")
    assert [found[: len(kind)] for found in row["findings"]] == ([kind] if kind else [])
    kept = [path.read_text() for path in (tmp_path / "out" / "faulty" / "findings").glob("*.bin")]
    assert kept == ([fault] if kind else [])
