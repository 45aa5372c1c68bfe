"""A pool whose process is killed says so in the project's own words."""

import ctypes
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
from wheretolook.utils.errors import WorkerError
from wheretolook.utils.processes import WorkerPool


def die(item):
    if item == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return item


def test_a_killed_process_is_a_typed_error():
    with WorkerPool(2) as processes, pytest.raises(WorkerError):
        list(processes.map(die, range(6)))


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
