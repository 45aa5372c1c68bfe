"""A few faults of every kind; `python -m faults.campaign` tries hundreds (docs/faults.md)."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ONLY = ("map", "sample", "label", "train", "evaluate", "viewpoint-map", "sample, another seed")


@pytest.mark.slow
def test_no_kill_no_damaged_file_and_no_full_disk_does_harm(tmp_path: Path) -> None:
    disks = ["--disks", "4"] if os.geteuid() == 0 and _may_mount() else []
    faults = ["--kills", "24", "--damages", "24", *disks, "--only", *ONLY]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    ended = subprocess.run(
        [sys.executable, "-m", "faults.campaign", *faults],
        env=environment,
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert ended.returncode == 0, ended.stdout[-6000:] + ended.stderr[-2000:]
    assert f"{52 if disks else 48} faults in " in ended.stdout and " 0 did harm" in ended.stdout


def _may_mount() -> bool:
    """Containers often give root no right to mount."""
    return subprocess.run(["unshare", "--mount", "true"], capture_output=True).returncode == 0
