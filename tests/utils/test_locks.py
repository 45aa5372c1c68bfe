"""Locks keep processes apart, and do not outlive who held them."""

import errno
import fcntl
import os
import subprocess
import sys
import time

import pytest

from wheretolook.utils.errors import InUseError, LockWarning
from wheretolook.utils.processes import hold

HOLDER = """
import sys
from pathlib import Path
from wheretolook.utils.processes import hold
with hold(Path(sys.argv[1]), sys.argv[2], shared=sys.argv[3] == "shared"):
    print("held", flush=True)
    sys.stdin.read()
"""


def holder(lock, what="label", shared=False):
    """Another process that holds the lock until its input ends."""
    arguments = [sys.executable, "-c", HOLDER, str(lock), what, "shared" if shared else "alone"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen(arguments, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    return process


def test_the_holder_is_named_and_a_killed_one_blocks_nobody(tmp_path):
    lock = tmp_path / "new" / "lock"
    other = holder(lock)
    start = time.monotonic()
    with pytest.raises(InUseError), hold(lock, "sample", wait_s=0.3):
        pass
    assert time.monotonic() - start >= 0.3
    other.kill()
    other.wait()
    assert lock.exists()
    with hold(lock, "sample"):
        pass
    assert not lock.exists()


def test_readers_share_and_shut_writers_out(tmp_path):
    lock = tmp_path / "lock"
    other = holder(lock, "evaluate", shared=True)
    with hold(lock, "train", shared=True), pytest.raises(InUseError), hold(lock, "label"):
        pass
    assert lock.exists()
    other.communicate("")
    assert not lock.exists()
    with hold(lock, "label"), pytest.raises(InUseError), hold(lock, "train", shared=True):
        pass


def test_removing_the_file_lets_no_two_in(tmp_path):
    """Three processes add to a number 100 times each."""
    script = """
import sys
from pathlib import Path
from wheretolook.utils.processes import hold
number = Path(sys.argv[1]) / "number"
for _ in range(100):
    with hold(Path(sys.argv[1]) / "lock", "count", wait_s=60):
        number.write_text(str(int(number.read_text()) + 1))
"""
    (tmp_path / "number").write_text("0")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    many = [subprocess.Popen([sys.executable, "-c", script, str(tmp_path)], env=environment) for _ in range(3)]
    assert [process.wait() for process in many] == [0] * 3
    assert (tmp_path / "number").read_text() == "300"


def test_without_locks_it_warns_and_goes_on(tmp_path, monkeypatch):
    def none(file, kind):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", none)
    with pytest.warns(LockWarning), hold(tmp_path / "lock", "label"):
        pass
