"""Damaged files are read or refused by a typed error, in bounded time and memory, without a crash.

`python -m faults.test_readers 3600` fuzzes for an hour.
"""

import contextlib
import os
import random
import resource
import signal
import struct
import subprocess
import sys
import tempfile
import time
import warnings
from importlib.util import find_spec
from pathlib import Path

import pytest

from faults.targets import TARGETS
from wheretolook.utils.errors import WhereToLookError

SECONDS = 10  # for one file of a few kilobytes
MEMORY_BYTES = 1_000_000_000
WORDS = [
    b"nan", b"-Infinity", b"1e308", b"-1", b"9" * 30, b"null", b"[]", b"../../x", b"\0", b"\n", b"\xff", b",", b'"',
    b"[" * 200, b"!!python/name:os.system",
    *(struct.pack("<q", value) for value in (-1, 2**31 - 1, -(2**31), 10**8, 2**62)),
    *(struct.pack("<d", value) for value in (float("nan"), float("inf"), 1e300)),
]  # fmt: skip


def mutated(data, rng):
    """The bytes with one to four changes: a byte, a word in place of others, a cut, a repetition."""
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(data) + 1)
        change = rng.randrange(5)
        word = rng.choice(WORDS)
        if change < 2:
            data = data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :]
        elif change == 2:
            data = data[:at] + word + data[at + rng.choice((0, len(word))) :]
        elif change == 3:
            data = data[:at] + data[at + rng.choice((1, 64, len(data))) :]
        else:
            data = data[:at] + data[at : at + 64] * rng.choice((2, 40)) + data[at + 64 :]
    return data


def fuzz(folder, seconds, seed):
    """Damage the files of all targets in turn. What goes wrong ends the process."""
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    rng = random.Random(seed)
    names = [name for name in TARGETS if name != "hdf5" or find_spec("h5py")]
    for name in names:
        (folder / name).mkdir()
        TARGETS[name].make(folder / name)
        for file in TARGETS[name].files:
            TARGETS[name].read(folder / name / file)  # whole files are read, and everything is imported
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for name in names:
            path = folder / name / rng.choice(TARGETS[name].files)
            whole = path.read_bytes()
            damaged = mutated(whole, rng)
            path.write_bytes(damaged)
            (folder / "last").write_bytes(damaged)
            print(name, path.name, flush=True)
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            signal.setitimer(signal.ITIMER_PROF, SECONDS)
            with contextlib.suppress(WhereToLookError):
                TARGETS[name].read(path)
            signal.setitimer(signal.ITIMER_PROF, 0)
            assert 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) < MEMORY_BYTES
            path.write_bytes(whole)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="time and memory are limited as on Linux")
def test_damaged_files_do_no_harm(tmp_path):
    (tmp_path / "fuzz").mkdir()
    command = [sys.executable, "-m", "faults.test_readers", "20", str(tmp_path / "fuzz")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, env=environment)
    assert done.returncode == 0, done.stdout[-200:] + done.stderr[-3000:]


FOUND = Path(__file__).parent / "found"


@pytest.mark.parametrize("name", sorted(path.name for path in FOUND.iterdir()))
def test_files_that_once_did_harm_are_read_or_refused(name, tmp_path):
    """The first byte chooses the file that the rest replaces, where a target has several."""
    if name == "hdf5":
        pytest.importorskip("h5py")
    target = TARGETS[name]
    target.make(tmp_path)
    for found in sorted((FOUND / name).iterdir()):
        data = found.read_bytes()
        for file in target.files:
            path = tmp_path / file
            whole = path.read_bytes()
            for content in (data, data[1:]):
                path.write_bytes(content)
                start = time.monotonic()
                with contextlib.suppress(WhereToLookError):
                    target.read(path)
                assert time.monotonic() - start < SECONDS
            path.write_bytes(whole)


if __name__ == "__main__":
    fuzz(Path(sys.argv[2] if len(sys.argv) > 2 else tempfile.mkdtemp()), float(sys.argv[1]), seed=0)
