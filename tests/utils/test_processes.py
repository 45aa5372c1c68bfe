"""A pool whose process is killed says so in the project's own words."""

import ctypes
import errno
import fcntl
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from localization.rooms import is_running, workers_of
from waiting import wait_until
from wheretolook.utils.errors import InUseError, LockWarning, WorkerError
from wheretolook.utils.processes import WorkerPool, hold


def die(item):
    if item == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return item


def test_a_killed_process_is_a_typed_error():
    with WorkerPool(2) as processes, pytest.raises(WorkerError):
        list(processes.map(die, range(6)))


def test_a_script_without_a_guard_is_named(tmp_path):
    script = tmp_path / "script.py"
    work = "from wheretolook.utils.processes import WorkerPool\nwith WorkerPool(2) as pool:\n    print(*pool.map(abs, [-1]))\n"
    script.write_text(work)
    run = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=60)
    assert f"{script}: worker processes import this script" in run.stderr


def pid_after(seconds):
    time.sleep(seconds)
    return os.getpid()


@pytest.mark.slow
def test_processes_outlive_the_thread_that_started_them():
    first = []
    with WorkerPool(2) as processes:
        pids = processes.map(pid_after, [0.1] * 10)
        thread = threading.Thread(target=lambda: first.append(next(pids)))
        thread.start()
        thread.join()
        assert len([*first, *pids]) == 10


def hold_the_interpreter(seconds):
    """As a compiled function does that lets no other thread run."""
    ctypes.PyDLL(None).sleep(seconds)


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel ends them on Linux")
@pytest.mark.slow
def test_a_process_ends_with_the_killed_one_that_started_it_whatever_it_does(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(
        "from utils.test_processes import hold_the_interpreter\n"
        "from wheretolook.utils.processes import WorkerPool\n"
        "if __name__ == '__main__':\n"
        "    with WorkerPool(2) as processes:\n"
        "        list(processes.map(hold_the_interpreter, [600, 600]))\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    parent = subprocess.Popen([sys.executable, str(script)], env=environment)
    wait_until(lambda: len(workers_of(parent.pid)) == 2 and all(map(_sleeps_long, workers_of(parent.pid))))
    workers = workers_of(parent.pid)
    parent.kill()
    parent.wait()
    wait_until(lambda: not any(map(is_running, workers)), seconds=20)


def _sleeps_long(pid):
    """Whether a process has imported all and is in the function: its main thread has waited for a second."""
    stat = Path(f"/proc/{pid}/stat")
    before = stat.read_text().split()[13:15]
    time.sleep(1)
    return stat.read_text().split()[2] == "S" and stat.read_text().split()[13:15] == before


# Locks keep processes apart, and do not outlive who held them.

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
    assert process.stdout.readline() == "held\n"
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
