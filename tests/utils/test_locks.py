"""Locks keep runs apart, say who holds them, and do not outlive who held them."""

from __future__ import annotations

import errno
import fcntl
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from wheretolook.utils.errors import InUseError, LockWarning
from wheretolook.utils.locks import hold

HOLDER = """
import sys, time
from pathlib import Path
from wheretolook.utils.locks import hold
with hold(Path(sys.argv[1]), sys.argv[2], shared=sys.argv[3] == "shared"):
    print("held", flush=True)
    sys.stdin.read()
"""


def holder(lock: Path, what: str = "label", shared: bool = False) -> subprocess.Popen[str]:
    """Another process that holds the lock until its input ends."""
    arguments = [sys.executable, "-c", HOLDER, str(lock), what, "shared" if shared else "alone"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen(arguments, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    return process


def test_the_second_is_told_who_holds_it_and_a_killed_one_blocks_nobody(tmp_path: Path) -> None:
    lock = tmp_path / "new" / "lock"
    other = holder(lock)
    said = rf"lock: another run .*label, process {other.pid} on .* since 20"
    with pytest.raises(InUseError, match=said), hold(lock, "sample"):
        pass
    other.send_signal(signal.SIGKILL)
    other.wait()
    assert lock.exists()  # what a killed process leaves
    with hold(lock, "sample"):
        assert f"{os.getpid()}\t" in lock.read_text() and "label" not in lock.read_text()
    assert not lock.exists()


def test_readers_share_and_shut_writers_out(tmp_path: Path) -> None:
    lock = tmp_path / "lock"
    killed = holder(lock, "plan", shared=True)
    other = holder(lock, "evaluate", shared=True)
    killed.kill()
    killed.wait()
    with hold(lock, "train", shared=True), pytest.raises(InUseError) as caught, hold(lock, "label"):
        pass
    said = str(caught.value)
    assert f"process {other.pid} " in said and f"process {os.getpid()} " in said and f" {killed.pid} " not in said
    assert lock.exists()
    other.communicate("")
    assert not lock.exists()
    with hold(lock, "label"), pytest.raises(InUseError, match="label"), hold(lock, "train", shared=True):
        pass
    assert not lock.exists()


def test_it_waits_when_asked_to(tmp_path: Path) -> None:
    lock = tmp_path / "lock"
    other = holder(lock)
    start = time.monotonic()
    with pytest.raises(InUseError), hold(lock, "sample", wait_s=0.3):
        pass
    assert time.monotonic() - start >= 0.3
    assert other.stdin is not None
    other.stdin.close()
    with hold(lock, "sample", wait_s=60):
        assert lock.exists()
    other.wait()


def test_only_one_at_a_time_though_the_file_comes_and_goes(tmp_path: Path) -> None:
    """Four processes add to a number 200 times each: removing the file lets no two in."""
    script = """
import sys
from pathlib import Path
from wheretolook.utils.locks import hold
number = Path(sys.argv[1]) / "number"
for _ in range(200):
    with hold(Path(sys.argv[1]) / "lock", "count", wait_s=60):
        number.write_text(str(int(number.read_text()) + 1))
"""
    (tmp_path / "number").write_text("0")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    many = [subprocess.Popen([sys.executable, "-c", script, str(tmp_path)], env=environment) for _ in range(4)]
    assert [process.wait() for process in many] == [0] * 4
    assert (tmp_path / "number").read_text() == "800"


def test_a_child_does_not_hold_what_its_parent_holds(tmp_path: Path) -> None:
    """Neither a forked one nor one that runs another program: the lock ends with the parent, however that ends."""
    lock = tmp_path / "lock"
    with hold(lock, "label"):
        child = os.fork()
        if child == 0:
            time.sleep(600)
            os._exit(0)
        other = subprocess.Popen(["sleep", "600"], close_fds=False)
    try:
        with hold(lock, "sample"):
            pass
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        other.kill()
        other.wait()


def test_without_locks_it_warns_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(file: int, kind: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", none)
    with pytest.warns(LockWarning, match="no locks"), hold(tmp_path / "lock", "label"):
        pass
    assert not (tmp_path / "lock").exists()


def test_a_link_or_a_pipe_is_no_lock(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    os.mkfifo(tmp_path / "pipe")
    for name in ("link", "pipe"):
        with pytest.raises(OSError) as caught, hold(tmp_path / name, "label"):
            pass
        assert str(caught.value.filename) == str(tmp_path / name)
    assert not (tmp_path / "elsewhere").exists()


def test_a_reader_needs_no_folder_and_makes_none(tmp_path: Path) -> None:
    with hold(tmp_path / "missing" / "lock", "plan", shared=True):
        assert not (tmp_path / "missing").exists()


def test_ctrl_c_at_the_very_end_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    unlink = Path.unlink
    interrupts = iter([True])

    def interrupted(path: Path, missing_ok: bool = False) -> None:
        if next(interrupts, False):
            raise KeyboardInterrupt
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", interrupted)
    with pytest.raises(KeyboardInterrupt), hold(tmp_path / "lock", "label"):
        pass
    assert not list(tmp_path.iterdir())
