"""The worker's priorities and the level of detail of slow browsers."""

import threading
import time

import numpy as np
import pytest

from waiting import wait_until
from wheretolook.view.session import LATER, NOW, SOON, Worker


def test_urgent_jobs_go_first_and_failures_stop_nothing_else():
    worker = Worker()
    done = []
    errors = []
    ready = threading.Event()

    def steps(name, n):
        ready.wait(10)
        for _ in range(n):
            done.append(name)
            yield
        if name == "fails":
            raise ValueError

    for client, name, n in ((1, "first", 3), (2, "second", 2), (3, "fails", 1), (4, "forgotten", 5)):
        worker.submit(client, "floor", LATER, steps(name, n), errors.append)
    for name in ("replaced", "new"):
        worker.submit(1, "view", NOW, steps(name, 2), errors.append)
    worker.forget(4)
    ready.set()
    wait_until(lambda: len(done) >= 8 and errors)
    worker.stop()
    assert sorted(done) == ["fails"] + 3 * ["first"] + 2 * ["new"] + 2 * ["second"]
    assert done.index("new") <= 1 and isinstance(errors[0], ValueError)


def test_no_urgency_starves(monkeypatch):
    """Floors wait while a view is turned without end, but not for ever; nor do clicked locations."""
    monkeypatch.setattr("wheretolook.view.session.PATIENCE_S", 0.6)
    monkeypatch.setattr("wheretolook.view.session.CLICK_PATIENCE_S", 0.2)
    worker = Worker()
    floors = []
    clicks = []

    def turns():
        while True:
            time.sleep(0.01)
            yield

    def note(times):
        times.append(time.monotonic())
        yield

    worker.submit(1, "view", NOW, turns(), pytest.fail)
    for n in (1, 2):
        worker.submit(2, "place", SOON, note(clicks), pytest.fail)
        worker.submit(2, "floor", LATER, note(floors), pytest.fail)
        wait_until(lambda n=n: len(clicks) == len(floors) == n, 10)
    worker.stop()
    assert np.diff(floors)[0] >= 0.6
