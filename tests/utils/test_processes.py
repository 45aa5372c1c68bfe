"""A pool whose process is killed says so in the project's own words."""

from __future__ import annotations

import os
import signal

import pytest

from wheretolook.utils.errors import WorkerError
from wheretolook.utils.processes import Processes


def die(item: int) -> int:
    if item == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return item


def test_a_killed_process_is_a_typed_error() -> None:
    with Processes(2) as processes, pytest.raises(WorkerError, match="killed"):
        list(processes.map(die, range(6)))
