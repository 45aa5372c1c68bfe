"""What fuzzing found, each input as a small file in found/<target>/: it is read, or refused by a typed error."""

from __future__ import annotations

import tempfile
import time
import warnings
from pathlib import Path

import pytest

from faults.fuzz.execution import SECONDS, Execution, Finding
from faults.fuzz.targets import TARGETS

FOUND = Path(__file__).parent / "found"
MOST_BYTES = 8000  # of a file


@pytest.mark.parametrize("name", sorted(path.name for path in FOUND.iterdir()))
def test_what_was_found_is_read_or_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if name == "hdf5":
        pytest.importorskip("h5py", reason="features in HDF5 are read with h5py, which is not installed")
    monkeypatch.setattr(tempfile, "tempdir", None)  # which the execution sets
    with warnings.catch_warnings():
        execution = Execution(TARGETS[name], tmp_path / "target")
        for path in sorted((FOUND / name).iterdir()):
            data = path.read_bytes()
            begin = time.monotonic()
            found = execution.run(data)
            assert not isinstance(found, Finding), f"{path.name}: {found.kind}\n{found.text}"
            assert time.monotonic() - begin < SECONDS, path.name
            assert len(data) <= MOST_BYTES, path.name
        assert all(execution.run(seed) is True for seed in execution.seeds)
    assert {path.name for path in tmp_path.iterdir()} == {"target"}  # nothing was written outside
